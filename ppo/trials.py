"""Recorded episodes of a teacher, the same number of each object: how often it succeeds, how it moves and how
much of the object the camera sees.
"""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Bool, Float, UInt32
from mujoco_playground import State

from ddgrasp.contract import counted
from ddgrasp.progress import Progress
from mjx_envs.grasp_env import GraspEnv
from mjx_envs.grasp_math import TOUCH_N
from mjx_envs.physics.interface import ModelParams
from ppo.evaluate import motion_of
from ppo.motion import motion_metrics
from ppo.policy import TeacherPolicy
from ppo.rollout import roll_out
from ppo.visible import Watcher, moments


@struct.dataclass
class Trials:
    """N episodes of T control steps, NumPy. A state is the one at the beginning of a step."""

    params: ModelParams
    """Parameters of each environment, (N, ...)."""
    qpos: Float[np.ndarray, "T N 16"]
    touched: Bool[np.ndarray, "T N"]
    """Whether a finger pad touches the object or has touched it."""
    running: Bool[np.ndarray, "T N"]
    """Whether the episode was still going on."""
    action: Float[np.ndarray, "T N 8"]
    velocity_rad_s: Float[np.ndarray, "T N 7"]
    """Velocities of the joints at the end of each step."""
    success: Bool[np.ndarray, " N"]
    dropped: int
    """Contacts that the physics backend could not hold, of all episodes."""


def episode_keys(env: GraspEnv, per_object: int, seed: int) -> UInt32[np.ndarray, "objects per_object 2"]:
    """(objects, per_object, 2) keys whose resets take each object equally often."""
    drawn = jax.jit(jax.vmap(env.object_drawn))
    found: list[np.ndarray] = [np.empty((0, 2), np.uint32) for _ in env.table.names]
    key, lot = jax.random.PRNGKey(seed), 0
    while min(map(len, found)) < per_object:
        keys = jax.random.split(jax.random.fold_in(key, lot), 2 * per_object * len(found))
        index, lot = np.asarray(drawn(keys)), lot + 1
        found = [np.concatenate([have, keys[index == i]]) for i, have in enumerate(found)]
    return np.stack([have[:per_object] for have in found])


def record(env: GraspEnv, policy: TeacherPolicy, keys: UInt32[np.ndarray, "N 2"]) -> Trials:
    """The deterministic `policy` in the episodes of `keys` (N, 2)."""
    seen = roll_out(env, policy, keys, _scene_and_motion)
    kept = seen.kept
    return Trials(
        params=seen.params,
        qpos=kept["qpos"],
        touched=np.logical_or.accumulate(kept["touching"], axis=0),
        running=seen.running,
        action=kept["action"],
        velocity_rad_s=kept["velocity_rad_s"],
        success=seen.success,
        dropped=seen.dropped,
    )


def _scene_and_motion(before: State, action: jax.Array, after: State) -> dict[str, jax.Array]:
    touching = jnp.any(before.data.touch > TOUCH_N, axis=-1)
    return {"qpos": before.data.qpos, "touching": touching} | motion_of(before, action, after)


def measure(
    env: GraspEnv, policy: TeacherPolicy, trials: int, watched: int, seed: int, progress: Progress
) -> tuple[dict, dict[str, np.ndarray]]:
    """Success, motion and visibility over `trials` episodes of each object.

    Args:
      env: objects, randomisation and backend.
      trials: episodes of each object.
      watched: how many of them the camera watches; pictures take longer than physics.
      seed: of the episodes.

    Returns:
      What `ppo.evaluate.evaluate` returns, its motion rows with `visible_object_pixels_mean` and `_min`
      (pixels of the object in the student's crop, over all steps before the first contact) and the
      `contacts_dropped` of their episodes added; and (5, H, W, 3) uint8 pictures per object of one episode at
      `ppo.visible.MOMENTS`.

    Raises UserError for a renderer that cannot run here, before any episode.
    """
    watcher = Watcher(env)
    recorded: list[Trials] = []
    keys = episode_keys(env, trials, seed)
    with progress.task("episodes", keys[..., 0].size) as task:
        for some in keys:
            recorded.append(record(env, policy, some))
            task.advance(trials)
    watch = [_first(some, min(watched, trials)) for some in recorded]
    pixels, pictures = [], {}
    for i, some in enumerate(progress.track(watch, "pictures")):
        before = some.running & ~some.touched
        pixels.append(watcher.visible_pixels(some.qpos, some.params, i, before, seed))
        pictures[env.table.names[i]] = _story(watcher, some, i)
    names = env.table.names
    rows = [_row(name, [r], [p]) for name, r, p in zip(names, recorded, pixels, strict=True)]
    rows.append(_row("all", recorded, pixels))
    counts = {name: counted(some.success) for name, some in zip(names, recorded, strict=True)}
    result = {
        "success": counted(np.concatenate([some.success for some in recorded])),
        "objects": counts,
        "saturated_actions": rows[-1]["saturated_actions"],
        "motion": rows,
        "contacts_dropped": rows[-1]["contacts_dropped"],
    }
    return result, pictures


def _story(watcher: Watcher, watched: Trials, index: int) -> np.ndarray:
    """Pictures of the first successful episode, or of the first."""
    n = int(np.argmax(watched.success))
    steps = moments(watched.qpos[:, n], watched.touched[:, n], watched.running[:, n])
    params = jax.tree.map(lambda leaf: leaf[n], watched.params)
    return watcher.pictures(watched.qpos[steps, n], params, index)


def _first(trials: Trials, count: int) -> Trials:
    """The first `count` episodes; contacts dropped stay those of all."""
    per_step = ("qpos", "touched", "running", "action", "velocity_rad_s")
    return Trials(
        params=jax.tree.map(lambda leaf: leaf[:count], trials.params),
        success=trials.success[:count],
        dropped=trials.dropped,
        **{name: getattr(trials, name)[:, :count] for name in per_step},
    )


def _row(name: str, recorded: Sequence[Trials], pixels: Sequence[np.ndarray]) -> dict:
    def joined(field: str) -> np.ndarray:
        return np.concatenate([getattr(some, field) for some in recorded], axis=1)

    seen = np.concatenate(pixels)
    motion = motion_metrics(joined("velocity_rad_s"), joined("action"), joined("running"))
    visible = {"mean": float(seen.mean()), "min": int(seen.min())}
    pixels_by_name = {f"visible_object_pixels_{k}": v for k, v in visible.items()}
    dropped = sum(some.dropped for some in recorded)
    return {"object": name} | motion | pixels_by_name | {"contacts_dropped": dropped}
