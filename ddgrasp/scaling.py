"""A preset in small: every count of work times one factor, so that a whole run can be tried in minutes.

Networks, pictures, episodes and the time step stay as they are: what is built and compiled is the real thing,
batch sizes apart. What comes out of it is good for nothing.
"""

import dataclasses
from collections.abc import Mapping
from typing import Any

from ddgrasp.config import Config

SCALED: dict[str, int] = {
    "teacher.total_steps": 1,
    "teacher.num_envs": 64,
    "teacher.minibatches": 1,
    "teacher.clone_rounds": 1,
    "teacher.clone_envs": 16,
    "teacher.clone_steps": 2,
    "teacher.critic_warmup": 1,
    "demos.episodes": 2,
    "demos.parallel": 4,
    "record.trajectories": 2,
    "ddg.training.steps": 2,
    "ddg.training.batch_size": 2,
    "ddg.training.distil_steps": 2,
    "ddg.sampling.steps": 1,
    "ddg.sampling.batch_size": 2,
    "student.head.train_steps": 2,
    "student.head.batch_size": 8,
    "student.training.steps": 2,
    "student.training.batch_size": 2,
    "student.poses.rounds": 1,
    "student.poses.episodes": 4,
    "student.poses.steps": 2,
    "student.dagger.rounds": 1,
    "student.dagger.episodes": 2,
    "student.dagger.steps": 2,
    "export.parity_batches": 2,
    "export.latency_runs": 20,
    "deploy.realtime_trials": 1,
    "deploy.workers": 1,
    "evaluation.teacher_trials": 6,
    "evaluation.student_trials": 2,
    "evaluation.rig_trials": 2,
}
"""Field -> what it never falls below, or its own value where that is less; 0 stays 0."""

KEPT = (
    "world.episode_steps", "world.reward.bonus_max_count", "teacher.unroll_steps", "teacher.epochs",
    "teacher.eval_every", "teacher.checkpoint_every", "record.frames", "ddg.diffusion.steps",
    "ddg.training.checkpoint_every", "ddg.training.distil_from", "student.training.noise_draws",
    "student.training.demo_held_steps", "student.training.demo_stretch_steps", "student.head.diffusion_steps",
    "student.head.ddim_steps", "export.ddim_steps", "deploy.film_every",
)  # fmt: skip
"""Counts that stay: lengths of an episode, intervals, steps of the forward process."""


def scaled(config: Config, factor: float) -> Config:
    """`config` with the counts of SCALED times `factor` (0 to 1), and `factor` in its field `scale`.

    The number of environments remains a multiple of the number of minibatches.
    """
    values: Any = {name: _scaled(value_of(config, name), factor, least) for name, least in SCALED.items()}
    minibatches = values["teacher.minibatches"]
    values["teacher.num_envs"] = minibatches * max(1, values["teacher.num_envs"] // minibatches)
    return with_values(config, values | {"scale": float(factor)})


def value_of(config: Any, name: str) -> Any:
    """The value of the field with the dotted `name`."""
    for part in name.split("."):
        config = getattr(config, part)
    return config


def _scaled(count: int, factor: float, least: int) -> int:
    return count if factor == 1 else min(count, max(least, round(count * factor)))


def with_values(section: Any, values: Mapping[str, Any]) -> Any:
    """The dataclass `section` with other values in it, by dotted name, all at once."""
    own = {name: value for name, value in values.items() if "." not in name}
    for part in {name.partition(".")[0] for name in values if "." in name}:
        inner = {name.partition(".")[2]: v for name, v in values.items() if name.startswith(f"{part}.")}
        own[part] = with_values(getattr(section, part), inner)
    return dataclasses.replace(section, **own)
