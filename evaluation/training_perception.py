"""What a student perceives of its run's demonstrations, with the errors on their depth that it learnt from.

The other side of `evaluation.perception`, which looks at the rig.
"""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Int

from ddgrasp import artifacts
from ddgrasp.config import Config
from ddgrasp.progress import Progress
from evaluation.perception import Errors, Seen, errors, tabulate

if TYPE_CHECKING:
    from student_jax.data import Frames


def measure(config: Config, run_dir: Path, trials: int, progress: Progress) -> list[dict[str, Any]]:
    """Rows of `tabulate` of the first `trials` demonstrations of every object: whole ones, all of them with
    errors on their depth.

    Raises UserError where the run has no demonstrations, or they lack what the student's depth source needs.
    """
    from demos.store import STORE, EpisodeStore
    from mjx_envs.randomize import ObjectTable
    from student_jax.depth_source import check_demos, make_source
    from student_jax.frames_io import demos_with_errors
    from student_jax.policy import load

    demos = EpisodeStore(artifacts.read_artifact(run_dir / "demos").directory / STORE)
    source = make_source(config, run_dir / "ddg")
    check_demos(source, demos)
    _, params = load(run_dir)
    table, variants = ObjectTable(config.world.objects), demos.episodes("variant")
    chosen = _first_of_each(demos.episodes("object_index"), trials)
    parts = []
    with progress.task("perception", len(chosen)) as task:
        for number, frames in zip(chosen, demos_with_errors(demos, source, chosen), strict=True):
            parts.append(_errors(config, params, frames, table.variants[variants[number]].grasp_symmetry))
            task.advance()
    names = [config.world.objects[index] for index in demos.episodes("object_index")[chosen]]
    return tabulate(parts, [True] * len(parts), names)


def _first_of_each(objects: Int[np.ndarray, " N"], count: int) -> list[int]:
    """Which episodes are the first `count` of each object's, in their order."""
    first = [np.flatnonzero(objects == index)[:count] for index in np.unique(objects)]
    return sorted(np.concatenate(first).tolist())


def _errors(config: Config, params: Any, frames: "Frames", symmetry: int) -> Errors:
    from student_jax.act import perceive

    depth = frames.depth_stack(np.arange(len(frames)))
    seen = Seen(list(depth), list(frames.state), list(frames.observation), list(frames.held > 0), symmetry)
    return errors(seen, perceive(config.student, config.world.profile, params, depth, frames.state))
