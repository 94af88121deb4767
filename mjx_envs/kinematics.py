"""Forward kinematics of the scene and quaternion algebra, for NumPy and JAX alike.

Quaternions are (w, x, y, z). `xp` is the array namespace: numpy or jax.numpy. All functions take
leading batch dimensions. Free of JAX.
"""

from types import ModuleType

import numpy as np
from jaxtyping import Float

from ddgrasp.arrays import AnyArray
from ddgrasp.layout import QPOS
from mjx_envs import scene

Quats = Float[AnyArray, "*#batch 4"]
Vectors = Float[AnyArray, "*#batch 3"]
"""Batches that NumPy's rules make alike."""
Pose = tuple[Float[AnyArray, "*batch 3"], Float[AnyArray, "*batch 4"]]
"""Position (m) and unit quaternion in the world."""
_FINGER_TURNS = {"left_finger": (1.0, 0, 0, 0), "right_finger": (0.0, 0, 0, 1)}
"""Quaternions in the hand's frame; a finger moves along its own y axis."""


def quat_mul(a: Quats, b: Quats, xp: ModuleType = np) -> Quats:
    """(..., 4) Hamilton product a * b."""
    aw, ax, ay, az = (a[..., i] for i in range(4))
    bw, bx, by, bz = (b[..., i] for i in range(4))
    return xp.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ],
        axis=-1,
    )


def quat_conj(q: Float[AnyArray, "*batch 4"], xp: ModuleType = np) -> Float[AnyArray, "*batch 4"]:
    """(..., 4) conjugate = inverse of a unit quaternion."""
    return xp.concatenate([q[..., :1], -q[..., 1:]], axis=-1)


def rotate(q: Quats, v: Vectors, xp: ModuleType = np) -> Vectors:
    """(..., 3) vector v turned by the unit quaternion q."""
    u = q[..., 1:]
    t = 2.0 * xp.cross(u, v)
    return v + q[..., :1] * t + xp.cross(u, t)


def quat_to_mat(q: Float[AnyArray, "*batch 4"], xp: ModuleType = np) -> Float[AnyArray, "*batch 3 3"]:
    """(..., 3, 3) rotation matrix of a unit quaternion."""
    columns = [rotate(q, xp.broadcast_to(xp.eye(3)[i], q.shape[:-1] + (3,)), xp) for i in range(3)]
    return xp.stack(columns, axis=-1)


def quat_about_z(angle_rad: Float[AnyArray, "*batch"], xp: ModuleType = np) -> Float[AnyArray, "*batch 4"]:
    """(..., 4) rotation about the z axis."""
    zero = xp.zeros_like(angle_rad)
    return xp.stack([xp.cos(angle_rad / 2), zero, zero, xp.sin(angle_rad / 2)], axis=-1)


def quat_from_rotation_vector(
    vector_rad: Float[AnyArray, "*batch 3"], xp: ModuleType = np
) -> Float[AnyArray, "*batch 4"]:
    """(..., 4) rotation by |vector| about the vector (..., 3)."""
    half = xp.linalg.norm(vector_rad, axis=-1, keepdims=True) / 2
    return xp.concatenate([xp.cos(half), vector_rad / 2 * xp.sinc(half / np.pi)], axis=-1)


def yaw_of(q: Float[AnyArray, "*batch 4"], xp: ModuleType = np) -> Float[AnyArray, "*batch"]:
    """(...,) angle about world z of the horizontal projection of the turned x axis."""
    w, x, y, z = (q[..., i] for i in range(4))
    return xp.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


def angle_between(a: Quats, b: Quats, xp: ModuleType = np) -> Float[AnyArray, "*#batch"]:
    """(...,) angle (rad, 0..pi) of the rotation from unit quaternion a to b."""
    dot = xp.abs(xp.sum(a * b, axis=-1))
    return 2.0 * xp.arccos(xp.clip(dot, 0.0, 1.0 - 1e-7))


def body_poses(qpos: Float[AnyArray, "*batch joints"], xp: ModuleType = np) -> dict[str, Pose]:
    """World pose of every moving body: name -> ((..., 3) position m, (..., 4) quaternion).

    Args:
      qpos: (..., 9 or 16) arm 7, fingers 2 and, if given, the object's pose 7.
    """
    base = _base(qpos.shape[:-1], xp)
    positions, quats = _arm_chain(base, xp.moveaxis(qpos[..., QPOS.arm], -1, 0), xp)
    poses = {"link0": base}
    poses |= {link.name: (positions[i], quats[i]) for i, link in enumerate(scene.ARM_LINKS)}
    poses["hand"] = hand_pos, hand_quat = _hand(positions[-1], quats[-1], xp)
    fingers = zip(_FINGER_TURNS.items(), range(QPOS.fingers.start, QPOS.fingers.stop), strict=True)
    for (name, turn), index in fingers:
        pos, quat = _child(hand_pos, hand_quat, scene.FINGER_POS_M, turn, xp)
        slide = qpos[..., index, None] * xp.asarray([0.0, 1.0, 0.0])
        poses[name] = (pos + rotate(quat, slide, xp), quat)
    if qpos.shape[-1] > scene.N_ROBOT:
        poses["object"] = (qpos[..., QPOS.object_pos], qpos[..., QPOS.object_quat])
    return poses


def _arm_chain(base, joints, xp):
    """(7, ..., 3) positions and (7, ..., 4) quaternions of the links; `joints` (7, ...) rad.

    A scan under JAX: unrolled, XLA on CPU repeats the chain for every component of every link
    (12 s instead of milliseconds for 60 robots).
    """
    local_pos = np.array([link.pos_m for link in scene.ARM_LINKS])
    local_quat = np.array([link.quat for link in scene.ARM_LINKS])

    def step(pose, link):
        parent_pos, parent_quat = pose
        child_pos, child_quat, angle = link
        pos, quat = _child(parent_pos, parent_quat, child_pos, child_quat, xp)
        turned = pos, quat_mul(quat, quat_about_z(angle, xp), xp)
        return turned, turned

    if xp is not np:
        from jax import lax

        dtype = joints.dtype
        base = tuple(xp.asarray(x, dtype) for x in base)
        return lax.scan(step, base, (xp.asarray(local_pos, dtype), xp.asarray(local_quat, dtype), joints))[1]
    poses = []
    for link in zip(local_pos, local_quat, joints, strict=True):
        base, _ = step(base, link)
        poses.append(base)
    return np.stack([p for p, _ in poses]), np.stack([q for _, q in poses])


def grip_pose(
    q_arm: Float[AnyArray, "*batch 7"], xp: ModuleType = np
) -> tuple[Float[AnyArray, "*batch 3"], Float[AnyArray, "*batch 4"]]:
    """((..., 3) position m, (..., 4) quaternion) of the site between the finger pads.

    Args:
      q_arm: (..., 7) joint positions, rad.
    """
    positions, quats = _arm_chain(_base(q_arm.shape[:-1], xp), xp.moveaxis(q_arm, -1, 0), xp)
    pos, quat = _hand(positions[-1], quats[-1], xp)
    return pos + rotate(quat, xp.asarray(scene.GRIP_POS_M), xp), quat


def _base(batch, xp):
    return xp.zeros(batch + (3,)), xp.broadcast_to(xp.asarray([1.0, 0.0, 0.0, 0.0]), batch + (4,))


def _hand(pos, quat, xp):
    return _child(pos, quat, scene.HAND_POS_M, scene.HAND_QUAT, xp)


def _child(pos, quat, local_pos, local_quat, xp):
    local_pos = xp.broadcast_to(xp.asarray(local_pos, dtype=pos.dtype), pos.shape)
    local_quat = xp.broadcast_to(xp.asarray(local_quat, dtype=quat.dtype), quat.shape)
    return pos + rotate(quat, local_pos, xp), quat_mul(quat, local_quat, xp)
