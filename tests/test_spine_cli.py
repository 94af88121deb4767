"""The command line as a person meets it: in a process of its own."""

import subprocess
import sys
from pathlib import Path

import pytest

from ddgrasp.commands import COMMANDS, check_config_values, parse
from ddgrasp.errors import UserError
from ddgrasp.presets import PRESETS

ROOT = Path(__file__).parents[1]


def ddgrasp(*args: str) -> subprocess.CompletedProcess:
    return subprocess.run(
        [sys.executable, "-m", "ddgrasp.cli", *args], cwd=ROOT, capture_output=True, text=True, timeout=60
    )


def _one_error_line(result: subprocess.CompletedProcess) -> str:
    assert result.stderr.count("\n") == 1, result.stderr
    assert result.stdout == ""
    return result.stderr


def test_help_of_every_command_starts_without_jax():
    code = f"""
import sys
from ddgrasp.cli import main
main(["--help"])
for name in {list(COMMANDS)}:
    try:
        main([*name.split(), "--help"])
    except SystemExit as stop:
        assert stop.code == 0, (name, stop.code)
heavy = {{"jax", "jaxlib", "flax", "mujoco", "matplotlib", "cv2", "onnxruntime", "sklearn"}}
print("LOADED", sorted(heavy & set(sys.modules)))
"""
    result = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, timeout=120
    )
    assert result.returncode == 0, result.stderr
    assert result.stdout.splitlines()[-1] == "LOADED []"
    for name in COMMANDS:
        assert f"usage: ddgrasp {name}" in result.stdout


def test_help_lists_every_command():
    result = ddgrasp("--help")
    assert result.returncode == 0
    for name, command in COMMANDS.items():
        assert f"  {name}" in result.stdout
        assert command.__doc__


def test_version_names_the_libraries():
    assert "mujoco 3.17." in ddgrasp("--version").stdout


@pytest.mark.parametrize(
    ("args", "expected"),
    [
        (("run", "--preset", "dmo"), "Unknown preset 'dmo'. Did you mean 'demo'?"),
        (("tacher", "train"), "Unknown command 'tacher'. Did you mean 'teacher'?"),
        (("teacher", "trian"), "Unknown command 'teacher trian'. Did you mean 'teacher train'?"),
        (("run", "--world.objects", "cube", "aple"), "Unknown object 'aple'. Did you mean 'apple'?"),
        (("report", "nowhere"), "nowhere holds no finished stage"),
        (("demos", "collect", "--out", "nowhere"), "nowhere has no finished stage 'teacher': run it first"),
    ],
)
def test_wrong_input_gets_one_line_and_status_2(args, expected):
    result = ddgrasp(*args)
    assert result.returncode == 2
    assert expected in _one_error_line(result)
    assert not (ROOT / "nowhere").exists()


def test_an_unknown_option_is_named():
    result = ddgrasp("run", "--teacher.bogus", "3")
    assert result.returncode == 2
    assert "--teacher.bogus" in result.stderr


def test_a_full_disk_gets_one_line(tmp_path):
    code = f"""
import resource, sys
from ddgrasp import artifacts, cli, commands
resource.setrlimit(resource.RLIMIT_FSIZE, (512, resource.RLIM_INFINITY))
class Fill:
    def run(self):
        artifacts.atomic_write_bytes({str(tmp_path / "x")!r}, bytes(9999))
commands.parse = lambda name, args: Fill()
sys.exit(cli.main(["export"]))
"""
    result = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert result.returncode == 1
    assert _one_error_line(result).startswith("ddgrasp: No space left on the disk")


@pytest.mark.parametrize("name", sorted(PRESETS))
def test_every_preset_is_selected_by_its_name_and_names_known_objects(name):
    command = parse("run", ["--preset", name])
    assert command.config == PRESETS[name] == check_config_values(PRESETS[name])
    assert PRESETS[name].preset == name
    assert command.out == Path("runs") / name


def test_single_values_override_a_preset():
    command = parse(
        "run", ["--preset=debug", "--seed", "3", "--world.episode-steps", "9", "--resume", "--out", "x"]
    )
    assert (command.config.seed, command.config.world.episode_steps) == (3, 9)
    assert (command.resume, command.out) == (True, Path("x"))
    assert command.config.student == PRESETS["debug"].student


def test_unknown_objects_suggest_the_nearest():
    import dataclasses

    debug = PRESETS["debug"]
    wrong = dataclasses.replace(debug, world=dataclasses.replace(debug.world, objects=("cubes",)))
    with pytest.raises(UserError, match="Did you mean 'cube'"):
        check_config_values(wrong)
    nothing = dataclasses.replace(debug, world=dataclasses.replace(debug.world, objects=()))
    with pytest.raises(UserError, match="world.objects is empty; expected at least one of cube, apple"):
        check_config_values(nothing)
