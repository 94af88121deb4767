"""Training loop: iterations, evaluations, checkpoints, curves."""

import dataclasses
from functools import partial
from pathlib import Path

import jax
import numpy as np
import orbax.checkpoint as ocp

from ddgrasp import artifacts
from ddgrasp.config import Config, WorldConfig
from ddgrasp.errors import UserError
from ddgrasp.progress import Progress
from mjx_envs.grasp_env import AutoReset, GraspEnv
from ppo import learner
from ppo.evaluate import evaluate
from ppo.policy import PARAMS_FILE, TeacherPolicy, from_learner, load_state, save
from ppo.warmup import clone_guide

CHECKPOINTS = "checkpoints"
BEST_RATE = "best.json"
LOG_EVERY = 5
_KEPT = 2
_EVAL_SEED = 10_000


def train(config: Config, directory: Path, progress: Progress) -> learner.LearnerState:
    """Trains in `directory`, going on from its newest checkpoint if it has one.

    Leaves the policy that did best in an evaluation in `ppo.policy.PARAMS_FILE`, or the last one if there
    was no evaluation.
    """
    teacher = config.teacher
    _check(config)
    env = AutoReset(GraspEnv(training_world(config)))
    test_env = GraspEnv(config.world)
    iterate = jax.jit(partial(learner.iteration, teacher, env), donate_argnums=0)
    total = learner.iterations(teacher)
    options = ocp.CheckpointManagerOptions(max_to_keep=_KEPT, enable_async_checkpointing=False)
    with ocp.CheckpointManager((directory / CHECKPOINTS).absolute(), options=options) as manager:
        state = _start(config, env, manager, progress)
        good_evaluations = 0
        best = _Best(directory)
        if int(state.iteration) == 0:
            best.offer(_evaluate(test_env, state, config, 0, progress), state)
        with progress.task("PPO", total) as task:
            task.start_at(int(state.iteration))
            for i in range(int(state.iteration) + 1, total + 1):
                state, metrics = iterate(state)
                if i % LOG_EVERY == 0 or i == total:
                    _log(i, metrics, progress, task)
                task.advance()
                if i % teacher.eval_every == 0:
                    rate = _evaluate(test_env, state, config, i, progress)
                    best.offer(rate, state)
                    good_evaluations = good_evaluations + 1 if rate >= teacher.stop_at else 0
                if i % teacher.checkpoint_every == 0 or i == total:
                    manager.save(i, args=ocp.args.StandardSave(state), force=True)
                    manager.wait_until_finished()
                if good_evaluations >= 2:
                    progress.note(f"two evaluations in a row reached {teacher.stop_at:.0%}: done early")
                    break
        best.offer(0.0, state)
    return state


class _Best:
    """Keeps the policy of the best evaluation on disk; the later one of equals."""

    def __init__(self, directory: Path):
        self._directory = directory
        self._rate = -1.0
        if (directory / BEST_RATE).exists() and (directory / PARAMS_FILE).exists():
            self._rate = float(artifacts.read_json(directory / BEST_RATE))

    def offer(self, rate: float, state: learner.LearnerState) -> None:
        if rate >= self._rate:
            self._rate = rate
            save(self._directory / PARAMS_FILE, state.normalizer, state.params.policy)
            artifacts.atomic_write_json(self._directory / BEST_RATE, rate)


def training_world(config: Config) -> WorldConfig:
    """The world with the exploring starts that only training has."""
    random = dataclasses.replace(config.world.random, pregrasp_share=config.teacher.pregrasp_share)
    return dataclasses.replace(config.world, random=random)


def policy_of(state: learner.LearnerState) -> TeacherPolicy:
    """The deterministic policy of a learner."""
    return from_learner(state.normalizer, state.params.policy)


def _check(config: Config) -> None:
    if config.teacher.num_envs % config.teacher.minibatches:
        raise UserError(
            f"teacher.num_envs {config.teacher.num_envs} is no multiple of teacher.minibatches "
            f"{config.teacher.minibatches}: change one of them."
        )


def _start(
    config: Config, env: AutoReset, manager: ocp.CheckpointManager, progress: Progress
) -> learner.LearnerState:
    state = jax.jit(partial(learner.init, config.teacher, env))(jax.random.PRNGKey(config.seed))
    if manager.latest_step() is None:
        if config.teacher.init_from:
            return learner.warm_start(state, load_state(config.teacher.init_from))
        if config.teacher.clone_rounds:
            state = clone_guide(config.teacher, GraspEnv(config.world), state, config.seed, progress)
            manager.save(0, args=ocp.args.StandardSave(state), force=True)
            manager.wait_until_finished()
        return state
    restored = manager.restore(manager.latest_step(), args=ocp.args.StandardRestore(state))
    assert isinstance(restored, learner.LearnerState)
    return restored


def _log(i: int, metrics, progress: Progress, task) -> None:
    values = {name: float(value) for name, value in metrics.items()}
    for name, value in values.items():
        if not np.isfinite(value):
            raise UserError(f"PPO diverged at iteration {i}: {name} is {value}. Lower teacher.learning_rate.")
    progress.scalars(i, **values)
    task.advance(0, success=values["success"])


def _evaluate(env: GraspEnv, state, config: Config, i: int, progress: Progress) -> float:
    result = evaluate(env, policy_of(state), min(256, config.evaluation.teacher_trials), _EVAL_SEED)
    rate = result["success"]["successes"] / result["success"]["n"]
    steps = i * config.teacher.num_envs * config.teacher.unroll_steps
    progress.scalars(i, eval_success=rate, eval_saturated=result["saturated_actions"])
    objects = "  ".join(f"{k} {v['successes']}/{v['n']}" for k, v in result["objects"].items())
    progress.note(f"after {steps / 1e6:.2f} M steps: success {rate:.3f} ({objects})")
    return rate
