"""The student's training plan: the head on poses, perception on demos and DAgger, the head on perception.

Phases in order: `poses`, `demos`, `dagger-1` ... `dagger-n` (Ross et al. 2011), `head`. `plan.json` names
the finished ones; a fit on pictures goes on from its own checkpoints (`learning.loop`). All draws are
keyed by seed, phase and step, so a resumed plan goes the way an uninterrupted one would, unless it was
stopped while it put away the episodes of a round of DAgger: those that are missing are acted anew.
"""

import contextlib
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np

from ddgrasp.config import Config, StudentConfig
from ddgrasp.errors import UserError
from ddgrasp.files import atomic_write_json, read_json
from ddgrasp.progress import Progress
from demos.rollout import Roller
from demos.store import EpisodeStore
from learning.loop import Metrics, run_steps
from learning.params import load_params, save_params
from learning.prefetch import Prefetched
from learning.train_state import TrainState
from ppo.policy import TeacherPolicy
from student_jax import device_frames, frames_io, head, pretrained_encoder, start, train
from student_jax.act import SourceCamera, StudentActor
from student_jax.data import CACHE, Frames, Window, learns_from_pictures
from student_jax.depth_source import DepthSource, check_demos
from student_jax.policy import PARAMS_FILE, init_params

PLAN = "plan.json"
ACTED = "acted.json"
"""How the last round of DAgger went that was acted, for one that is interrupted after that."""
CHECKPOINTS = "checkpoints"
"""Folder of the unfinished fit on pictures; a folder in it per phase."""
LOG_EVERY = 20
_DAGGER_SEED = 40_000
_LAST_PHASE = "head"


class Trainer:
    """Runs the plan in `directory`."""

    def __init__(
        self,
        config: Config,
        teacher: TeacherPolicy,
        source: DepthSource,
        directory: Path,
        progress: Progress,
    ):
        self._config, self._student, self._profile = config, config.student, config.world.profile
        self._teacher, self._source = teacher, source
        self._directory, self._progress = directory, progress
        self._store = EpisodeStore(directory / CACHE, create=True, compressed=False)
        self._window = Window.seen(self._profile, self._student.training.crop_shift_px)
        self._done: list[str] = []
        self.history: list[dict[str, Any]] = []
        self.params: dict = {}

    def run(self, demos: EpisodeStore) -> None:
        """Every phase that is not finished; `params` is then the student. Demos get their depth only where
        something is trained on it."""
        check_demos(self._source, demos)
        self._restore()
        if _LAST_PHASE in self._done:  # stopped after that: what it was trained on may be gone
            return
        self._phase("poses", self._fit_on_poses)
        if learns_from_pictures(self._student):
            frames_io.add_noisy_demos(
                demos, self._store, self._source, self._config, self._progress, self._window
            )
        self._phase("demos", lambda: self._fit("demos", self._student.training.steps))
        for i in range(1, self._student.dagger.rounds + 1):
            self._phase(f"dagger-{i}", lambda i=i: self._dagger(i, len(demos)))
        self._phase(_LAST_PHASE, self._fit_on_perception)

    @property
    def frame_count(self) -> int:
        """Steps kept: samples, and those beside them that samples need."""
        if _LAST_PHASE in self._done:
            return self.history[-1]["frames"]
        return int(self._store.ends[-1]) if len(self._store) else 0

    def _frames(self) -> Frames:
        """All so far, on an accelerator that has room for them beside a training step."""
        room = device_frames.room_bytes(self._config)
        return frames_io.load(self._directory / CACHE, self._window, room)

    # --- phases ---

    def _phase(self, name: str, work: Callable[[], dict[str, float]]) -> None:
        if name in self._done:
            return
        measured = work()
        self._done.append(name)
        self.history.append({"phase": name, "frames": self.frame_count} | measured)
        # Under the name of its phase until the plan has it: who is killed in between does not train it twice.
        save_params(self._directory / _made_by(name), self.params)
        atomic_write_json(self._directory / PLAN, {"done": self._done, "history": self.history})
        self._take_over(name)
        shutil.rmtree(self._directory / CHECKPOINTS, ignore_errors=True)

    def _take_over(self, phase: str) -> None:
        """Makes the parameters of a finished phase the student's, unless they are."""
        with contextlib.suppress(FileNotFoundError):
            (self._directory / _made_by(phase)).replace(self._directory / PARAMS_FILE)

    def _restore(self) -> None:
        plan = self._directory / PLAN
        if plan.exists():
            state = read_json(plan)
            if not isinstance(state, dict) or not {"done", "history"} <= state.keys():
                raise UserError(f"{plan} is damaged: delete {self._directory} and begin anew.")
            self._done, self.history = state["done"], state["history"]
            self._take_over(self._done[-1])
            self.params = load_params(self._directory / PARAMS_FILE)
            self._progress.note(f"going on after phase {self._done[-1]!r}")
            return
        self.params = init_params(jax.random.key(self._config.seed), self._student, self._profile)
        if self._student.init_from:
            self.params = start.load(self._student, self.params)
            if change := start.change_of_pictures(self._student):
                self._progress.note(change)
        else:
            self.params["encoder"] = pretrained_encoder.load_into(self.params["encoder"], self._student)

    def _fit_on_poses(self) -> dict[str, float]:
        if self._student.poses.rounds == 0:
            return {}
        self.params, measured = head.fit_on_poses(
            self._config, self._teacher, self.params, self._directory, self._progress
        )
        return measured

    def _fit_on_perception(self) -> dict[str, float]:
        if self._student.head.train_steps == 0:
            return {}
        frames = self._frames()
        self.params, measured = head.fit_on_perception(
            self._config, self.params, frames, self._directory, self._progress
        )
        return measured

    def _dagger(self, number: int, demo_count: int) -> dict[str, float]:
        """One round: roll out if that was not done yet, then fit on everything."""
        student = self._student
        wanted = demo_count + number * student.dagger.episodes
        if len(self._store) < wanted:
            first = len(self._store)
            share = student.dagger.teacher_share * (1 - (number - 1) / max(1, student.dagger.rounds - 1))
            rng = np.random.default_rng([self._config.seed, _DAGGER_SEED, number])
            camera = SourceCamera(self._source, first)
            actor = StudentActor(
                self.params, student, self._profile, camera, rng, self._config.deploy.noise, share,
                keep=self._directory,
            )  # fmt: skip
            roller = Roller(self._config, self._teacher, wanted - first, self._source.needs_rgb)
            with self._progress.task(f"acting, round {number}", roller.steps) as task:
                key = jax.random.fold_in(jax.random.PRNGKey(_DAGGER_SEED + self._config.seed), number)
                there = first - (wanted - student.dagger.episodes)
                if there:  # resumed: other scenes than those
                    key = jax.random.fold_in(key, there)
                episodes = roller.run(key, actor, lambda _: task.advance())
            frames_io.add_rollouts(self._store, episodes, actor.seen, self._window)
            rate = float(episodes.success.mean())
            if not there:  # a rest says little of the round
                atomic_write_json(self._directory / ACTED, {"round": number, "rollout_success": rate})
            self._progress.note(f"round {number}: {rate:.0%} success with the teacher taking {share:.0%}")
        return self._acted(number) | self._fit(f"dagger-{number}", student.dagger.steps)

    def _acted(self, number: int) -> dict[str, float]:
        """Success of round `number`'s episodes, by this attempt or the one before; nothing if it is lost."""
        path = self._directory / ACTED
        last = read_json(path) if path.exists() else {}
        return {"rollout_success": last["rollout_success"]} if last.get("round") == number else {}

    def _fit(self, phase: str, steps: int) -> dict[str, float]:
        """`steps` optimiser steps on all frames, from the current parameters."""
        if steps == 0:
            return {}
        student, profile = self._student, self._profile
        frames = self._frames()
        trained, frozen = train.split(student, self.params)
        number = _phase_number(phase)

        def batch_of(step: int) -> train.Batch:
            rng = np.random.default_rng([self._config.seed, number, step])
            index = frames.draw(rng, student.training.batch_size, student.training.held_weight)
            return train.make_batch(frames, index, rng, student, profile)

        with Prefetched(batch_of, steps) as batches:

            def step_once(state: TrainState, step: int) -> tuple[TrainState, Metrics]:
                return train.train_step(student, profile, steps, state, frozen, batches(step))

            state, terms = run_steps(
                train.init_state(student, steps, self._config.seed, trained, number),
                steps,
                step_once,
                self._directory / CHECKPOINTS / phase,
                label=f"student, {phase}",
                progress=self._progress,
                first_point=_steps_before(student, number),
                log_every=LOG_EVERY,
                shown=train.told(student.training),
            )
        self.params = frozen | jax.tree.map(np.asarray, state.ema)
        return terms


def _made_by(phase: str) -> str:
    """Name of the file with a phase's parameters until they are the student's."""
    return f"params-{phase}.msgpack"


def _phase_number(phase: str) -> int:
    return 0 if phase == "demos" else int(phase.split("-")[1])


def _steps_before(student: StudentConfig, number: int) -> int:
    """Steps of the phases before that of this `_phase_number`: curves count on from there."""
    return student.training.steps + (number - 1) * student.dagger.steps if number else 0
