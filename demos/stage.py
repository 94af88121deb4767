"""Stage `demos`: teacher -> successful episodes with clean depth on disk (paper III-C1)."""

import contextlib
from dataclasses import dataclass

import jax
import numpy as np

from ddgrasp.artifacts import Artifact
from ddgrasp.config import Config
from ddgrasp.errors import UserError
from ddgrasp.files import atomic_write_json, read_json
from ddgrasp.job import Job
from ddgrasp.progress import Progress
from demos.rollout import Roller, noisy_teacher, successful
from demos.store import STORE, EpisodeStore
from ppo import policy as teacher_policy
from ppo.policy import TeacherPolicy

_SEED = 30_000
_MAX_TRIES = 4
"""Give up when less than one attempt in this many succeeds."""
_FAIR_TRIAL = 60
"""Episodes to try before that is judged."""
BATCHES = ".batches.json"
"""Beside the store: `_Batches` as the last whole one left them."""


@dataclass(frozen=True)
class _Batches:
    """What whole batches have come to, whence an interrupted collection goes on as if it had not been."""

    stored: int = 0
    """Episodes."""
    tried: int = 0
    succeeded: int = 0
    idle: int = 0
    """How many have added nothing since one did."""

    def after(self, stored: int, tried: int, succeeded: int) -> "_Batches":
        """These and another, after which so many episodes are stored."""
        idle = self.idle + 1 if stored == self.stored else 0
        return _Batches(stored, self.tried + tried, self.succeeded + succeeded, idle)

    def check(self) -> None:
        """UserError if the teacher fails too often, by a fair trial."""
        if self.tried >= _FAIR_TRIAL and _MAX_TRIES * self.succeeded < self.tried:
            raise UserError(
                f"The teacher succeeded in {self.succeeded} of {self.tried} episodes: train it longer "
                "(teacher.total_steps) before collecting demos."
            )


def run(job: Job) -> Artifact:
    """Collects `config.demos.episodes` successful episodes, going on from what is there."""
    store = EpisodeStore(job.directory / STORE, create=True)
    teacher = teacher_policy.load(job.parents["teacher"].directory)
    tried = collect(job.config, teacher, store, job.progress)
    _picture(store, job.progress)
    metrics = {"episodes": len(store), "steps": int(store.ends[-1]), "tried_now": tried}
    return job.finish(metrics)


def collect(config: Config, teacher: TeacherPolicy, store: EpisodeStore, progress: Progress) -> int:
    """Fills `store` up to the configured number; returns how many episodes were tried, in earlier attempts
    too."""
    demos, batches = config.demos, _read_batches(store)
    with progress.task("demos", demos.episodes) as task:
        task.start_at(len(store))
        roller = Roller(config, teacher, demos.parallel, with_rgb=demos.rgb, keep=store.path.parent)
        atomic_write_json(store.path.parent / BATCHES, batches)
        while len(store) < demos.episodes:
            # Keyed by what is there, and by how many batches have added nothing to it: a batch that was
            # interrupted as it was stored comes out the same again, and what is there of it is passed over.
            there = len(store) - batches.stored
            key = jax.random.fold_in(jax.random.PRNGKey(_SEED + config.seed), batches.stored)
            key = jax.random.fold_in(key, batches.idle) if batches.idle else key
            rng = np.random.default_rng([config.seed, _SEED, batches.stored, batches.idle])
            actor = noisy_teacher(rng, demos.parallel, demos.action_noise, demos.noise_share)
            succeeded = 0
            for steps, episode in successful(roller.run(key, actor)):
                succeeded += 1
                if succeeded > there and len(store) < demos.episodes:
                    store.append(steps, episode)
                    task.advance()
            batches = batches.after(len(store), demos.parallel, succeeded)
            atomic_write_json(store.path.parent / BATCHES, batches)
            if len(store) < demos.episodes:
                batches.check()
    return batches.tried


def _read_batches(store: EpisodeStore) -> _Batches:
    """Where the collection of `store` stands; after all that is there, if nothing says so."""
    with contextlib.suppress(UserError, TypeError):
        batches = _Batches(**read_json(store.path.parent / BATCHES))
        if batches.stored <= len(store):
            return batches
    return _Batches(stored=len(store))


def _picture(store: EpisodeStore, progress: Progress) -> None:
    """A film strip of the first episode."""
    end = int(store.ends[0])
    shown = np.linspace(0, end - 1, 6).astype(int)
    panels = {"clean depth": store.steps("depth_mm", 0, end)[shown]}
    if "rgb" in store.fields:
        panels["colour"] = store.steps("rgb", 0, end)[shown]
    progress.picture("demos", **panels)
