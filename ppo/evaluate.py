"""Deterministic evaluation of a teacher: whole episodes on all devices, counted per object."""

import jax
from mujoco_playground import State

from ddgrasp.contract import counted
from ddgrasp.layout import QVEL
from mjx_envs.grasp_env import GraspEnv
from ppo.motion import motion_metrics
from ppo.policy import TeacherPolicy
from ppo.rollout import roll_out


def motion_of(before: State, action: jax.Array, after: State) -> dict[str, jax.Array]:
    """What `motion_metrics` needs of a step (`ppo.rollout.Keep`): velocities (N, 7), actions (N, 8)."""
    return {"velocity_rad_s": after.data.qvel[:, QVEL.arm], "action": action}


def evaluate(env: GraspEnv, policy: TeacherPolicy, trials: int, seed: int) -> dict:
    """Success and motion over `trials` episodes. Every process of `ppo.hosts` must call it.

    Returns:
      success {"successes", "n"}; objects {name: {"successes", "n"}}; saturated_actions; motion, a row
      {"object", ...} of `motion_metrics` for each object that came up, and one for all; contacts_dropped,
      those that the physics backend could not hold.
    """
    keys = jax.random.split(jax.random.PRNGKey(seed), trials)
    seen = roll_out(env, policy, keys, motion_of)
    success, index = seen.success, seen.object_index
    motion = (seen.kept["velocity_rad_s"], seen.kept["action"], seen.running)
    chosen = {name: index == i for i, name in enumerate(env.table.names)} | {"all": index >= 0}
    rows = [
        {"object": name} | motion_metrics(*(part[:, which] for part in motion))
        for name, which in chosen.items()
        if which.any()
    ]
    return {
        "success": counted(success),
        "objects": {name: counted(success[index == i]) for i, name in enumerate(env.table.names)},
        "saturated_actions": rows[-1]["saturated_actions"],
        "motion": rows,
        "contacts_dropped": seen.dropped,
    }
