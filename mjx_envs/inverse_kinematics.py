"""Joint positions that bring the grip site to a pose, under JAX."""

import jax
import jax.numpy as jnp
from jaxtyping import Float

from ddgrasp import contract
from mjx_envs import kinematics, scene
from mjx_envs.precision import exact

ITERATIONS = 10
DAMPING = 1e-4


@exact
def solve(
    q_start: Float[jax.Array, "7"], position_m: Float[jax.Array, "3"], quat: Float[jax.Array, "4"]
) -> Float[jax.Array, "7"]:
    """(7,) rad near `q_start`: ITERATIONS damped least-squares steps (Wampler 1986), joint limits kept."""
    lower, upper = jnp.asarray(contract.JOINT_LOWER_RAD), jnp.asarray(contract.JOINT_UPPER_RAD)

    def step(_, q):
        error, J = _error_and_jacobian(q, position_m, quat)
        move = J.T @ jnp.linalg.solve(J @ J.T + DAMPING * jnp.eye(6), error)
        return jnp.clip(q + jnp.clip(move, -0.3, 0.3), lower, upper)

    return jax.lax.fori_loop(0, ITERATIONS, step, q_start)


def _error_and_jacobian(q_arm, position_m, quat):
    """(6,) position (m) and small-angle rotation (rad) from grip to target; (6, 7) geometric Jacobian."""
    poses = kinematics.body_poses(jnp.concatenate([q_arm, jnp.zeros(2)]), jnp)
    hand_pos, hand_quat = poses["hand"]
    grip = hand_pos + kinematics.rotate(hand_quat, jnp.asarray(scene.GRIP_POS_M), jnp)
    turn = kinematics.quat_mul(quat, kinematics.quat_conj(hand_quat, jnp), jnp)
    turn = jnp.where(turn[0] < 0, -turn, turn)
    links = [poses[link.name] for link in scene.ARM_LINKS]
    axes = jnp.stack(
        [kinematics.rotate(link_quat, jnp.asarray([0.0, 0.0, 1.0]), jnp) for _, link_quat in links]
    )
    arms = grip - jnp.stack([link_pos for link_pos, _ in links])
    J = jnp.concatenate([jnp.cross(axes, arms).T, axes.T])
    return jnp.concatenate([position_m - grip, 2.0 * turn[1:]]), J
