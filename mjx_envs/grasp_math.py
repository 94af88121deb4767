"""Grasp pose, observation and geometry of the task, for NumPy (rig, robot) and JAX (training) alike."""

from types import ModuleType

import numpy as np
from jaxtyping import Bool, Float, Int

from ddgrasp import contract
from ddgrasp.arrays import AnyArray
from ddgrasp.layout import ACTION, QPOS, closes
from mjx_envs import kinematics as kin
from mjx_envs import scene

HAND_DOWN = (0.0, 1.0, 0.0, 0.0)
"""Hand orientation with the fingers down and opening along world y."""
MIN_GRIP_HEIGHT_M = 0.02
"""The pads reach 12 mm beyond the grip site: keep them off the table."""
TOUCH_N = 0.3
"""Pad force from which a pad counts as touching the object."""
SATURATED = 0.95
"""An action component beyond this share of its range counts as saturated."""

NO_OFFSET_M = (0.0, 0.0, 0.0)

Symmetry = Int[AnyArray, "*batch"] | int
"""Equivalent yaws per turn, 0 = any."""
Branch = Float[AnyArray, "*batch"] | float
Offset = Float[AnyArray, "*batch 3"] | tuple[float, float, float]


def yaw_branch(
    object_quat: Float[AnyArray, "*batch 4"], symmetry: Symmetry, xp: ModuleType = np
) -> Float[AnyArray, "*batch"]:
    """() multiple of 2 pi / symmetry to add to the object's yaw so that the hand turns least.

    Chosen once per episode, so that the target does not jump while the object moves.
    """
    turn = 2 * np.pi / xp.maximum(symmetry, 1)
    return -xp.round(kin.yaw_of(object_quat, xp) / turn)


def grasp_pose(
    object_pos: Float[AnyArray, "*batch 3"],
    object_quat: Float[AnyArray, "*batch 4"],
    symmetry: Symmetry,
    branch: Branch,
    xp: ModuleType = np,
    offset_m: Offset = NO_OFFSET_M,
) -> tuple[Float[AnyArray, "*batch 3"], Float[AnyArray, "*batch 4"]]:
    """((3,), (4,)) top-down grasp: pads close along the object's local y axis.

    Args:
      object_pos: the object's position in the world.
      object_quat: its orientation there.
      symmetry: equivalent yaws per turn; 0 = any, then the hand keeps yaw 0.
      branch: from `yaw_branch`.
      offset_m: (3,) from the object's origin to the grasp, object frame.
    """
    turn = 2 * np.pi / xp.maximum(symmetry, 1)
    yaw = xp.where(symmetry == 0, 0.0, kin.yaw_of(object_quat, xp) + branch * turn)
    down = xp.broadcast_to(xp.asarray(HAND_DOWN, dtype=object_quat.dtype), object_quat.shape)
    quat = kin.quat_mul(kin.quat_about_z(yaw, xp), down, xp)
    pos = object_pos + kin.rotate(object_quat, xp.asarray(offset_m, dtype=object_pos.dtype), xp)
    height = xp.maximum(pos[..., 2], MIN_GRIP_HEIGHT_M)
    return xp.concatenate([pos[..., :2], height[..., None]], axis=-1), canonical(quat, 1, xp)


def canonical(
    quat: Float[AnyArray, "*batch 4"], axis: int, xp: ModuleType = np
) -> Float[AnyArray, "*batch 4"]:
    """The one of +-quat whose component `axis` is not negative: the same rotation, one number."""
    return xp.where(quat[..., axis : axis + 1] < 0, -quat, quat)


def observation(
    qpos: Float[AnyArray, "*batch 16"],
    qvel: Float[AnyArray, "*batch 15"],
    symmetry: Symmetry,
    branch: Branch,
    log_category: Float[AnyArray, "*batch"] | float,
    xp: ModuleType = np,
    offset_m: Offset = NO_OFFSET_M,
) -> Float[AnyArray, "*batch 40"]:
    """(40,) teacher observation (`ddgrasp.layout.OBSERVATION` lists its parts)."""
    grip_pos, grip_quat = kin.grip_pose(qpos[..., QPOS.arm], xp)
    object_pos, object_quat = qpos[..., QPOS.object_pos], qpos[..., QPOS.object_quat]
    grasp_pos, grasp_quat = grasp_pose(object_pos, object_quat, symmetry, branch, xp, offset_m)
    return xp.concatenate(
        [
            qpos[..., : scene.N_ROBOT], qvel[..., : scene.N_ROBOT],
            grip_pos, canonical(grip_quat, 1, xp),
            object_pos, canonical(object_quat, 0, xp),
            grasp_pos, grasp_quat,
            xp.asarray(log_category, dtype=qpos.dtype)[..., None],
        ],
        axis=-1,
    )  # fmt: skip


def controls(
    q_arm: Float[AnyArray, "*batch 7"], action: Float[AnyArray, "*batch 8"], xp: ModuleType = np
) -> Float[AnyArray, "*batch 9"]:
    """(9,) actuator targets of an action (8,): clipped joint targets and the fingers' opening."""
    target = q_arm + contract.ACTION_SCALE_RAD * xp.clip(action[..., ACTION.arm], -1.0, 1.0)
    target = xp.clip(target, xp.asarray(contract.JOINT_LOWER_RAD), xp.asarray(contract.JOINT_UPPER_RAD))
    finger = xp.where(closes(action)[..., None], 0.0, contract.GRIPPER_MAX_WIDTH_M / 2)
    return xp.concatenate([target, finger, finger], axis=-1)


def at_lift_target(object_pos: Float[AnyArray, "3"], xp: ModuleType = np) -> Bool[AnyArray, ""]:
    """Whether an object at `object_pos` (3,), metres, is where it is to be lifted to."""
    return xp.linalg.norm(object_pos - xp.asarray(contract.LIFT_TARGET_M)) < contract.LIFT_TOLERANCE_M


def touch_from_sensors(
    sensordata: Float[AnyArray, "*batch forces"], xp: ModuleType
) -> Float[AnyArray, "*batch 2"]:
    """(..., 2) contact force (N) on the left and right pad from the scene's contact sensors (..., 6 S)."""
    forces = sensordata.reshape(sensordata.shape[:-1] + (2, -1, 3))
    return xp.sqrt(xp.sum(forces**2, axis=-1)).sum(axis=-1)
