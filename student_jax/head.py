"""Training the action head: on true poses with noise first, on what perception reports last."""

import math
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
from jaxtyping import Float

from ddgrasp.config import Config
from ddgrasp.errors import UserError
from ddgrasp.progress import Progress
from demos.rollout import Roller
from learning.loop import Metrics, run_steps
from learning.params import load_params, save_params
from learning.prefetch import Prefetched
from learning.train_state import TrainState
from ppo.policy import TeacherPolicy
from ppo.warmup import guide_share
from student_jax import train
from student_jax.data import Frames, make_frames, random_crops, sharpen_gripper
from student_jax.policy import Seen
from student_jax.privileged import PoseActor, noisy_seen

POSES = "poses.msgpack"
"""The pictureless episodes in the stage's directory; `fit_on_perception` goes on using them."""
LOG_EVERY = 100
_SEED = 45_000
_POSES_PHASE, _PERCEPTION_PHASE = _SEED, _SEED + 1
"""Rounds of DAgger, which count from 1, have the numbers below."""
_ENCODE_BATCH = 64
_COLUMNS = ("state", "action", "observation", "held")

Samples = tuple[Seen, Float[np.ndarray, "B 9"], Float[np.ndarray, "B chunk 8"]]
"""What perception reports, the robot's state, action chunk."""


def fit_on_poses(
    config: Config, teacher: TeacherPolicy, params: dict, directory: Path, progress: Progress
) -> tuple[dict, dict[str, float]]:
    """DAgger without pictures (`student_jax.privileged`), which is cheap.

    Returns:
        `params` with the head trained, and {"rollout_success", "head_loss"} of the last round.
    """
    student, rounds = config.student, config.student.poses.rounds
    steps = rounds * student.poses.steps
    state = train.init_state(student, steps, config.seed, train.head_of(params), _POSES_PHASE)
    roller = Roller(config, teacher, student.poses.episodes, with_depth=False)
    rng = np.random.default_rng([config.seed, _SEED])
    columns: dict[str, list[np.ndarray]] = {name: [] for name in _COLUMNS}
    rate, metrics = 0.0, {"loss": np.float32(0.0)}
    with progress.task("head, on poses", steps) as task:
        for i in range(rounds):
            head = jax.tree.map(np.asarray, state.ema) if i else None
            actor = PoseActor(
                head, student, config.world.profile, rng, student.poses.episodes, guide_share(i, rounds)
            )
            key = jax.random.fold_in(jax.random.PRNGKey(_SEED + config.seed), i)
            episodes = roller.run(key, actor)
            for name in _COLUMNS:
                whole = getattr(episodes, name)
                columns[name] += [whole[j, :n].astype(np.float32) for j, n in enumerate(episodes.length)]
            rate = float(episodes.success.mean())
            poses = _poses(columns)
            for _ in range(student.poses.steps):
                samples = _from_poses(config, poses, rng, student.head.batch_size)
                state, metrics = _step(config, steps, state, samples)
                task.advance()
            loss = float(metrics["loss"])
            if not math.isfinite(loss):
                raise UserError(
                    f"head, on poses: loss is not finite after {(i + 1) * student.poses.steps} steps: the "
                    "training has diverged; begin anew with a smaller student.training.learning_rate."
                )
            task.advance(0, loss=loss, success=rate)
            progress.scalars(i, pose_loss=loss, pose_success=rate)
    lengths = np.array([len(x) for x in columns["held"]])
    saved = {name: np.concatenate(parts) for name, parts in columns.items()} | {"lengths": lengths}
    save_params(directory / POSES, saved)
    trained = jax.tree.map(np.asarray, state.ema)
    return params | trained, {"rollout_success": rate, "head_loss": float(metrics["loss"])}


def fit_on_perception(
    config: Config, params: dict, frames: Frames, directory: Path, progress: Progress
) -> tuple[dict, dict[str, float]]:
    """The head on what `params` see in every frame, and on as many noisy poses if there are any."""
    student, steps = config.student, config.student.head.train_steps
    rng = np.random.default_rng([config.seed, _SEED, 1])
    seen = _encode_all(config, params, frames, rng, progress)
    chunks = sharpen_gripper(frames.action_chunks(np.arange(len(frames)), student.head.chunk))
    poses = _load_poses(directory / POSES)
    state = train.init_state(student, steps, config.seed, train.head_of(params), _PERCEPTION_PHASE)
    count = student.head.batch_size if poses is None else student.head.batch_size // 2

    def step_once(state: TrainState, _: int) -> tuple[TrainState, Metrics]:
        index = frames.draw(rng, count, student.training.held_weight)
        samples = jax.tree.map(lambda x: x[index], (seen, frames.state, chunks))
        if poses is not None:
            samples = _join(samples, _from_poses(config, poses, rng, student.head.batch_size - count))
        return _step(config, steps, state, samples)

    # No checkpoints: every draw depends on those before, and the steps take less time than the features.
    state, metrics = run_steps(
        state, steps, step_once, None,
        label="head, on perception", progress=progress, curve="head_", log_every=LOG_EVERY,
    )  # fmt: skip
    return params | jax.tree.map(np.asarray, state.ema), {"head_loss": metrics["loss"]}


def _step(config: Config, steps: int, state: TrainState, samples: Samples) -> tuple[TrainState, Metrics]:
    # Samples cost nothing here: more of them serve better than more noises for each.
    student = replace(config.student, training=replace(config.student.training, noise_draws=1))
    return train.head_step(student, config.world.profile, steps, state, *samples)


def _from_poses(config: Config, poses: Frames, rng: np.random.Generator, count: int) -> Samples:
    index = poses.draw(rng, count, config.student.training.held_weight)
    bias = rng.standard_normal((count, 5))
    seen = noisy_seen(poses.observation[index], poses.held[index], bias, rng, config.student)
    return seen, poses.state[index], sharpen_gripper(poses.action_chunks(index, config.student.head.chunk))


def _join(a: Samples, b: Samples) -> Samples:
    return jax.tree.map(lambda x, y: np.concatenate([x, y]), a, b)


def _encode_all(config: Config, params: dict, frames: Frames, rng, progress: Progress) -> Seen:
    """What perception reports of all frames, each under one random crop and disparity noise."""
    student, profile, parts = config.student, config.world.profile, []
    count = -(-len(frames) // _ENCODE_BATCH)

    def inputs(number: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        first = number * _ENCODE_BATCH
        index = np.minimum(np.arange(first, first + _ENCODE_BATCH), len(frames) - 1)
        crops = random_crops(rng, _ENCODE_BATCH, profile, student.training.crop_shift_px)
        return frames.depth_stack(index), frames.state[index], crops

    with Prefetched(inputs, count) as batches:
        for number in progress.track(range(count), "features", count):
            key = jax.random.fold_in(jax.random.key(config.seed), number * _ENCODE_BATCH)
            seen = train.encode(student, profile, params, *batches(number), key)
            parts.append(jax.tree.map(np.asarray, seen))
    return jax.tree.map(lambda *x: np.concatenate(x)[: len(frames)], *parts)


def _poses(columns: dict[str, list[np.ndarray]]) -> Frames:
    return make_frames([], *(columns[name] for name in _COLUMNS))


def _load_poses(path: Path) -> Frames | None:
    if not path.exists():
        return None
    saved = load_params(path)
    bounds = np.cumsum(saved["lengths"])[:-1]
    return _poses({name: np.split(saved[name], bounds) for name in _COLUMNS})
