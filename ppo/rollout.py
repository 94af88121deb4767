"""Whole episodes of a deterministic teacher, on all devices, keeping of every step what is asked for."""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax.sharding import Mesh
from jaxtyping import Float, UInt32
from mujoco_playground import State

from ddgrasp.arrays import AnyArray
from mjx_envs import devices
from mjx_envs.grasp_env import GraspEnv
from mjx_envs.physics.interface import ModelParams, warn_of_dropped
from ppo.policy import TeacherPolicy

Keep = Callable[[State, jax.Array, State], dict[str, jax.Array]]
"""(states before a step (N, ...), actions (N, 8), states after it) -> what to keep by name, (N, ...)."""


@struct.dataclass
class Rollout:
    """N episodes of T control steps, NumPy."""

    params: ModelParams
    """Parameters of each environment, (N, ...)."""
    object_index: np.ndarray
    """(N,)"""
    success: np.ndarray
    """(N,) bool."""
    running: np.ndarray
    """(T, N) bool, whether the episode was still going on as the step began."""
    kept: dict[str, np.ndarray]
    """(T, N, ...) each."""
    dropped: int
    """Contacts that the physics backend could not hold, of all episodes."""


def roll_out(env: GraspEnv, policy: TeacherPolicy, keys: jax.Array | np.ndarray, keep: Keep) -> Rollout:
    """The episodes of `keys` (N, 2). Every process of `ppo.hosts` must call it, and gets all of them.

    `keep` is compiled in: give the same function again and again, not a new one each time.
    """
    mesh, keys = devices.make_mesh(), np.asarray(keys)
    surplus = -len(keys) % mesh.size  # the devices share evenly: some repeat the last episode
    padded = np.concatenate([keys, np.repeat(keys[-1:], surplus, axis=0)])
    made = roll_out_from(env, mesh, keep, policy.layers, policy.mean, policy.std, begin(env, mesh, padded))
    (params, index, success), (running, kept, lost) = jax.tree.map(np.asarray, made)
    first = partial(jax.tree.map, lambda values: values[: len(keys)])
    running, kept, lost = jax.tree.map(lambda values: values[:, : len(keys)], (running, kept, lost))
    dropped = int(lost[running].sum())
    warn_of_dropped(dropped, int(running.sum()))
    return Rollout(first(params), first(index), first(success), running, kept, dropped)


@partial(jax.jit, static_argnums=(0, 1))
def begin(env: GraspEnv, mesh: Mesh, keys: UInt32[AnyArray, "n 2"]) -> State:
    """The first states of the episodes of `keys` (N, 2). A program of its own: it calls no host, so it stays
    in JAX's cache on disk, which the episodes on the C engine do not."""
    return devices.each(mesh, env.reset)(keys)


@partial(jax.jit, static_argnums=(0, 1, 2))
def roll_out_from(
    env: GraspEnv,
    mesh: Mesh,
    keep: Keep,
    layers: list[tuple[AnyArray, AnyArray]],
    mean: Float[AnyArray, "40"],
    std: Float[AnyArray, "40"],
    state: State,
) -> Any:
    """The program of `roll_out`: whole episodes of a teacher from N first states on.

    Args:
      layers: (kernel, bias) of each, as `TeacherPolicy` has them; `mean` and `std` too.

    Returns ((parameters, object, success), (running, kept, contacts dropped)): per episode, and per step of
    each, as `Rollout` has them.
    """
    policy = TeacherPolicy(mean, std, layers)
    episode, count = state.info["episode"], len(state.done)

    def step(carry, _):
        state, alive, success = carry
        action = policy(state.obs, jnp)
        new = devices.each(mesh, env.step)(state, action)
        success = jnp.where(alive, new.metrics["success"] > 0, success)
        return (new, alive & (new.done == 0), success), (alive, keep(state, action, new), new.data.dropped)

    start = (state, jnp.ones(count, bool), jnp.zeros(count, bool))
    (*_, success), per_step = jax.lax.scan(step, start, None, env.config.episode_steps)
    outcome = (episode.params, episode.object_index, success), per_step
    return jax.lax.with_sharding_constraint(outcome, devices.replicated(mesh))
