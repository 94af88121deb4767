"""What a student perceives of its run's demonstrations, with the errors on their depth that it learnt from.

The other side of `evaluation.perception`, which looks at the rig.
"""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Int

from ddg_jax.generate import Clip
from ddgrasp import artifacts
from ddgrasp.config import Config
from ddgrasp.progress import Progress
from demos.store import STORE, EpisodeStore
from evaluation.perception import Errors, Seen, errors, tabulate
from learning.params import load_params
from mjx_envs.randomize import ObjectTable
from student_jax.act import perceive
from student_jax.data import Frames, make_frames
from student_jax.depth_source import DepthSource, check_demos, make_source
from student_jax.frames_io import views_of
from student_jax.policy import PARAMS_FILE


def measure(config: Config, run_dir: Path, trials: int, progress: Progress) -> list[dict[str, Any]]:
    """Rows of `tabulate` of the first `trials` demonstrations of every object: whole ones, all of them with
    errors on their depth.

    Raises UserError where the run has no demonstrations, or they lack what the student's depth source needs.
    """
    demos = EpisodeStore(artifacts.read_artifact(run_dir / "demos").directory / STORE)
    source = make_source(config, run_dir / "ddg")
    check_demos(source, demos)
    params = load_params(run_dir / "student" / PARAMS_FILE)
    table, variants = ObjectTable(config.world.objects), demos.episodes("variant")
    chosen = _first_of_each(demos.episodes("object_index"), trials)
    parts = []
    with progress.task("perception", len(chosen)) as task:
        for number, frames in zip(chosen, _with_errors(demos, source, chosen), strict=True):
            parts.append(_errors(config, params, frames, table.variants[variants[number]].grasp_symmetry))
            task.advance()
    names = [config.world.objects[index] for index in demos.episodes("object_index")[chosen]]
    return tabulate(parts, [True] * len(parts), names)


def _first_of_each(objects: Int[np.ndarray, " N"], count: int) -> list[int]:
    """Which episodes are the first `count` of each object's, in their order."""
    first = [np.flatnonzero(objects == index)[:count] for index in np.unique(objects)]
    return sorted(np.concatenate(first).tolist())


def _with_errors(demos: EpisodeStore, source: DepthSource, chosen: Sequence[int]) -> Iterator[Frames]:
    """The chosen demonstrations as a student sees them, an episode each."""
    begins = [0, *demos.ends.tolist()]
    rows = [(begins[number], begins[number + 1]) for number in chosen]

    def read(i: int) -> Clip:
        rgb = demos.steps("rgb", *rows[i]) if source.needs_rgb else None
        views = views_of(demos, chosen[i], rows[i]) if source.needs_views else None
        return Clip(chosen[i], demos.steps("depth_mm", *rows[i]), rgb, views)

    seen = source.episodes([stop - start for start, stop in rows], read)
    for place, depth_mm in zip(rows, seen, strict=True):
        columns = (demos.steps(name, *place) for name in ("state", "action", "observation", "held"))
        yield make_frames([depth_mm], *([column] for column in columns))


def _errors(config: Config, params: Any, frames: Frames, symmetry: int) -> Errors:
    depth = frames.depth_stack(np.arange(len(frames)))
    seen = Seen(list(depth), list(frames.state), list(frames.observation), list(frames.held > 0), symmetry)
    return errors(seen, perceive(config.student, config.world.profile, params, depth, frames.state))
