"""The whole flow on one page: runs stages in order, refuses or resumes, and survives Ctrl-C.

Which stages there are says `ddgrasp/stages.py`. Every stage is a module with

    run(job: Job) -> Artifact

It works in `job.directory` and ends with `job.finish`. Modules are imported when their turn comes, so that
`--help` needs none of them.
"""

import errno
import gc
import importlib
import os
import signal
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from pathlib import Path
from types import FrameType
from typing import Any

from ddgrasp import artifacts, attempts, config_file
from ddgrasp.alone import alone_in
from ddgrasp.artifacts import Artifact
from ddgrasp.config import Config
from ddgrasp.errors import UserError
from ddgrasp.job import Job
from ddgrasp.progress import Progress
from ddgrasp.signals import ending, forget_terminal
from ddgrasp.stages import STAGES, Stage
from ddgrasp.versions import commit

_REPEAT_S = 0.5
_SOON_S = 0.001
_NO_SUCH_PLACE = (
    errno.EEXIST, errno.ENOTDIR, errno.ENOENT, errno.EROFS, errno.ELOOP, errno.ENAMETOOLONG, errno.EINVAL,
)  # fmt: skip


def run(
    config: Config, run_dir: Path, *, resume: bool, stages: Sequence[Stage] = STAGES, quiet: bool = False
) -> dict[str, Any]:
    """Makes every stage that is not finished, then writes the report; returns what report.json holds.

    Raises UserError if `run_dir` holds a run and `resume` is off, or holds one of another configuration.
    """
    check_place(config, run_dir, resume=resume, stages=stages)
    for stage in stages:
        make(stage, config, run_dir, resume=resume, quiet=quiet)
        if not config_file.is_of_a_person(run_dir / config_file.CONFIG_FILE):
            config_file.write(config, run_dir / config_file.CONFIG_FILE)
    return importlib.import_module("evaluation.report.stage").write_report(run_dir)


def check_place(config: Config, run_dir: Path, *, resume: bool, stages: Sequence[Stage] = STAGES) -> None:
    """UserError if `run_dir` is or lies below a file, holds a run and `resume` is off, or stages that are
    finished or begun with another configuration. Writes nothing."""
    place, first = run_dir.absolute(), run_dir / stages[0].name
    try:
        there = next(path for path in (place, *place.parents) if path.exists())
    except OSError as error:  # a name that is too long
        raise _no_place(first, error.errno) from None
    if not there.is_dir():
        raise _no_place(first, errno.ENOTDIR)
    if not resume:
        _refuse_occupied(run_dir, [stage.name for stage in stages])
    for stage in stages:
        attempts.check_place(run_dir / stage.name, stage.name, config)


def make(
    stage: Stage,
    config: Config,
    run_dir: Path,
    *,
    resume: bool,
    parents: Mapping[str, Artifact] | None = None,
    inputs: Mapping[str, Any] | None = None,
    quiet: bool = False,
    leads: bool = True,
) -> Artifact:
    """Makes the stage in `run_dir / stage.name`, or returns the finished one if `resume` is on.

    Raises UserError if another process is making it.

    Args:
      parents: what it is made from; by default the finished stages in `run_dir` that its row names.
      inputs: material from outside the run (`Job.inputs`). An attempt with other inputs is not continued.
      leads: off in all but the first of several processes that make the stage together: they keep quiet and
        write nothing.
    """
    if parents is None:
        parents = {name: artifacts.require(run_dir, name, config) for name in stage.parents}
    directory = run_dir / stage.name
    create(directory)
    if not resume:
        _refuse_occupied(run_dir, [stage.name])
    progress = Progress(directory if leads else None, stage.name, quiet=quiet or not leads)
    job = Job(stage, config, directory, progress, parents, inputs or {})
    artifact = _finished(job) or _made(job, leads)
    _check_parents(artifact, parents)
    return artifact


def _finished(job: Job) -> Artifact | None:
    """What an earlier attempt has finished. UserError if it was made otherwise."""
    if not artifacts.is_finished(job.directory):
        return None
    artifact = artifacts.read_artifact(job.directory)
    artifacts.check_config(artifact, job.config)
    attempts.check_inputs(job.directory, {name: job.identity()[name] for name in job.inputs})
    job.progress.note(f"finished before ({artifact.manifest.seconds:.0f} s{_origin(artifact)})")
    return artifact


def _made(job: Job, leads: bool) -> Artifact:
    """The stage, made by no other process meanwhile. UserError if one is at it."""
    with alone_in(job.directory) if leads else nullcontext():
        return _finished(job) or _work(job, leads)


def _work(job: Job, leads: bool) -> Artifact:
    progress = job.progress
    commit()  # of the code that runs, which hours later may be another's
    progress.note(f"-> {job.directory}: {job.stage.makes}")
    attempts.begin(job.directory, job.stage.name, job.config, job.identity(), write=leads)
    with _interruptible(job.stage.name):
        try:
            artifact = importlib.import_module(job.stage.module).run(job)
        finally:
            progress.close()
    progress.note(f"finished in {artifact.manifest.seconds:.0f} s{_origin(artifact)}")
    return artifact


def _origin(artifact: Artifact) -> str:
    return ", loaded" if artifact.manifest.origin == "loaded" else ""


def create(directory: Path) -> None:
    """UserError if `directory` is or lies below a file, or cannot exist."""
    try:
        directory.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        if error.errno not in _NO_SUCH_PLACE:
            raise
        raise _no_place(directory, error.errno) from None


def _no_place(directory: Path, number: int | None) -> UserError:
    return UserError(f"{directory} cannot be created ({os.strerror(number or 0)}): choose another --out.")


def _refuse_occupied(run_dir: Path, names: Sequence[str]) -> None:
    for name in names:
        directory = run_dir / name
        if artifacts.is_finished(directory):
            raise UserError(
                f"{directory} holds a finished stage: continue with --resume, or choose another --out."
            )
        if attempts.has_work(directory):
            raise UserError(
                f"{directory} holds an unfinished stage: continue with --resume, or choose another --out."
            )


def _check_parents(artifact: Artifact, parents: Mapping[str, Artifact]) -> None:
    for name, parent in parents.items():
        made_from = artifact.manifest.parents.get(name, parent.hash)
        if made_from != parent.hash:
            raise UserError(
                f"{artifact.directory} was made from another {name} ({made_from}; {parent.directory} is now "
                f"{parent.hash}): delete {artifact.directory} to make it again, or choose another --out."
            )


@contextmanager
def _interruptible(name: str) -> Iterator[None]:
    """Turns Ctrl-C, SIGTERM and a hang-up into KeyboardInterrupt with a message, wherever in the stage they
    arrive.

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
        forget_terminal(signum)
        put_off = _in_gc_callback(frame)
        signal.setitimer(signal.ITIMER_REAL, _SOON_S if put_off else _REPEAT_S, _REPEAT_S)
        if not put_off:
            raise KeyboardInterrupt

    try:
        kinds = (*ending(), signal.SIGALRM)
        previous = {number: signal.signal(number, interrupt) for number in kinds}
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
