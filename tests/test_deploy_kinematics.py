"""The robot side's own forward kinematics."""

import mujoco
import numpy as np
import pytest

from ddgrasp import contract
from deploy import kinematics
from mjx_envs import scene

LOWER, UPPER = np.array(contract.JOINT_LOWER_RAD), np.array(contract.JOINT_UPPER_RAD)


def test_stretched_arm_by_hand():
    # All joints zero: the arm stands upright, the wrist reaches 88 mm forward and points down.
    expected = (0.088, 0.0, 0.333 + 0.316 + 0.384 - 0.107 - 0.1034)
    np.testing.assert_allclose(kinematics.grip_position(np.zeros(7)), expected, atol=1e-12)
    np.testing.assert_allclose(kinematics.grip_pose(np.zeros(7))[:3, 2], (0, 0, -1), atol=1e-12)


def test_first_joint_turns_everything_about_the_base():
    q = np.array(contract.HOME_RAD)
    x, y, z = kinematics.grip_position(q)
    q[0] += np.pi / 2
    np.testing.assert_allclose(kinematics.grip_position(q), (-y, x, z), atol=1e-12)


def test_pose_equals_mujocos_anywhere():
    model = scene.build_model()
    data = mujoco.MjData(model)
    site = model.site("grip").id
    for q in np.random.default_rng(0).uniform(LOWER, UPPER, (50, 7)):
        data.qpos[:7] = q
        mujoco.mj_kinematics(model, data)
        pose = kinematics.grip_pose(q)
        np.testing.assert_allclose(pose[:3, 3], data.site_xpos[site], atol=1e-9)
        np.testing.assert_allclose(pose[:3, :3], data.site_xmat[site].reshape(3, 3), atol=1e-9)


@pytest.mark.parametrize("seed", range(3))
def test_jacobian_is_the_derivative(seed):
    q, h = np.random.default_rng(seed).uniform(LOWER, UPPER), 1e-6
    columns = [
        (kinematics.grip_position(q + h * e) - kinematics.grip_position(q - h * e)) / (2 * h)
        for e in np.eye(7)
    ]
    np.testing.assert_allclose(kinematics.position_jacobian(q), np.stack(columns, axis=1), atol=1e-8)


def test_spheres_reach_as_far_as_the_arm_s_own_geoms():
    model = scene.build_model()
    data = mujoco.MjData(model)
    bodies = [model.body(name).id for name in ("link5", "link6", "hand")]
    capsules = [
        g
        for g in range(model.ngeom)
        if model.geom_bodyid[g] in bodies and model.geom_type[g] == mujoco.mjtGeom.mjGEOM_CAPSULE
    ]
    gaps = []
    for q in np.random.default_rng(1).uniform(LOWER, UPPER, (200, 7)):
        data.qpos[:7] = q
        mujoco.mj_kinematics(model, data)
        axes = data.geom_xmat[capsules].reshape(-1, 3, 3)[:, :, 2] * model.geom_size[capsules, 1:2]
        ends = np.stack([data.geom_xpos[capsules] + axes, data.geom_xpos[capsules] - axes])
        lowest = (ends[..., 2] - model.geom_size[capsules, 0]).min()
        box = data.geom("hand_box")
        lowest = min(lowest, box.xpos[2] - np.abs(box.xmat.reshape(3, 3)[2]) @ model.geom("hand_box").size)
        parts = (kinematics.part_centers(q)[:, 2] - kinematics.PART_RADII_M)[4:]  # from the forearm on
        gaps.append(parts.min() - lowest)
    assert max(gaps) < 0.016, "something of the arm hangs lower than every sphere"


def test_spheres_leave_out_at_most_half_a_centimetre_of_an_fr3():
    """Of its meshes, in each direction in which a wall may stand, the fingers open."""
    pytest.importorskip("franky_sim", reason="needs pip install -e '.[fr3]'")
    from franky_sim.mujoco_simulator import MujocoSimulator

    with MujocoSimulator() as sim:
        sim.add_robot(initial_q=list(contract.HOME_RAD), initial_hand_width=0.08)
        sim.start()
        model, data = sim.model, sim.data
        links = [f"robot0_fr3_link{i}" for i in range(3, 8)] + ["robot0_hand"]
        links += ["robot0_left_finger", "robot0_right_finger"]
        bodies = [model.body(name).id for name in links]
        is_mesh = model.geom_type == mujoco.mjtGeom.mjGEOM_MESH
        geoms = np.flatnonzero(is_mesh & np.isin(model.geom_bodyid, bodies))
        for q_rad in np.random.default_rng(2).uniform(LOWER, UPPER, (50, 7)):
            data.qpos[:7] = q_rad
            mujoco.mj_kinematics(model, data)
            places_m = np.concatenate([_corners_m(model, data, g) for g in geoms])
            centers_m, radii_m = kinematics.part_centers(q_rad), kinematics.PART_RADII_M[:, None]
            assert ((centers_m - radii_m).min(axis=0) - places_m.min(axis=0)).max() < 0.005
            assert (places_m.max(axis=0) - (centers_m + radii_m).max(axis=0)).max() < 0.005


def _corners_m(model, data, geom: int) -> np.ndarray:
    mesh = model.geom_dataid[geom]
    first = model.mesh_vertadr[mesh]
    own_m = model.mesh_vert[first : first + model.mesh_vertnum[mesh]]
    return own_m @ data.geom_xmat[geom].reshape(3, 3).T + data.geom_xpos[geom]
