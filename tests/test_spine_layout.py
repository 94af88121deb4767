"""Named slices: they tile each vector, and are the parts that the rest of the code means."""

import copy

import jax.numpy as jnp
import numpy as np
import pytest

from ddgrasp import contract
from ddgrasp.layout import ACTION, CONTROLS, OBSERVATION, POLICY_STATE, QPOS, QVEL, STATE, Layout, closes
from mjx_envs import grasp_math, kinematics, scene
from student_jax import denoiser
from student_jax.policy import AUX, AUX_BESIDE

LAYOUTS = {
    "qpos": (QPOS, scene.NQ),
    "qvel": (QVEL, scene.NV),
    "controls": (CONTROLS, scene.NU),
    "observation": (OBSERVATION, contract.OBSERVATION_SIZE),
    "state": (STATE, contract.STATE_SIZE),
    "policy state": (POLICY_STATE, contract.POLICY_STATE_SIZE),
    "action": (ACTION, contract.ACTION_SIZE),
    "aux": (AUX, 6),
    "aux with the hand view": (AUX_BESIDE, 10),
}


@pytest.mark.parametrize("name", LAYOUTS)
def test_parts_tile_the_vector(name):
    made, size = LAYOUTS[name]
    vector = np.arange(size)
    assert np.concatenate([vector[part] for _, part in made.items()]).tolist() == vector.tolist()
    assert made.size == size and all(getattr(made, part) == where for part, where in made.items())


def test_sizes_are_the_compiled_models():
    model = scene.build_model()
    assert (model.nq, model.nv, model.nu) == (QPOS.size, QVEL.size, CONTROLS.size)
    assert (scene.N_ARM, scene.N_ROBOT, scene.NQ, scene.NV, scene.NU) == (7, 9, 16, 15, 9)
    joints = [model.joint(i) for i in range(model.njnt)]
    starts = [int(joint.qposadr[0]) for joint in joints], [int(joint.dofadr[0]) for joint in joints]
    assert [*range(7), QPOS.fingers.start, 8, QPOS.object_pos.start] == starts[0]
    assert [*range(7), QVEL.fingers.start, 8, QVEL.object_linear.start] == starts[1]


def test_the_contracts_parts_are_made_of_whole_ones():
    ends = np.cumsum(list(contract.OBSERVATION_PARTS.values()))
    assert set(ends) <= {part.stop for _, part in OBSERVATION.items()}
    assert ends[-1] == contract.OBSERVATION_SIZE == 40
    assert (contract.STATE_SIZE, contract.ACTION_SIZE, contract.CONTRACT_VERSION) == (8, 8, 1)
    assert len(denoiser.STATE_LOWER) == POLICY_STATE.size
    assert denoiser.STATE_UPPER[POLICY_STATE.width] == np.float32(contract.GRIPPER_MAX_WIDTH_M)


@pytest.mark.parametrize("xp", [np, jnp])
def test_an_observation_has_its_parts_where_they_are_named(xp):
    rng = np.random.default_rng(0)
    quat = kinematics.quat_about_z(np.asarray(0.7))
    qpos = np.concatenate([contract.HOME_RAD, (0.03, 0.02), (0.5, -0.1, 0.2), quat])
    qvel = rng.normal(size=scene.NV)
    seen = grasp_math.observation(*map(xp.asarray, (qpos, qvel)), xp.asarray(4), 0.0, np.log(3), xp)
    grip_pos, grip_quat = kinematics.grip_pose(qpos[QPOS.arm])
    grasp_pos, grasp_quat = grasp_math.grasp_pose(qpos[QPOS.object_pos], quat, 4, 0.0)
    expected = {
        "arm": qpos[:7], "fingers": (0.03, 0.02), "arm_velocity": qvel[:7], "finger_velocity": qvel[7:9],
        "grip_pos": grip_pos, "grip_quat": grip_quat, "object_pos": (0.5, -0.1, 0.2), "object_quat": quat,
        "grasp_pos": grasp_pos, "grasp_quat": grasp_quat, "category": np.log([3]),
    }  # fmt: skip
    assert list(expected) == [name for name, _ in OBSERVATION.items()]
    for name, part in OBSERVATION.items():
        np.testing.assert_allclose(seen[part], expected[name], atol=1e-6, err_msg=name)


@pytest.mark.parametrize("xp", [np, jnp])
def test_only_a_command_above_zero_closes(xp):
    action = np.zeros((4, contract.ACTION_SIZE), np.float32)
    action[:, 7] = -1, 0, 1e-6, 1
    action[:, 6] = 1
    assert closes(xp.asarray(action)).tolist() == [False, False, True, True]
    assert bool(closes(xp.asarray(action[3]))) is True


def test_a_part_that_is_not_there():
    with pytest.raises(AttributeError, match="no part 'finger'; there are arm, fingers, object_pos"):
        _ = QPOS.finger
    again = copy.deepcopy(QPOS)
    assert again.object_quat == slice(12, 16) and dict(Layout(a=2, b=1).items()) == {
        "a": slice(0, 2),
        "b": slice(2, 3),
    }
