"""Deterministic evaluation of a teacher: whole episodes, counted per object."""

from functools import partial

import jax
import jax.numpy as jp
import numpy as np

from mjx_envs.grasp_env import GraspEnv
from ppo.policy import TeacherPolicy


@partial(jax.jit, static_argnums=(0, 1))
def _episodes(env: GraspEnv, count: int, layers, mean, std, key):
    policy = TeacherPolicy(mean, std, layers)
    state = jax.vmap(env.reset)(jax.random.split(key, count))

    def step(carry, _):
        state, alive, success = carry
        state = jax.vmap(env.step)(state, policy(state.obs, jp))
        success = jp.where(alive, state.metrics["success"], success)
        saturated = state.metrics["saturated"]
        return (state, alive & (state.done == 0), success), saturated

    start = (state, jp.ones(count, bool), jp.zeros(count))
    (state, _, success), saturated = jax.lax.scan(step, start, None, env.config.episode_steps)
    return success, state.info["episode"].object_index, saturated.mean()


def evaluate(env: GraspEnv, policy: TeacherPolicy, trials: int, seed: int) -> dict:
    """Success over `trials` episodes: {"success": {"successes", "n"}, "objects": {...}, "saturated"}."""
    success, index, saturated = _episodes(
        env, trials, policy.layers, policy.mean, policy.std, jax.random.PRNGKey(seed)
    )
    success, index = np.asarray(success) > 0, np.asarray(index)
    objects = {
        name: {"successes": int(success[index == i].sum()), "n": int((index == i).sum())}
        for i, name in enumerate(env.table.names)
    }
    return {
        "success": {"successes": int(success.sum()), "n": trials},
        "objects": objects,
        "saturated_actions": float(saturated),
    }
