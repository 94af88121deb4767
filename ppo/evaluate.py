"""Deterministic evaluation of a teacher: whole episodes on all devices, counted per object."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh

from ddgrasp.layout import QVEL
from mjx_envs import devices
from mjx_envs.grasp_env import GraspEnv
from ppo.motion import motion_metrics
from ppo.policy import TeacherPolicy


@partial(jax.jit, static_argnums=(0, 1, 2))
def _episodes(env: GraspEnv, mesh: Mesh, count: int, layers, mean, std, key):
    """Success (N,), object index (N,) and motion (T, N, ...) of N episodes, whole on every device.

    N is `count` up to the next multiple of the devices, which repeat the last episode.
    """
    policy = TeacherPolicy(mean, std, layers)
    keys = jax.random.split(key, count)
    surplus = -count % mesh.size
    keys = jnp.concatenate([keys, jnp.tile(keys[-1:], (surplus, 1))]) if surplus else keys
    state = devices.each(mesh, env.reset)(keys)

    def step(carry, _):
        state, alive, success = carry
        action = policy(state.obs, jnp)
        state = devices.each(mesh, env.step)(state, action)
        success = jnp.where(alive, state.metrics["success"], success)
        motion = (state.data.qvel[:, QVEL.arm], action, alive)
        return (state, alive & (state.done == 0), success), motion

    start = (state, jnp.ones(len(keys), bool), jnp.zeros(len(keys)))
    (state, _, success), motion = jax.lax.scan(step, start, None, env.config.episode_steps)
    outcome = (success, state.info["episode"].object_index, motion)
    return jax.lax.with_sharding_constraint(outcome, devices.replicated(mesh))


def evaluate(env: GraspEnv, policy: TeacherPolicy, trials: int, seed: int) -> dict:
    """Success and motion over `trials` episodes. Every process of `ppo.hosts` must call it.

    Returns:
      success {"successes", "n"}; objects {name: {"successes", "n"}}; saturated_actions; motion, a row
      {"object", ...} of `motion_metrics` for each object that came up, and one for all.
    """
    key = np.asarray(jax.random.PRNGKey(seed))
    mesh = devices.make_mesh()
    success, index, motion = _episodes(env, mesh, trials, policy.layers, policy.mean, policy.std, key)
    success, index = np.asarray(success)[:trials] > 0, np.asarray(index)[:trials]
    motion = [np.asarray(part)[:, :trials] for part in motion]
    chosen = {name: index == i for i, name in enumerate(env.table.names)} | {"all": index >= 0}
    rows = [
        {"object": name} | motion_metrics(*(part[:, which] for part in motion))
        for name, which in chosen.items()
        if which.any()
    ]
    objects = {
        name: {"successes": int(success[index == i].sum()), "n": int((index == i).sum())}
        for i, name in enumerate(env.table.names)
    }
    return {
        "success": {"successes": int(success.sum()), "n": trials},
        "objects": objects,
        "saturated_actions": rows[-1]["saturated_actions"],
        "motion": rows,
    }
