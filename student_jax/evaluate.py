"""A student in new scenes of its own simulation, on clean depth and on its depth source's: success in a
closed loop, and what perception is off by there, to be held against its error on the frames of training."""

from typing import Any

import jax
import numpy as np

from ddgrasp.config import Config
from ddgrasp.contract import counted
from ddgrasp.progress import Progress
from demos.rollout import Episodes, Roller
from demos.spool import Spool
from ppo.policy import TeacherPolicy
from student_jax.act import SourceCamera, StudentActor, keep_clean, perceive
from student_jax.data import aux_targets, make_frames
from student_jax.depth_source import DepthSource
from student_jax.policy import position_to_world

_SEED = 50_000
_FIRST_EPISODE = 1_000_000
"""Numbers of the source's episodes here, far from those of training."""
LOOKS = 8
"""Frames of an episode on which perception is measured, evenly spread over those before the grasp."""


def closed_loop(
    config: Config, teacher: TeacherPolicy, source: DepthSource, params: Any, progress: Progress
) -> dict[str, Any]:
    """`student_clean` and `student_ddg` (the source's depth), same seeds: counts per object and in all, and
    `position_error_mm`, the median before the grasp, where anything has trained perception."""
    roller = Roller(config, teacher, config.evaluation.student_trials, source.needs_rgb)
    cameras = {
        "student_clean": keep_clean,
        "student_ddg": SourceCamera(source, first=_FIRST_EPISODE),
    }
    metrics = {}
    for name, camera in cameras.items():
        rng = np.random.default_rng([config.seed, _SEED])
        actor = StudentActor(
            params, config.student, config.world.profile, camera, rng, config.deploy.noise,
            keep=progress.directory,
        )  # fmt: skip
        with progress.task(f"steps of {roller.count} trials, {name}", roller.steps) as task:
            episodes = roller.run(jax.random.PRNGKey(_SEED + config.seed), actor, lambda _: task.advance())  # noqa: B023
        metrics[name] = _counts(episodes, config.world.objects)
        if config.student.training.aux_weight or config.student.init_from:
            metrics[name]["position_error_mm"] = position_error_mm(config, params, episodes, actor.seen)
        best = int(np.argmax(episodes.success))
        length = min(len(actor.seen), int(episodes.length[best]))
        strip = actor.seen.episode(best, length)[np.linspace(0, length - 1, 6).astype(int)]
        progress.picture(name, **{"depth the student saw": strip})
    return metrics


def position_error_mm(config: Config, params: Any, episodes: Episodes, seen: Spool) -> float:
    """Median distance of the perceived grasp from the true one, over `LOOKS` frames of each episode."""
    errors_m = []
    for number in range(len(episodes.length)):
        length = min(len(seen), int(episodes.length[number]))
        columns = (episodes.state, episodes.action, episodes.observation, episodes.held)
        frames = make_frames([seen.episode(number, length)], *([x[number, :length]] for x in columns))
        grasped = np.flatnonzero(frames.held)
        before = int(grasped[0]) if len(grasped) else length
        if not before:
            continue
        at = np.linspace(0, before - 1, LOOKS).astype(int)
        aux = perceive(config.student, config.world.profile, params, frames.depth_stack(at), frames.state[at])
        truth = aux_targets(frames.observation[at], frames.held[at])
        away_m = np.asarray(position_to_world(aux.position)) - np.asarray(position_to_world(truth.position))
        errors_m.append(np.linalg.norm(away_m, axis=1))
    return 1e3 * float(np.median(np.concatenate(errors_m)))


def _counts(episodes: Episodes, names: tuple[str, ...]) -> dict[str, Any]:
    of = {name: episodes.success[episodes.object_index == i] for i, name in enumerate(names)}
    objects = {name: counted(won) for name, won in of.items()}
    return {"success": counted(episodes.success), "per_object": objects}
