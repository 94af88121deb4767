"""Closed-loop success of a student in its own simulation, on clean depth and on its depth source's."""

from typing import Any

import jax
import numpy as np

from ddgrasp.config import Config
from ddgrasp.progress import Progress
from demos.rollout import Episodes, Roller
from ppo.policy import TeacherPolicy
from student_jax.act import SourceCamera, StudentActor, keep_clean
from student_jax.depth_source import DepthSource

_SEED = 50_000
_FIRST_EPISODE = 1_000_000
"""Numbers of the source's episodes here, far from those of training."""


def closed_loop(
    config: Config, teacher: TeacherPolicy, source: DepthSource, params: Any, progress: Progress
) -> dict[str, Any]:
    """`student_clean` and `student_ddg` (the source's depth): counts per object and in all, same seeds."""
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
        best = int(np.argmax(episodes.success))
        length = min(len(actor.seen), int(episodes.length[best]))
        strip = actor.seen.episode(best, length)[np.linspace(0, length - 1, 6).astype(int)]
        progress.picture(name, **{"depth the student saw": strip})
    return metrics


def _counts(episodes: Episodes, names: tuple[str, ...]) -> dict[str, Any]:
    success = {"successes": int(episodes.success.sum()), "n": len(episodes.success)}
    of = {name: episodes.success[episodes.object_index == i] for i, name in enumerate(names)}
    objects = {name: {"successes": int(won.sum()), "n": len(won)} for name, won in of.items()}
    return {"success": success, "per_object": objects}
