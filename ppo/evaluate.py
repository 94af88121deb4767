"""Deterministic evaluation of a teacher: whole episodes, counted per object."""

from functools import partial

import jax
import jax.numpy as jp
import numpy as np

from mjx_envs.grasp_env import GraspEnv
from ppo.motion import motion_metrics
from ppo.policy import TeacherPolicy


@partial(jax.jit, static_argnums=(0, 1))
def _episodes(env: GraspEnv, count: int, layers, mean, std, key):
    policy = TeacherPolicy(mean, std, layers)
    state = jax.vmap(env.reset)(jax.random.split(key, count))

    def step(carry, _):
        state, alive, success = carry
        action = policy(state.obs, jp)
        state = jax.vmap(env.step)(state, action)
        success = jp.where(alive, state.metrics["success"], success)
        motion = (state.data.qvel[:, :7], action, alive)
        return (state, alive & (state.done == 0), success), motion

    start = (state, jp.ones(count, bool), jp.zeros(count))
    (state, _, success), motion = jax.lax.scan(step, start, None, env.config.episode_steps)
    return success, state.info["episode"].object_index, motion


def evaluate(env: GraspEnv, policy: TeacherPolicy, trials: int, seed: int) -> dict:
    """Success and motion over `trials` episodes.

    Returns:
      success {"successes", "n"}; objects {name: {"successes", "n"}}; saturated_actions; motion, a row
      {"object", ...} of `motion_metrics` for each object that came up, and one for all.
    """
    success, index, motion = _episodes(
        env, trials, policy.layers, policy.mean, policy.std, jax.random.PRNGKey(seed)
    )
    success, index = np.asarray(success) > 0, np.asarray(index)
    motion = [np.asarray(part) for part in motion]
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
