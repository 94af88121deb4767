"""How a command ends where a stream, a device or a place to write to is missing: in one line, early."""

import ctypes.util
import errno
import io
import os
import select
import signal
import subprocess
import sys
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import pytest

from app import cli, commands, pipeline
from app.commands import parse
from app.commands.checks import check_file, check_folder
from ddgrasp import install
from ddgrasp.errors import Trouble, UserError
from ddgrasp.presets import PRESETS

ROOT = Path(__file__).parents[1]


def ran(run, monkeypatch) -> int:
    """The status of a command that does `run`."""
    monkeypatch.setattr(commands, "parse", lambda name, args: SimpleNamespace(run=run))
    return cli.main(["objects", "list"])


# --- errors of the system ------------------------------------------------------------------------


def _raise(error: BaseException) -> None:
    raise error


@pytest.mark.parametrize("number", [errno.EROFS, errno.ENAMETOOLONG, errno.ENOENT, errno.EIO, errno.ELOOP])
def test_what_the_system_says_of_a_file_is_one_line(number, monkeypatch, capsys):
    error = OSError(number, os.strerror(number), "runs/x/a.json")
    assert ran(partial(_raise, error), monkeypatch) == 1
    assert capsys.readouterr().err == (
        f"ddgrasp: runs/x/a.json cannot be read or written ({os.strerror(number)}): mend that, or give "
        "another path.\n"
    )


def test_an_error_that_names_no_file_keeps_its_traceback(monkeypatch):
    for error in (OSError(errno.EIO, "no file"), PermissionError(errno.EPERM, "of a process"), KeyError("a")):
        with pytest.raises(type(error)):
            ran(partial(_raise, error), monkeypatch)


def test_a_folder_that_is_gone_is_told_in_one_line(tmp_path):
    (tmp_path / "gone").mkdir()
    script = "import os, sys; os.rmdir(os.getcwd()); from app.cli import main; sys.exit(main())"
    line = [sys.executable, "-c", script, "run", "--preset", "debug"]
    done = subprocess.run(
        line,
        cwd=tmp_path / "gone",
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        stderr=subprocess.PIPE,
        text=True,
    )
    assert (done.returncode, done.stderr) == (
        1,
        "ddgrasp: The working directory is not there any more: go to another one.\n",
    )


def test_what_failed_by_itself_is_no_wrong_input(monkeypatch, capsys):
    assert ran(partial(_raise, Trouble("the arm stopped")), monkeypatch) == 1
    assert ran(partial(_raise, UserError("no such object")), monkeypatch) == 2
    assert capsys.readouterr().err == "ddgrasp: the arm stopped\nddgrasp: no such object\n"


@pytest.mark.parametrize("out", ["a" * 300, "README.md/a"])
def test_a_run_s_place_is_looked_at_before_what_lies_in_it(out, tmp_path):
    (tmp_path / "README.md").touch()
    for resume in (False, True):
        with pytest.raises(UserError, match=r"cannot be created \(.+\): choose another --out\.$"):
            pipeline.check_place(PRESETS["debug"], tmp_path / out, resume=resume)
    assert [path.name for path in tmp_path.iterdir()] == ["README.md"]


# --- Ctrl-C --------------------------------------------------------------------------------------

WORKS_ON = """
import atexit, os, signal, sys, time, types
from app import cli, commands
signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell has it ignored in the background
class Engine:
    def __del__(self, write=os.write):
        write(1, b"taken apart")
engine = Engine()
def run():
    atexit.register(print, "tidied up")
    print("working", flush=True)
    time.sleep(60)
commands.parse = lambda name, args: types.SimpleNamespace(run=run)
sys.argv = ["ddgrasp", "objects", "list"]
sys.exit(cli.main())
"""


def test_an_interrupted_program_ends_where_it_stands():
    """JAX's thread, in a physics step of the C engine, crashed a Python that was taken apart around it."""
    process = subprocess.Popen(
        [sys.executable, "-c", WORKS_ON], cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert process.stdout and process.stdout.readline() == "working\n"
    process.send_signal(signal.SIGINT)
    out, told = process.communicate(timeout=30)
    assert (process.returncode, out, told) == (130, "tidied up\n", "ddgrasp: Interrupted.\n")


# --- devices -------------------------------------------------------------------------------------

ASK_DEVICES = """
import sys, types
from app import cli, commands
def run():
    import jax
    jax.numpy.zeros(3)
commands.parse = lambda name, args: types.SimpleNamespace(run=run)
sys.exit(cli.main(["objects", "list"]))
"""


@pytest.mark.parametrize("platforms", ["cuda", "foo", "cpu,foo"])
def test_devices_that_are_not_here_are_named_by_their_variable(platforms):
    env = {**os.environ, "JAX_PLATFORMS": platforms, "CUDA_VISIBLE_DEVICES": ""}
    done = subprocess.run(
        [sys.executable, "-c", ASK_DEVICES], cwd=ROOT, env=env, capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 1
    assert done.stderr == (
        f"ddgrasp: JAX_PLATFORMS is {platforms!r}, which JAX has no device for here: unset it, or set it to "
        "cpu.\n"
    )


@pytest.mark.parametrize(
    ("value", "why"),
    [("foo", "which MuJoCo does not know here"), ("osmesa", "whose library is not here")],
)
def test_what_mujoco_cannot_draw_by_is_named_by_its_variable(value, why):
    if value == "osmesa" and ctypes.util.find_library("OSMesa"):
        pytest.skip("OSMesa is installed here")
    env = {**os.environ, "MUJOCO_GL": value}
    env.pop("PYOPENGL_PLATFORM", None)
    command = [sys.executable, "-m", "app.cli", "objects", "list"]
    done = subprocess.run(command, cwd=ROOT, env=env, capture_output=True, text=True)
    assert done.returncode == 1
    assert done.stderr.startswith(f"ddgrasp: MUJOCO_GL is {value!r}, {why}") and done.stderr.count("\n") == 1


def test_another_failed_assertion_keeps_its_traceback(monkeypatch):
    monkeypatch.setenv("JAX_PLATFORMS", "cpu")
    import jax

    assert jax.devices()
    for error in (AssertionError(), RuntimeError("of ours")):
        with pytest.raises(type(error)):
            ran(partial(_raise, error), monkeypatch)


# --- streams -------------------------------------------------------------------------------------


@pytest.mark.parametrize("closed", [">&-", "<&-", "2>&-", "<&- >&- 2>&-"])
@pytest.mark.parametrize("command", ["objects list", "play --help", "play --objects aple"])
def test_closed_streams_are_no_trouble(closed, command):
    line = f"exec {sys.executable} -m app.cli {command} {closed}"
    done = subprocess.run(["bash", "-c", line], cwd=ROOT, capture_output=True, text=True, timeout=60)
    wrong = "aple" in command
    assert done.returncode == (2 if wrong else 0), done.stderr
    assert "Traceback" not in done.stderr
    assert bool(done.stdout) == (not wrong and ">&-" not in closed.replace("2>&-", ""))


def test_closed_streams_of_this_process_are_made_to_lead_nowhere(monkeypatch):
    for name in ("stdin", "stdout", "stderr"):
        monkeypatch.setattr(sys, name, None)
    assert cli.main(["--help"]) == 0
    assert not sys.stdin.isatty() and sys.stdin.read() == ""
    for stream in (sys.stdin, sys.stdout, sys.stderr):
        stream.close()


BUFFERED = {name: value for name, value in os.environ.items() if name != "PYTHONUNBUFFERED"}
"""As a user's shell has it: Python keeps what goes into a pipe or a file, unless it is told otherwise."""
SPEAKS = """
import sys
from app import cli
from deploy import session
from deploy.calibration import session as calibration
from deploy.loop_report import LoopReport
def run(*given):
    say = given[-1] if callable(given[-1]) else print  # which it is without one
    say("an event")
    sys.stdin.read()
    return LoopReport(0.1, steps=1)
session.deploy = calibration.run = run
sys.exit(cli.main(sys.argv[1:]))
"""


@pytest.mark.parametrize("command", ["deploy --policy x.onnx --preset debug", "calibrate"])
def test_a_pipe_has_every_event_of_an_arm_as_it_happens(command):
    """As `| tee log` wants it, and whoever reads along."""
    line = [sys.executable, "-c", SPEAKS, *command.split()]
    with subprocess.Popen(
        line, cwd=ROOT, env=BUFFERED, stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as process:
        heard = select.select([process.stdout], [], [], 30.0)[0]
        assert process.communicate()[0].startswith(b"an event\n") and process.returncode == 0
    assert heard, "it came at the end"


@pytest.mark.parametrize("command", ["--version", "--help", "deploy --help"])
def test_output_that_nobody_takes_is_told_once_or_not_at_all(command):
    line = [sys.executable, "-m", "app.cli", *command.split()]
    reader, writer = os.pipe()
    os.close(reader)
    for taken_by, told in (
        (writer, ""),
        (
            os.open("/dev/full", os.O_WRONLY),
            "ddgrasp: No space left on the disk: free some and give the same command again, with --resume if "
            "it has that. What was finished before is intact.\n",
        ),
    ):
        done = subprocess.run(
            line, cwd=ROOT, env=BUFFERED, stdout=taken_by, stderr=subprocess.PIPE, text=True, timeout=60
        )
        os.close(taken_by)
        assert (done.returncode, done.stderr) == (1, told)


def test_what_a_terminal_cannot_show_is_escaped(monkeypatch, capsys):
    printed = io.TextIOWrapper(io.BytesIO(), "ascii", newline="")
    monkeypatch.setattr(sys, "stdout", printed)
    assert ran(lambda: print("1 µm, 日"), monkeypatch) == 0
    printed.seek(0)
    assert printed.read() == "1 \\xb5m, \\u65e5\n"


# --- places to write to --------------------------------------------------------------------------


def test_a_place_is_tried_and_left_as_it_was(tmp_path):
    (tmp_path / "a.png").write_text("old")
    for path in ("a.png", "new.png", "b/c/new.png"):
        check_file("--out", tmp_path / path)
    for path in ("", "b", "b/c"):
        check_folder("--out", tmp_path / path)
    assert [path.name for path in tmp_path.iterdir()] == ["a.png"]
    assert (tmp_path / "a.png").read_text() == "old"


@pytest.mark.parametrize(
    ("path", "trouble"),
    [
        ("file/a.png", "and {}/file is no folder: name a file elsewhere."),
        ("folder", "a folder: name a file, in it or elsewhere."),
        ("a" * 250, "where nothing can be written (File name too long): name a file elsewhere."),
        (f"{'a' * 300}/a.png", "where nothing can be written (File name too long): name a file elsewhere."),
        ("/dev/null", "a device or pipe, which a file would replace: name another."),
        ("/proc/a.png", "where nothing can be written ("),
        ("/proc/b/a.png", "where nothing can be written ("),
    ],
)
def test_a_file_that_cannot_be_is_refused(path, trouble, tmp_path):
    (tmp_path / "file").touch()
    (tmp_path / "folder").mkdir()
    with pytest.raises(UserError) as error:
        check_file("--out", tmp_path / path)
    assert str(error.value).startswith(f"--out is {tmp_path / path}, {trouble.format(tmp_path)}")
    assert {path.name for path in tmp_path.iterdir()} == {"file", "folder"}


@pytest.mark.parametrize(
    "command",
    [
        "teacher eval pretrained",
        "ddg sample --model pretrained/ddg --data nowhere",
        "ddg thresholds --model pretrained/ddg --data nowhere",
        "ddg features",
        "sensors compare",
        "study causes --policy pretrained/student/policy.onnx",
        "deploy --policy pretrained/student/policy.onnx",
        "deploy trials --policy pretrained/student/policy.onnx --rig development",
        "record fr3",
        "record import nowhere",
        "record realsense",
        "weights convert nowhere.pth",
        "calibrate board",
        "calibrate",
        "ddg export --model pretrained/ddg",
        "objects sheet",
        "play",
    ],
)
@pytest.mark.parametrize("place", ["/proc", "{}/file"])
def test_where_a_command_is_to_write_is_tried_before_it_works(command, place, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").touch()
    out = f"{place.format(tmp_path)}/a.mp4" if command == "play" else f"{place.format(tmp_path)}/a.pdf"
    words = command.split()
    name = " ".join(words[:2]) if " ".join(words[:2]) in commands.COMMANDS else words[0]
    with pytest.raises(
        UserError, match=rf"^--out is {out}, (where nothing can be written|and \S+/file is no)"
    ):
        parse(name, [*words[len(name.split()) :], "--out", out]).run()
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


@pytest.mark.parametrize(
    ("command", "absent"),
    [
        ("deploy trials --policy pretrained/student/policy.onnx", "franky"),
        ("play --rig fr3", "franky_sim"),
        ("study table2 --rig fr3", "trimesh"),
        ("study causes --policy pretrained/student/policy.onnx --rows fr3", "franky"),
        ("rig pictures", "franky_sim"),
    ],
)
def test_what_the_fr3_rig_lacks_is_said_before_anything_is_made(command, absent, tmp_path, monkeypatch):
    there = install.find_spec
    monkeypatch.setattr(install, "find_spec", lambda name: None if name == absent else there(name))
    monkeypatch.chdir(tmp_path)
    words = command.split()
    name = " ".join(words[:2]) if " ".join(words[:2]) in commands.COMMANDS else words[0]
    with pytest.raises(UserError, match=rf"^[-\w' ]+ needs {absent}: .+ install 'ddgrasp\[fr3\]'\.$"):
        parse(name, [*words[len(name.split()) :], "--out", str(tmp_path / "out")]).run()
    assert list(tmp_path.iterdir()) == []
