"""Where a Franka's arm and hand are, in NumPy.

Source: Franka's published modified Denavit-Hartenberg table, the same for Panda and FR3.
"""

import numpy as np
from jaxtyping import Float, Float64

DH_A_M = (0.0, 0.0, 0.0, 0.0825, -0.0825, 0.0, 0.088)
DH_D_M = (0.333, 0.0, 0.316, 0.0, 0.384, 0.0, 0.0)
DH_ALPHA_RAD = (0.0, -np.pi / 2, np.pi / 2, np.pi / 2, -np.pi / 2, np.pi / 2, np.pi / 2)
FLANGE_D_M = 0.107
HAND_YAW_RAD = -np.pi / 4
GRIP_D_M = 0.1034
"""From the hand's mounting face to the middle of the finger pads."""

_PARTS = (
    (2, (0.0, 0.0, -0.085), 0.067),
    (2, (0.081, 0.043, 0.0), 0.07),
    (3, (0.0, 0.0, 0.043), 0.069),
    (3, (-0.082, 0.084, 0.0), 0.067),
    (4, (0.0, 0.0, -0.224), 0.066),
    (4, (0.0, 0.045, -0.18), 0.05),
    (4, (0.0, 0.044, 0.0), 0.056),
    (4, (0.0, 0.079, 0.0), 0.058),
    (5, (0.0, 0.0, 0.008), 0.054),
    (5, (0.08, 0.039, 0.0), 0.051),
    (5, (0.088, -0.022, 0.0), 0.054),
    (6, (-0.004, -0.004, 0.075), 0.048),
    (6, (0.042, 0.042, 0.083), 0.039),
    (7, (0.0, 0.072, 0.0), 0.033),
    (7, (0.0, -0.072, 0.0), 0.033),
    (7, (0.0, 0.0, 0.045), 0.033),
    (7, (0.0, 0.07, 0.045), 0.033),
    (7, (0.0, -0.07, 0.045), 0.033),
    (7, (0.0, 0.045, 0.1054), 0.008),
    (7, (0.0, -0.045, 0.1054), 0.008),
)
"""Spheres around what can hit a table or a wall: upper arm, elbow, forearm, wrist, flange, hand, tips of open
fingers. (joint counted from 0, point in its frame, radius; metres), 7 being the hand. Fitted to the FR3's
meshes: up to 5 mm of those stand outside of them, they up to 3 cm outside of its links. The tips' end 2 mm
before the tips do, so that an upright hand may touch the table (2 degrees off upright too)."""
LINKS = slice(0, sum(i < 6 for i, *_ in _PARTS))
"""Which of them are neither flange nor hand."""
PART_RADII_M = np.array([radius for *_, radius in _PARTS])


def part_centers(q_rad: Float[np.ndarray, "7"]) -> Float64[np.ndarray, "20 3"]:
    """(20, 3) centres of the spheres of `PART_RADII_M` in the robot's base frame, metres."""
    frames = _frames(q_rad)
    return np.array([frames[i][:3, :3] @ point + frames[i][:3, 3] for i, point, _ in _PARTS])


def grip_pose(q_rad: Float[np.ndarray, "7"]) -> Float64[np.ndarray, "4 4"]:
    """(4, 4) T_base_grip for (7,) joint positions: z points out of the hand, the fingers open along y."""
    return _frames(q_rad)[-1] @ _modified_dh(0.0, GRIP_D_M, 0.0, 0.0)


def grip_position(q_rad: Float[np.ndarray, "7"]) -> Float64[np.ndarray, "3"]:
    """(3,) position of the point between the finger pads in the robot's base frame, metres."""
    return grip_pose(q_rad)[:3, 3]


def position_jacobian(q_rad: Float[np.ndarray, "7"]) -> Float64[np.ndarray, "3 7"]:
    """(3, 7) derivative of `grip_position` by the joints: z_i x (grip - origin_i)."""
    joints = np.array(_frames(q_rad)[:7])
    return np.cross(joints[:, :3, 2], grip_position(q_rad) - joints[:, :3, 3]).T


def grip_jacobian(q_rad: Float[np.ndarray, "7"]) -> Float64[np.ndarray, "6 7"]:
    """(6, 7) velocity, then angular velocity of the grip frame by the joints, robot's base frame."""
    return np.concatenate([position_jacobian(q_rad), np.array(_frames(q_rad)[:7])[:, :3, 2].T])


def _frames(q_rad: np.ndarray) -> list[np.ndarray]:
    """(4, 4) poses of the seven joints' frames, then of the hand's mounting face."""
    pose, frames = np.eye(4), []
    for a, d, alpha, theta in zip(DH_A_M, DH_D_M, DH_ALPHA_RAD, q_rad, strict=True):
        pose = pose @ _modified_dh(a, d, alpha, theta)
        frames.append(pose)
    return [*frames, pose @ _modified_dh(0.0, FLANGE_D_M, 0.0, HAND_YAW_RAD)]


def _modified_dh(a_m: float, d_m: float, alpha_rad: float, theta_rad: float) -> np.ndarray:
    """(4, 4) link transform: Rot_x(alpha) Trans_x(a) Rot_z(theta) Trans_z(d) (Craig's convention)."""
    ca, sa, ct, st = np.cos(alpha_rad), np.sin(alpha_rad), np.cos(theta_rad), np.sin(theta_rad)
    return np.array([
        [ct, -st, 0.0, a_m],
        [st * ca, ct * ca, -sa, -d_m * sa],
        [st * sa, ct * sa, ca, d_m * ca],
        [0.0, 0.0, 0.0, 1.0],
    ])  # fmt: skip
