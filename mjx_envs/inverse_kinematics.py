"""Joint positions that bring the grip site to a pose, under JAX."""

import jax
import jax.numpy as jp

from ddgrasp import contract
from mjx_envs import kinematics, scene

ITERATIONS = 10
DAMPING = 1e-4


def solve(q_start: jax.Array, position_m: jax.Array, quat: jax.Array) -> jax.Array:
    """(7,) rad near `q_start`: ITERATIONS damped least-squares steps (Wampler 1986), joint limits kept."""
    lower, upper = jp.asarray(contract.JOINT_LOWER_RAD), jp.asarray(contract.JOINT_UPPER_RAD)

    def step(_, q):
        error, J = _error_and_jacobian(q, position_m, quat)
        move = J.T @ jp.linalg.solve(J @ J.T + DAMPING * jp.eye(6), error)
        return jp.clip(q + jp.clip(move, -0.3, 0.3), lower, upper)

    return jax.lax.fori_loop(0, ITERATIONS, step, q_start)


def _error_and_jacobian(q_arm, position_m, quat):
    """(6,) position (m) and small-angle rotation (rad) from grip to target; (6, 7) geometric Jacobian."""
    poses = kinematics.body_poses(jp.concatenate([q_arm, jp.zeros(2)]), jp)
    hand_pos, hand_quat = poses["hand"]
    grip = hand_pos + kinematics.rotate(hand_quat, jp.asarray(scene.GRIP_POS_M), jp)
    turn = kinematics.quat_mul(quat, kinematics.quat_conj(hand_quat, jp), jp)
    turn = jp.where(turn[0] < 0, -turn, turn)
    links = [poses[link.name] for link in scene.ARM_LINKS]
    axes = jp.stack([kinematics.rotate(link_quat, jp.asarray([0.0, 0.0, 1.0]), jp) for _, link_quat in links])
    arms = grip - jp.stack([link_pos for link_pos, _ in links])
    J = jp.concatenate([jp.cross(axes, arms).T, axes.T])
    return jp.concatenate([position_m - grip, 2.0 * turn[1:]]), J
