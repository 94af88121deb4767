"""Training loop: iterations, evaluations, checkpoints, curves."""

import dataclasses
import time
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import jax

from ddgrasp.config import GUIDE, Config, WorldConfig
from ddgrasp.files import atomic_write_json, read_json
from ddgrasp.progress import Progress
from learning.checkpoints import Checkpoints
from learning.programs import Program
from mjx_envs import devices
from mjx_envs.grasp_env import AutoReset, GraspEnv
from mjx_envs.physics.interface import dropped_warning
from ppo import health, hosts, learner, memory
from ppo.evaluate import evaluate
from ppo.policy import PARAMS_FILE, TeacherPolicy, from_learner, load_state, save
from ppo.warmup import clone_guide

CHECKPOINTS = "checkpoints"
BEST_RATE = "best.json"
LOG_EVERY = 5
_EVAL_SEED = 10_000


def train(config: Config, directory: Path, progress: Progress) -> learner.LearnerState:
    """Trains in `directory` on all devices of all processes, from its newest checkpoint if there is one.

    Leaves the policy that did best in an evaluation, of which the last is after the last iteration, in
    `ppo.policy.PARAMS_FILE`. Every process of `ppo.hosts` calls this, with the same directory.

    Raises UserError if the batch cannot be shared out over the devices or does not fit in memory, or if
    training diverges.
    """
    mesh = devices.make_mesh()
    learner.check_divisible(config.teacher, mesh.size)
    with memory.explained(config), Checkpoints(directory / CHECKPOINTS) as saved:
        return _train(config, directory, AutoReset(GraspEnv(training_world(config)), mesh), saved, progress)


def _train(
    config: Config, directory: Path, env: AutoReset, saved: Checkpoints, progress: Progress
) -> learner.LearnerState:
    teacher = config.teacher
    test_env = GraspEnv(config.world)
    total = teacher.iterations
    iterate = compile_iteration(config, env)
    state = _start(config, env, saved, progress)
    best = _Best(directory)
    if int(state.iteration) == 0:
        best.offer(_evaluate(test_env, state, config, 0, progress), state)
    with progress.task("PPO", total) as task:
        task.start_at(int(state.iteration))
        control_steps = teacher.num_envs * teacher.unroll_steps
        clock, counts = _Clock(control_steps), _Counts(control_steps)
        for i in range(int(state.iteration) + 1, total + 1):
            if int(state.good_evaluations) >= 2:  # before any work: a checkpoint may hold this already
                progress.note(f"two evaluations in a row reached {teacher.stop_at:.0%}: done early")
                break
            state, *scalars = iterate(state)
            metrics, watched = jax.device_get(scalars)
            health.check(i, watched, saved.latest, directory)
            counts.add(metrics)
            kept = i % teacher.checkpoint_every == 0 or i == total
            if kept or i % LOG_EVERY == 0:  # what goes on from a checkpoint knows no counts of before
                _log(i, metrics | clock.rate(i) | counts.told(progress), progress, task)
            task.advance()
            if i % teacher.eval_every == 0 or i == total:
                rate = _evaluate(test_env, state, config, i, progress)
                best.offer(rate, state)
                state = learner.with_evaluation(state, rate >= teacher.stop_at)
            if kept:
                saved.save(i, state)
    counts.told(progress)
    return state


def initial(config: Config, env: AutoReset) -> Callable[[], learner.LearnerState]:
    """A function without arguments that makes a fresh learner on the mesh of `env`."""
    key = jax.device_get(jax.random.PRNGKey(config.seed))
    places = learner.shardings(env.mesh)
    return partial(jax.jit(partial(learner.init, config.teacher, env), out_shardings=places), key)


def programs(config: Config, env: AutoReset) -> dict[str, Program]:
    """What an iteration calls, in this order, on the mesh of `env`: each takes what the last one returned."""
    places, everywhere = learner.shardings(env.mesh), devices.replicated(env.mesh)
    over_envs = devices.over_envs(env.mesh)
    state = jax.eval_shape(initial(config, env))
    collect = partial(learner.collect, config.teacher, env)
    collected = (places, over_envs, everywhere)
    improved = (places, everywhere, everywhere)
    return {
        "refresh": (
            jax.jit(
                partial(learner.refresh, config.teacher, env),
                in_shardings=(places,), out_shardings=places, donate_argnums=0,
            ),
            (state,),
        ),
        "collect": (
            jax.jit(collect, in_shardings=(places,), out_shardings=collected, donate_argnums=0), (state,)
        ),
        "improve": (
            jax.jit(
                partial(learner.improve, config.teacher, env.mesh),
                in_shardings=collected, out_shardings=improved, donate_argnums=0,
            ),
            jax.eval_shape(collect, state),
        ),
    }  # fmt: skip


Iterate = Callable[
    [learner.LearnerState], tuple[learner.LearnerState, dict[str, jax.Array], dict[str, jax.Array]]
]


def compile_iteration(config: Config, env: AutoReset) -> Iterate:
    """state -> (state, scalars for the curves, scalars for the NaN guard), an iteration later; UserError if
    that needs more than the memory there is.

    Compiled before anything else is done, so that a batch that does not fit is refused at once.
    """
    compiled = {
        name: jitted.lower(*shapes).compile() for name, (jitted, shapes) in programs(config, env).items()
    }
    for program in compiled.values():
        memory.check_compiled(config, env, program)

    def iterate(state):
        return compiled["improve"](*compiled["collect"](compiled["refresh"](state)))

    return iterate


def restore(config: Config, env: AutoReset, saved: Checkpoints) -> learner.LearnerState:
    """The newest checkpoint, laid on the mesh of `env`; it may have been made on another."""
    shapes = jax.eval_shape(initial(config, env))
    target = jax.tree.map(
        lambda x, place: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=place),
        shapes,
        jax.tree.broadcast(learner.shardings(env.mesh), shapes),
    )
    return saved.restore(target)


class _Best:
    """Keeps the policy of the best evaluation on disk, in the leading process; the later one of equals."""

    def __init__(self, directory: Path):
        self._directory = directory
        self._rate = -1.0
        if (directory / BEST_RATE).exists() and (directory / PARAMS_FILE).exists():
            self._rate = float(read_json(directory / BEST_RATE))

    def offer(self, rate: float, state: learner.LearnerState) -> None:
        """Keeps the policy of `state` if its success rate is no worse than the best one's."""
        if rate >= self._rate and hosts.leads():
            self._rate = rate
            save(self._directory / PARAMS_FILE, state.normalizer, state.params.policy)
            atomic_write_json(self._directory / BEST_RATE, rate)


class _Clock:
    """How fast training goes."""

    def __init__(self, steps_per_iteration: int):
        self._steps = steps_per_iteration
        self._last: tuple[int, float] | None = None

    def rate(self, iteration: int) -> dict[str, float]:
        """{"steps_per_s": control steps per second since it was asked last, evaluations included}; the first
        time nothing."""
        now, before = (iteration, time.monotonic()), self._last
        self._last = now
        if before is None:
            return {}
        return {"steps_per_s": (now[0] - before[0]) * self._steps / max(now[1] - before[1], 1e-9)}


class _Counts:
    """Sums of `learner.COUNTED` since they were told last."""

    def __init__(self, steps_per_iteration: int):
        self._per_iteration = steps_per_iteration
        self._sums: dict[str, float] = {name: 0.0 for name in learner.COUNTED}
        self._steps = 0

    def add(self, metrics: Mapping[str, Any]) -> None:
        """Counts those of an iteration."""
        self._sums = {name: count + float(metrics[name]) for name, count in self._sums.items()}
        self._steps += self._per_iteration

    def told(self, progress: Progress) -> dict[str, float]:
        """The sums by name, after a warning if contacts were dropped."""
        if warning := dropped_warning(self._sums["contacts_dropped"], self._steps):
            progress.note(warning)
        told = self._sums
        self._sums, self._steps = dict.fromkeys(told, 0.0), 0
        return told


def training_world(config: Config) -> WorldConfig:
    """The world with the exploring starts that only training has."""
    teacher = config.teacher
    random = dataclasses.replace(
        config.world.random,
        pregrasp_share=teacher.pregrasp_share,
        pregrasp_turn_rad=teacher.pregrasp_turn_rad,
        held_share=teacher.held_share,
    )
    return dataclasses.replace(config.world, random=random)


def policy_of(state: learner.LearnerState) -> TeacherPolicy:
    """The deterministic policy of a learner."""
    return from_learner(state.normalizer, state.params.policy)


def _start(config: Config, env: AutoReset, saved: Checkpoints, progress: Progress) -> learner.LearnerState:
    """The newest checkpoint; else what `config.teacher.start` says."""
    if saved.latest is not None:
        return restore(config, env, saved)
    state, places = initial(config, env)(), learner.shardings(env.mesh)
    if config.teacher.starts_from_file:
        return jax.device_put(learner.warm_start(state, load_state(config.teacher.start)), places)
    if config.teacher.start == GUIDE:
        cloned = clone_guide(config.teacher, GraspEnv(config.world), state, config.seed, progress)
        state = jax.device_put(learner.with_policy(state, *hosts.from_leader(cloned)), places)
        saved.save(0, state)
    return state


def _log(i: int, metrics, progress: Progress, task) -> None:
    values = {name: float(value) for name, value in metrics.items()}
    if values.get("episode/length") == 0.0:  # no episode ended: nothing to have a mean of
        values = {name: value for name, value in values.items() if name not in learner.OF_EPISODES}
    progress.scalars(i, **values)
    if "success" in values:
        task.advance(0, success=values["success"])


def _evaluate(env: GraspEnv, state, config: Config, i: int, progress: Progress) -> float:
    result = evaluate(env, policy_of(state), min(256, config.evaluation.teacher_trials), _EVAL_SEED)
    rate = result["success"]["successes"] / result["success"]["n"]
    steps = i * config.teacher.num_envs * config.teacher.unroll_steps
    progress.scalars(
        i, control_steps=steps, minutes=progress.seconds / 60, eval_success=rate,
        eval_saturated=result["saturated_actions"],
    )  # fmt: skip
    objects = "  ".join(f"{k} {v['successes']}/{v['n']}" for k, v in result["objects"].items())
    progress.note(f"after {steps / 1e6:.2f} M steps: success {rate:.3f} ({objects})")
    return rate
