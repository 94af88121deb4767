"""The whole flow on one page: which stages there are, in which order, and what each is made from.

Every stage is `<package>/stage.py` with

    run(config: Config, run_dir: Path, *, resume: bool, progress: Progress) -> Artifact

It works in `run_dir / <stage>` and ends by writing its manifest (`artifacts.finish`). Packages are imported
when their turn comes, so that `--help` needs none of them and the robot side never imports JAX.
"""

import errno
import gc
import importlib
import signal
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Any

from ddgrasp import artifacts
from ddgrasp.artifacts import Artifact
from ddgrasp.config import Config
from ddgrasp.errors import UserError
from ddgrasp.progress import Progress

_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGALRM)
_REPEAT_S = 0.5
_SOON_S = 0.001
_NO_SUCH_PLACE = (
    errno.EEXIST, errno.ENOTDIR, errno.ENOENT, errno.EROFS, errno.ELOOP, errno.ENAMETOOLONG, errno.EINVAL,
)  # fmt: skip


@dataclass(frozen=True)
class Stage:
    """One box of the flow picture."""

    name: str
    """Also its directory under the run."""
    package: str
    """Its module is `<package>.stage`."""
    parents: tuple[str, ...]
    """Stages it is made from."""
    makes: str
    """What it leaves behind, for people."""


STAGES = (
    Stage("teacher", "ppo", (), "PPO policy on the privileged state"),
    Stage("demos", "demos", ("teacher",), "successful teacher episodes with clean depth"),
    Stage("record", "sensors", ("teacher",), "RGB-D recordings from the pseudo-real rig"),
    Stage("ddg", "ddg_jax", ("record",), "diffusion model of the camera's errors"),
    Stage("student", "student_jax", ("teacher", "demos", "ddg"), "depth-only diffusion policy"),
    Stage("export", "export", ("student",), "one ONNX file, checked against JAX"),
    Stage("deploy", "deploy", ("export",), "the exported student in the pseudo-real rig at 10 Hz"),
)

ON_REQUEST = (
    Stage("score", "evaluation", ("teacher", "ddg"), "generated depth against the rig's: Table I"),
    Stage("score_real", "evaluation", (), "generated depth against a real camera's"),
    Stage("curve", "evaluation", ("teacher", "record", "ddg"), "score against recorded trajectories"),
    Stage("samplers", "evaluation", ("teacher", "ddg"), "score against network evaluations"),
)
"""Stages that `run` leaves out; each has a command of its own (`ddgrasp ddg score`, `curve`, `samplers`)."""


def run(
    config: Config, run_dir: Path, *, resume: bool, stages: Sequence[Stage] = STAGES, quiet: bool = False
) -> dict[str, Any]:
    """Runs every stage that is not finished, then writes the report; returns what report.json holds.

    Raises UserError if `run_dir` holds a run and `resume` is off, or holds one of another configuration.
    """
    if not resume:
        _refuse_occupied(run_dir, [stage.name for stage in stages])
    for stage in stages:
        run_stage(stage, config, run_dir, resume=resume, quiet=quiet)
    return importlib.import_module("evaluation.stage").write_report(run_dir)


def run_stage(
    stage: Stage, config: Config, run_dir: Path, *, resume: bool, quiet: bool = False, leads: bool = True
) -> Artifact:
    """Runs one stage from its parents in `run_dir`, or returns the finished one if `resume` is on.

    `leads` is off in all but the first of several processes that make the stage together: they keep quiet and
    write nothing.
    """
    parents = {name: artifacts.require(run_dir, name, config) for name in stage.parents}

    def work(progress: Progress) -> Artifact:
        module = importlib.import_module(f"{stage.package}.stage")
        return module.run(config, run_dir, resume=resume, progress=progress)

    artifact = make(stage, config, run_dir, work, resume=resume, quiet=quiet, leads=leads)
    _check_parents(artifact, parents)
    return artifact


def make(
    stage: Stage,
    config: Config,
    run_dir: Path,
    work: Callable[[Progress], Artifact],
    *,
    resume: bool,
    quiet: bool = False,
    inputs: Mapping[str, str] | None = None,
    leads: bool = True,
) -> Artifact:
    """Lets `work` make the stage's artefact in `run_dir / stage.name`, unless it is finished and `resume` on.

    `inputs` names what the artefact is made from besides the configuration and the run's other stages: an
    attempt with other inputs is not continued. `leads`: see `run_stage`.
    """
    directory = run_dir / stage.name
    _create(directory)
    if not resume:
        _refuse_occupied(run_dir, [stage.name])
    progress = Progress(directory if leads else None, stage.name, quiet=quiet or not leads)
    if artifacts.is_finished(directory):
        artifact = artifacts.read_artifact(directory)
        artifacts.check_config(artifact, config)
        progress.note(f"finished before ({artifact.manifest.seconds:.0f} s, {artifact.manifest.origin})")
        return artifact
    progress.note(f"-> {directory}: {stage.makes}")
    artifacts.begin(directory, stage.name, config, inputs, write=leads)
    with _interruptible(stage.name):
        try:
            artifact = work(progress)
        finally:
            progress.close()
    progress.note(f"finished in {artifact.manifest.seconds:.0f} s ({artifact.manifest.origin})")
    return artifact


def get_stage(name: str) -> Stage:
    """The stage of that name."""
    return next(stage for stage in (*STAGES, *ON_REQUEST) if stage.name == name)


def _create(directory: Path) -> None:
    """UserError if `directory` is or lies below a file, or cannot exist."""
    try:
        directory.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        if error.errno not in _NO_SUCH_PLACE:
            raise
        raise UserError(f"{directory} cannot be created ({error.strerror}): choose another --out.") from None


def _refuse_occupied(run_dir: Path, names: Sequence[str]) -> None:
    for name in names:
        directory = run_dir / name
        if artifacts.is_finished(directory):
            raise UserError(
                f"{directory} holds a finished stage: continue with --resume, or choose another --out."
            )
        if artifacts.has_work(directory):
            raise UserError(
                f"{directory} holds an unfinished stage: continue with --resume, or choose another --out."
            )


def _check_parents(artifact: Artifact, parents: dict[str, Artifact]) -> None:
    for name, parent in parents.items():
        made_from = artifact.manifest.parents.get(name, parent.hash)
        if made_from != parent.hash:
            raise UserError(
                f"{artifact.directory} was made from another {name} ({made_from}; {parent.directory} is now "
                f"{parent.hash}): delete {artifact.directory} to make it again, or choose another --out."
            )


@contextmanager
def _interruptible(name: str) -> Iterator[None]:
    """Turns Ctrl-C and SIGTERM into KeyboardInterrupt with a message, wherever in the stage they arrive.

    A KeyboardInterrupt raised inside a JAX host callback surfaces as some other error; the flag tells. Raised
    in a destructor it is dropped, and in the garbage collector's callbacks (JAX has one), where it would be
    too, it is put off: a timer repeats it until it surfaces.
    """
    arrived = False

    def interrupt(signum, frame):
        nonlocal arrived
        if signum == signal.SIGALRM and _is_unwinding():
            return
        arrived = True
        put_off = _in_gc_callback(frame)
        signal.setitimer(signal.ITIMER_REAL, _SOON_S if put_off else _REPEAT_S, _REPEAT_S)
        if not put_off:
            raise KeyboardInterrupt

    try:
        previous = {number: signal.signal(number, interrupt) for number in _SIGNALS}
    except ValueError:  # not in the main thread: signals are someone else's
        previous = {}
    message = f"Interrupted in stage {name!r}. Finished work is kept: the same command with --resume goes on."
    try:
        yield
        if arrived:
            raise KeyboardInterrupt
    except KeyboardInterrupt:
        raise KeyboardInterrupt(message) from None
    except Exception:
        if arrived:
            raise KeyboardInterrupt(message) from None
        raise
    finally:
        if arrived:
            signal.setitimer(signal.ITIMER_REAL, 0)
        for number, handler in previous.items():
            signal.signal(number, handler)


def _is_unwinding() -> bool:
    """Whether a KeyboardInterrupt is being handled right now: cleaning up is not to be disturbed."""
    error = sys.exception()
    while error is not None and not isinstance(error, KeyboardInterrupt):
        error = error.__context__
    return error is not None


def _in_gc_callback(frame: FrameType | None) -> bool:
    """Whether `frame` runs in a callback of the garbage collector, from where no exception gets out."""
    codes = {getattr(callback, "__code__", None) for callback in gc.callbacks}
    while frame is not None and frame.f_code not in codes:
        frame = frame.f_back
    return frame is not None
