"""Stage `demos`: teacher -> successful episodes with clean depth on disk (paper III-C1)."""

import jax
import numpy as np

from ddgrasp.artifacts import Artifact
from ddgrasp.config import Config
from ddgrasp.errors import UserError
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


def run(job: Job) -> Artifact:
    """Collects `config.demos.episodes` successful episodes, going on from what is there."""
    store = EpisodeStore(job.directory / STORE, create=True)
    teacher = teacher_policy.load(job.parents["teacher"].directory)
    tried = collect(job.config, teacher, store, job.progress)
    _picture(store, job.progress)
    metrics = {"episodes": len(store), "steps": int(store.ends[-1]), "tried_now": tried}
    return job.finish(metrics)


def collect(config: Config, teacher: TeacherPolicy, store: EpisodeStore, progress: Progress) -> int:
    """Fills `store` up to the configured number; returns how many episodes were tried."""
    demos = config.demos
    tried = succeeded = idle = 0
    with progress.task("demos", demos.episodes) as task:
        task.start_at(len(store))
        roller = Roller(config, teacher, demos.parallel, with_rgb=demos.rgb, keep=store.path.parent)
        while (have := len(store)) < demos.episodes:
            # Keyed by what is there, so that a resumed collection does not repeat episodes, and by how many
            # batches have added nothing to it.
            key = jax.random.fold_in(jax.random.PRNGKey(_SEED + config.seed), have)
            key = jax.random.fold_in(key, idle) if idle else key
            rng = np.random.default_rng([config.seed, _SEED, have, idle])
            actor = noisy_teacher(rng, demos.parallel, demos.action_noise, demos.noise_share)
            episodes = roller.run(key, actor)
            tried += demos.parallel
            for steps, episode in successful(episodes):
                succeeded += 1
                if len(store) < demos.episodes:
                    store.append(steps, episode)
                    task.advance()
            idle = idle + 1 if len(store) == have else 0
            if len(store) < demos.episodes and tried >= _FAIR_TRIAL and _MAX_TRIES * succeeded < tried:
                raise UserError(
                    f"The teacher succeeded in {succeeded} of {tried} episodes: train it longer "
                    "(teacher.total_steps) before collecting demos."
                )
    return tried


def _picture(store: EpisodeStore, progress: Progress) -> None:
    """A film strip of the first episode."""
    end = int(store.ends[0])
    shown = np.linspace(0, end - 1, 6).astype(int)
    panels = {"clean depth": store.steps("depth_mm", 0, end)[shown]}
    if "rgb" in store.fields:
        panels["colour"] = store.steps("rgb", 0, end)[shown]
    progress.picture("demos", **panels)
