"""The pipeline with two small stages of its own: order, resume, refusals, interruption, time."""

import dataclasses
import errno
import operator
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from unittest.mock import Mock

import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensorboardX.record_writer import RecordWriter

from app import pipeline
from ddgrasp import artifacts, attempts, events
from ddgrasp.alone import alone_in
from ddgrasp.config import Config, WorldConfig
from ddgrasp.errors import UserError
from ddgrasp.job import start_of
from ddgrasp.progress import Progress, read_curves
from ddgrasp.stages import STAGES, Stage, config_fields

CONFIG = Config(preset="debug")

STAGE = """
def run(job):
    run_dir = job.directory.parent
    with open(run_dir / "log.txt", "a") as log:
        log.write(f"{job.stage.name}\\n")
    if (run_dir / f"fail_{job.stage.name}").exists():
        raise OSError(28, "No space left on device")
    return job.finish({})
"""


@pytest.fixture
def stages(tmp_path, monkeypatch):
    """Real stage packages on disk, named as the first and third of the flow."""
    monkeypatch.syspath_prepend(str(tmp_path / "code"))
    made = []
    for name, package, parents in (("teacher", "stage_a_pkg", ()), ("record", "stage_b_pkg", ("teacher",))):
        folder = tmp_path / "code" / package
        folder.mkdir(parents=True)
        (folder / "__init__.py").write_text("")
        (folder / "stage.py").write_text(STAGE)
        made.append(Stage(name, f"{package}.stage", parents, (name,), f"makes {name}"))
    yield made
    for name in [name for name in sys.modules if name.startswith(("stage_a_pkg", "stage_b_pkg"))]:
        del sys.modules[name]


def _run(stages, run_dir, config=CONFIG, resume=False):
    return pipeline.run(config, run_dir, resume=resume, stages=stages, quiet=True)


def _log(run_dir):
    return (run_dir / "log.txt").read_text().splitlines()


def test_stages_run_in_order_and_the_report_has_them(stages, tmp_path):
    report = _run(stages, tmp_path / "run")
    assert _log(tmp_path / "run") == ["teacher", "record"]
    assert set(report["stages"]) == {"teacher", "record"}
    assert report["stages"]["record"]["trained"] is True
    assert (tmp_path / "run" / "report.html").stat().st_size > 1000


def test_the_flow_lists_every_stage_after_its_parents():
    names = [stage.name for stage in STAGES]
    assert names == ["teacher", "demos", "record", "ddg", "student", "export", "deploy"]
    for index, stage in enumerate(STAGES):
        assert set(stage.parents) <= set(names[:index])
        for name in config_fields(stage):
            operator.attrgetter(name)(Config(preset="debug"))


def test_resume_does_only_what_is_left(stages, tmp_path):
    run_dir = tmp_path / "run"
    run_dir.mkdir()
    (run_dir / "fail_record").touch()
    with pytest.raises(OSError, match="No space left"):
        _run(stages, run_dir)
    (run_dir / "fail_record").unlink()
    teacher = artifacts.read_artifact(run_dir / "teacher")
    _run(stages, run_dir, resume=True)
    assert _log(run_dir) == ["teacher", "record", "record"]
    assert artifacts.read_artifact(run_dir / "teacher") == teacher
    _run(stages, run_dir, resume=True)
    assert len(_log(run_dir)) == 3


def test_resume_in_an_empty_place_just_starts(stages, tmp_path):
    _run(stages, tmp_path / "new", resume=True)
    assert len(_log(tmp_path / "new")) == 2


def test_a_run_is_not_overwritten_without_resume(stages, tmp_path):
    run_dir = tmp_path / "run"
    _run(stages, run_dir)
    before = artifacts.read_artifact(run_dir / "teacher")
    with pytest.raises(UserError, match="holds a finished stage: continue with --resume, or choose another"):
        _run(stages, run_dir)
    assert artifacts.read_artifact(run_dir / "teacher") == before
    (run_dir / "teacher" / artifacts.MANIFEST).rename(run_dir / "teacher" / "checkpoint")
    with pytest.raises(UserError, match="holds an unfinished stage"):
        _run(stages, run_dir)


def test_resume_with_another_config_is_refused_and_loses_nothing(stages, tmp_path):
    run_dir = tmp_path / "run"
    _run(stages, run_dir)
    before = artifacts.read_artifact(run_dir / "record")
    other = dataclasses.replace(CONFIG, world=WorldConfig(episode_steps=7))
    with pytest.raises(UserError, match=r"world\.episode_steps is 60 there, 7 here"):
        _run(stages, run_dir, other, resume=True)
    assert artifacts.read_artifact(run_dir / "record") == before


def test_a_later_stage_of_another_config_is_refused_before_an_earlier_one_is_made(stages, tmp_path):
    run_dir = tmp_path / "run"
    _run(stages, run_dir)
    (run_dir / "teacher" / artifacts.MANIFEST).unlink()
    other = dataclasses.replace(CONFIG, record=dataclasses.replace(CONFIG.record, frames=7))
    before = _log(run_dir)
    with pytest.raises(UserError, match=r"record was made with another .* record\.frames is \d+ there, 7"):
        _run(stages, run_dir, other, resume=True)
    (run_dir / "record" / artifacts.MANIFEST).rename(run_dir / "record" / "checkpoint")
    with pytest.raises(UserError, match=r"record was begun with another .* record\.frames is \d+ there, 7"):
        _run(stages, run_dir, other, resume=True)
    assert _log(run_dir) == before


def test_a_finished_stage_of_other_material_is_not_taken_for_this_one_s(stages, tmp_path):
    for name in ("a", "b"):
        (tmp_path / name).mkdir()

    def make(data: str):
        inputs = {"data": tmp_path / data}
        return pipeline.make(stages[0], CONFIG, tmp_path / "run", resume=True, inputs=inputs, quiet=True)

    assert make("a") == make("a")
    with pytest.raises(UserError, match="was made with other inputs: data is '.*/a' there, '.*/b' here"):
        make("b")
    with pytest.raises(UserError, match="data is '.*/a' there, None here"):
        pipeline.make(
            stages[0], CONFIG, tmp_path / "run", resume=True, inputs={"recordings": tmp_path}, quiet=True
        )
    (tmp_path / "a").rename(tmp_path / "moved")
    assert make("moved") == make("b")  # what is finished does not need it any more


def test_what_a_stage_begins_with_is_known_by_its_content(stages, tmp_path):
    run, start = tmp_path / "run", tmp_path / "start" / "policy.msgpack"
    start.parent.mkdir()
    start.write_bytes(b"first")
    teacher = dataclasses.replace(CONFIG.teacher, start=str(start.parent))
    config = dataclasses.replace(CONFIG, teacher=teacher)

    def made():
        return pipeline.make(stages[0], config, run, resume=True, quiet=True)

    run.mkdir()
    (run / "fail_teacher").touch()
    with pytest.raises(OSError, match="No space"):
        made()
    (run / "teacher" / "work").touch()  # what an attempt leaves
    (run / "fail_teacher").unlink()
    start.write_bytes(b"second")
    with pytest.raises(UserError, match="was begun with other inputs: start is '"):
        made()
    start.write_bytes(b"first")
    made()
    start.write_bytes(b"second")
    made()  # what is finished does not need it
    with pytest.raises(UserError, match="was made with other inputs: start is '"):  # a study asks
        attempts.check_start(run / "teacher", start_of(config, "teacher"))
    start.unlink()
    attempts.check_start(run / "teacher", start_of(config, "teacher"))


def test_a_child_of_a_replaced_parent_is_refused(stages, tmp_path):
    run_dir = tmp_path / "run"
    _run(stages, run_dir)
    (run_dir / "teacher" / artifacts.MANIFEST).unlink()
    with pytest.raises(UserError, match=r"record was made from another teacher .* delete"):
        _run(stages, run_dir, resume=True)


SLOW = """
import gc, sys, time, types
from pathlib import Path
from app import cli
from app import commands
from app import pipeline
from ddgrasp.config import Config
from ddgrasp.stages import Stage

{work}

module = types.ModuleType("slow_pkg.stage")
module.run = work
sys.modules["slow_pkg"] = types.ModuleType("slow_pkg")
sys.modules["slow_pkg.stage"] = module
stage = Stage("teacher", "slow_pkg.stage", (), ("teacher",), "nothing")

class Slow:
    def run(self):
        pipeline.make(stage, Config(preset="debug"), Path({run_dir!r}), resume=True, quiet=True)

commands.parse = lambda name, args: Slow()
sys.exit(cli.main(["teacher", "train"]))
"""
WRAPS_THE_INTERRUPT = """
def work(job):
    print("working", flush=True)
    try:
        time.sleep(60)
    except KeyboardInterrupt:
        raise RuntimeError("a host callback wraps the interrupt")
"""
DROPS_THE_FIRST_INTERRUPT = """
class Drops:
    def __del__(self):
        print("working", flush=True)
        time.sleep(30)

def work(job):
    Drops()
    print("dropped", flush=True)
    try:
        time.sleep(30)
    finally:
        time.sleep(1.2)
        print("cleaned up", flush=True)
"""
COLLECTS_GARBAGE_MOST_OF_THE_TIME = """
def work(job):
    gc.callbacks.append(lambda phase, info: None)
    ballast = [[] for _ in range(1_000_000)]
    print("working", flush=True)
    end = time.monotonic() + 30
    while time.monotonic() < end:
        gc.collect()
        time.sleep(0.01)
"""
INTERRUPTED = (
    "ddgrasp: Interrupted in stage 'teacher'. Finished work is kept: the same command with --resume goes on."
)


def _interrupt(work: str, run_dir: Path, number: int) -> tuple[str, list[str]]:
    """A real process gets a real signal while its stage works, as after Ctrl-C: stdout, lines of stderr."""
    process = subprocess.Popen(
        [sys.executable, "-c", SLOW.format(work=work, run_dir=str(run_dir))],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: signal.signal(signal.SIGHUP, signal.SIG_DFL),  # nohup has it ignored
    )
    assert process.stdout and process.stdout.readline() == "working\n"
    time.sleep(0.3)
    process.send_signal(number)
    out, errors = process.communicate(timeout=20)
    assert process.returncode == 130
    return out, errors.splitlines()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_an_interrupt_says_how_to_go_on_and_keeps_the_time_spent(tmp_path, number):
    _, errors = _interrupt(WRAPS_THE_INTERRUPT, tmp_path, number)
    assert errors == [INTERRUPTED]
    assert Progress(tmp_path / "teacher").seconds >= 0.3


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupt_that_a_destructor_drops_still_ends_the_work_and_lets_it_clean_up(tmp_path, number):
    out, errors = _interrupt(DROPS_THE_FIRST_INTERRUPT, tmp_path, number)
    assert out == "dropped\ncleaned up\n"
    assert errors[0].startswith("Exception ignored in")
    assert errors[-1] == INTERRUPTED


def test_an_interrupt_that_arrives_in_a_gc_callback_ends_the_work(tmp_path):
    _, errors = _interrupt(COLLECTS_GARBAGE_MOST_OF_THE_TIME, tmp_path, signal.SIGINT)
    assert errors == [INTERRUPTED]


WORKS = """
def work(job):
    print("working", flush=True)
    time.sleep(60)
"""
HAS_WORKERS = """
import multiprocessing, os

def work(job):
    for kind in ("fork", "spawn"):
        multiprocessing.get_context(kind).Process(target=time.sleep, args=(60,)).start()
    children = multiprocessing.active_children()
    print(" ".join(str(child.pid) for child in children), flush=True)
    time.sleep(60)
"""


def _begin(work: str, run_dir: Path) -> tuple[subprocess.Popen, str]:
    """A process that works in the run's stage `teacher`, and its first line."""
    code = [sys.executable, "-c", SLOW.format(work=work, run_dir=str(run_dir))]
    process = subprocess.Popen(code, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    return process, process.stdout.readline()


def test_two_processes_do_not_make_one_stage_but_may_make_two(stages, tmp_path):
    run_dir, (teacher, record) = tmp_path / "run", stages
    other, line = _begin(WORKS, run_dir)
    try:
        assert line == "working\n"
        with pytest.raises(UserError) as refused:
            pipeline.make(teacher, CONFIG, run_dir, resume=True, quiet=True)
        about = {"resume": True, "quiet": True, "parents": {}}
        made = pipeline.make(record, CONFIG, run_dir, **about)
        assert pipeline.make(record, CONFIG, run_dir, **about) == made
    finally:
        other.kill()
        other.wait()
    assert str(refused.value) == (
        f"another process is at work in {run_dir / 'teacher'}: wait for it, or choose another --out."
    )
    assert _log(run_dir) == ["record"] and not list(run_dir.rglob("*lock*"))
    pipeline.make(teacher, CONFIG, run_dir, resume=True, quiet=True)
    assert _log(run_dir) == ["record", "teacher"]


def test_workers_that_outlive_a_killed_process_do_not_keep_the_stage(stages, tmp_path):
    other, line = _begin(HAS_WORKERS, tmp_path)
    workers = [int(pid) for pid in line.split()]
    assert len(workers) == 2
    try:
        with pytest.raises(UserError, match="another process is at work in"):
            pipeline.make(stages[0], CONFIG, tmp_path, resume=True, quiet=True)
        other.kill()
        other.wait()
        for pid in workers:
            os.kill(pid, 0)  # is there still
        pipeline.make(stages[0], CONFIG, tmp_path, resume=True, quiet=True)
    finally:
        for pid in workers:
            os.kill(pid, signal.SIGKILL)
    assert _log(tmp_path) == ["teacher"]


def test_a_stage_that_fails_is_let_go_of(stages, tmp_path):
    (tmp_path / "fail_teacher").touch()
    for _ in range(2):
        with pytest.raises(OSError, match="No space left"):
            pipeline.make(stages[0], CONFIG, tmp_path, resume=True, quiet=True)


def test_a_stage_that_ended_meanwhile_is_not_made_again(stages, tmp_path, monkeypatch):
    """Another process ends it between the look and the lock."""
    lock = pipeline.alone_in

    def later(directory):
        artifacts.finish(directory, "teacher", CONFIG, seconds=1.0, metrics={"by": "another"})
        return lock(directory)

    monkeypatch.setattr(pipeline, "alone_in", later)
    made = pipeline.make(stages[0], CONFIG, tmp_path, resume=True, quiet=True)
    assert made.manifest.metrics == {"by": "another"} and not (tmp_path / "log.txt").exists()


def test_of_several_that_make_a_stage_together_one_holds_it(stages, tmp_path):
    (tmp_path / "teacher").mkdir()
    with alone_in(tmp_path / "teacher"):
        pipeline.make(stages[0], CONFIG, tmp_path, resume=True, quiet=True, leads=False)
    assert _log(tmp_path) == ["teacher"]


def test_where_a_file_system_has_no_locks_on_folders_nobody_is_kept_out(tmp_path, monkeypatch):
    def none(descriptor, operation):
        raise OSError(errno.EBADF, "Bad file descriptor")

    monkeypatch.setattr("ddgrasp.alone.fcntl.flock", none)
    with alone_in(tmp_path):
        assert tmp_path.is_dir()


def test_curves_count_a_repeated_step_once_and_skip_a_torn_line(tmp_path):
    progress = Progress(tmp_path, quiet=True)
    progress.scalars(1, loss=3.0)
    progress.scalars(2, loss=2.0, success=0.5)
    progress.close()
    resumed = Progress(tmp_path, quiet=True)
    resumed.scalars(2, loss=1.5)
    resumed.close()
    with open(tmp_path / "curves.jsonl", "a") as file:
        file.write('{"step": 3, "lo')
    assert read_curves(tmp_path) == {"loss": [(1, 3.0), (2, 1.5)], "success": [(2, 0.5)]}
    third = Progress(tmp_path, quiet=True)
    third.scalars(3, loss=1.0)
    third.close()
    assert read_curves(tmp_path)["loss"] == [(1, 3.0), (2, 1.5), (3, 1.0)]
    (file,) = (tmp_path / "tb").glob("events*")
    seen = EventAccumulator(str(file)).Reload().Scalars("loss")
    assert [(point.step, point.value) for point in seen] == [(1, 3.0), (2, 1.5), (3, 1.0)]


def test_a_disk_that_takes_no_events_stops_nothing(tmp_path, monkeypatch, capsys):
    """tensorboardX's own writer hands them to a thread, for which a training would wait for ever."""
    for _ in range(2):  # the second time TensorBoard's events of both are written anew
        with monkeypatch.context() as patch:
            progress = Progress(tmp_path, "fit")
            progress.scalars(1, loss=3.0)
            full = OSError(errno.ENOSPC, "No space left on device")
            patch.setattr(RecordWriter, "flush", Mock(side_effect=full))
            patch.setattr(events, "_FLUSH_PERIOD_S", -1.0)
            for step in range(2, 40):
                progress.scalars(step, loss=1.0)
            progress.close()
        said = capsys.readouterr().err
        assert "[fit] TensorBoard's events are not whole ([Errno 28] No space left" in said
    assert len(read_curves(tmp_path)["loss"]) == 39
