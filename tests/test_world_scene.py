"""Scene, objects, kinematics and the task's geometry, by value."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest

from ddgrasp import contract
from ddgrasp.errors import UserError
from mjx_envs import grasp_math, kinematics, scene
from mjx_envs.objects import OBJECTS, get_object
from rig.world import RigWorld


@pytest.fixture(scope="module")
def model():
    return scene.build_model()


def test_forward_kinematics_equals_mujoco(model):
    data = mujoco.MjData(model)
    rng = np.random.default_rng(0)
    for _ in range(10):
        data.qpos[:7] = rng.uniform(contract.JOINT_LOWER_RAD, contract.JOINT_UPPER_RAD)
        data.qpos[7:9] = rng.uniform(0, 0.04, 2)
        mujoco.mj_kinematics(model, data)
        for name, (pos, quat) in kinematics.body_poses(data.qpos).items():
            np.testing.assert_allclose(pos, data.body(name).xpos, atol=1e-7)
            np.testing.assert_allclose(
                kinematics.quat_to_mat(quat), data.body(name).xmat.reshape(3, 3), atol=1e-7
            )


def test_home_holds_the_grip_above_the_table_pointing_down():
    pos, quat = kinematics.grip_pose(np.array(contract.HOME_RAD))
    np.testing.assert_allclose(pos, [0.45, 0.0, 0.26], atol=1e-3)
    down = kinematics.rotate(quat, np.array([0.0, 0.0, 1.0]))
    np.testing.assert_allclose(down, [0.0, 0.0, -1.0], atol=1e-3)


def test_quaternion_product_turns_twice():
    quarter = kinematics.quat_about_z(np.array(np.pi / 2))
    half = kinematics.quat_mul(quarter, quarter)
    np.testing.assert_allclose(kinematics.rotate(half, np.array([1.0, 0, 0])), [-1, 0, 0], atol=1e-12)
    assert kinematics.angle_between(quarter, half) == pytest.approx(np.pi / 2, abs=1e-3)


@pytest.mark.parametrize("name", sorted(OBJECTS))
def test_objects_fit_the_gripper_and_are_named_in_errors(name):
    spec = get_object(name)
    assert 2 * spec.half_width_m() < contract.GRIPPER_MAX_WIDTH_M
    assert spec.rest_height_m > 0 and spec.mass_kg > 0
    with pytest.raises(UserError, match=f"Did you mean '{name}'"):
        get_object(name + "x")


@pytest.mark.parametrize("name", sorted(OBJECTS))
def test_an_object_at_rest_stays_at_rest(name):
    world = RigWorld(sorted(OBJECTS))
    for seed in range(6):
        world.reset(seed, name)
        start = world.data.qpos[9:12].copy()
        world.step(2.0)
        assert np.linalg.norm(world.data.qpos[9:12] - start) < 0.01, (seed, world.data.qpos[9:12])
        assert not world.success()


def test_grasp_pose_closes_along_the_objects_y_axis():
    yaw = 0.3
    quat = kinematics.quat_about_z(np.array(yaw))
    branch = grasp_math.yaw_branch(quat, np.array(4))
    pos, grasp = grasp_math.grasp_pose(np.array([0.5, 0.1, 0.005]), quat, np.array(4), branch)
    np.testing.assert_allclose(pos, [0.5, 0.1, grasp_math.MIN_GRIP_HEIGHT_M])
    opening = kinematics.rotate(grasp, np.array([0.0, 1.0, 0.0]))
    object_y = kinematics.rotate(quat, np.array([0.0, 1.0, 0.0]))
    assert abs(opening @ object_y) == pytest.approx(1.0, abs=1e-9)
    np.testing.assert_allclose(kinematics.rotate(grasp, np.array([0.0, 0, 1])), [0, 0, -1], atol=1e-9)


@pytest.mark.parametrize(
    ("yaw", "symmetry", "expected"), [(1.0, 4, 1.0 - np.pi / 2), (2.0, 2, 2.0 - np.pi), (2.0, 0, 0.0)]
)
def test_the_hand_turns_least(yaw, symmetry, expected):
    quat = kinematics.quat_about_z(np.array(yaw))
    branch = grasp_math.yaw_branch(quat, np.array(symmetry))
    _, grasp = grasp_math.grasp_pose(np.zeros(3), quat, np.array(symmetry), branch)
    hand = kinematics.quat_mul(kinematics.quat_about_z(np.array(expected)), np.array(grasp_math.HAND_DOWN))
    assert kinematics.angle_between(grasp, hand) < 1e-3


def test_controls_are_clipped_and_scaled():
    q = np.array(contract.JOINT_UPPER_RAD)
    action = np.array([2.0, -0.5, 0, 0, 0, 0, 0, 0.4])
    target = grasp_math.controls(q, action)
    assert target[0] == pytest.approx(contract.JOINT_UPPER_RAD[0])
    assert target[1] == pytest.approx(q[1] - 0.5 * contract.ACTION_SCALE_RAD)
    np.testing.assert_array_equal(target[7:], [0.0, 0.0])
    np.testing.assert_array_equal(grasp_math.controls(q, -action)[7:], [0.04, 0.04])


def test_observation_has_forty_numbers_in_the_contracts_order():
    qpos = np.arange(16.0) / 16
    qpos[12:16] = [1, 0, 0, 0]
    obs = grasp_math.observation(qpos, np.arange(15.0), np.array(2), 0.0, np.log(3))
    assert obs.shape == (contract.OBSERVATION_SIZE,)
    np.testing.assert_array_equal(obs[:9], qpos[:9])
    np.testing.assert_array_equal(obs[9:18], np.arange(9.0))
    np.testing.assert_allclose(obs[18:21], kinematics.grip_pose(qpos[:7])[0])
    np.testing.assert_array_equal(obs[25:32], qpos[9:16])
    assert obs[39] == pytest.approx(np.log(3))


@pytest.mark.parametrize("scale", [0.1, 0.25, 1 / 3, 0.5, 0.7, 1.0])
def test_the_camera_looks_through_its_picture_s_centre_at_every_scale(scale):
    """The FR3 rig's renderer draws no other."""
    camera = contract.D455.scaled(scale)
    assert (camera.cx_px, camera.cy_px) == (camera.width_px / 2, camera.height_px / 2)
    assert camera.fx_px / camera.width_px == pytest.approx(contract.D455.fx_px / 1280, rel=2e-3)


def test_a_camera_off_its_centre_stays_off_it():
    camera = replace(contract.D455, cx_px=contract.D455.cx_px + 8.0).scaled(0.25)
    assert camera.cx_px == camera.width_px / 2 + 2.0
