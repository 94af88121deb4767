"""Words of a command line that no command can use: refused in one line before anything is done."""

import ast
import contextlib
import dataclasses
import inspect
import io
import itertools
import subprocess
import sys
import textwrap
import typing
from pathlib import Path
from typing import Annotated, Literal, Optional

import pytest

from app import cli
from app.commands import COMMANDS, parse
from app.commands.words import _paths
from ddgrasp.config.checks import Range, kinds, stated
from ddgrasp.errors import UserError

ROOT = Path(__file__).parents[1]


def refused(args: list[str], capsys) -> str:
    """The one line that `ddgrasp ARGS` says as it refuses them."""
    assert cli.main(args) == 2
    told = capsys.readouterr()
    assert told.err.startswith("ddgrasp: ") and told.err.count("\n") == 1 and told.out == ""
    return told.err.removeprefix("ddgrasp: ")


# --- help ----------------------------------------------------------------------------------------

DECLARED = sorted(
    {base for command in COMMANDS.values() for base in command.__mro__ if dataclasses.is_dataclass(base)},
    key=lambda base: base.__qualname__,
)
"""The dataclasses whose fields are the options of commands."""


@pytest.mark.parametrize("declared", DECLARED, ids=lambda base: base.__qualname__)
def test_every_option_of_a_command_s_own_is_described(declared):
    (body,) = ast.parse(textwrap.dedent(inspect.getsource(declared))).body
    silent = [
        field.target.id
        for field, behind in itertools.zip_longest(body.body, body.body[1:])
        if isinstance(field, ast.AnnAssign) and not isinstance(behind, ast.Expr)
    ]
    groups = {name for name, kind in kinds(declared).items() if dataclasses.is_dataclass(_bare(kind))}
    assert set(silent) - groups - {"stage"} == set()  # a stage's name is no option


def _bare(kind: typing.Any) -> typing.Any:
    return typing.get_args(kind)[0] if typing.get_origin(kind) is Annotated else kind


# --- bounds --------------------------------------------------------------------------------------


def _bounded_options() -> list[tuple[str, str, Range]]:
    """(command, field, bounds) of every option of the commands' own whose bounds are stated, or None."""
    found = []
    for name, command in COMMANDS.items():
        for field, kind in kinds(command).items():
            inner = stated(kind)
            ranges = [mark for mark in typing.get_args(inner)[1:] if isinstance(mark, Range)]
            if inner is not kind and typing.get_origin(inner) is Annotated and ranges:
                found.append((name, field, ranges[0]))
    return found


REQUIRED = {
    "teacher compare": ["runs/x"],
    "ddg thresholds": ["--model", "x", "--data", "x"],
    "ddg export": ["--model", "x"],
    "ddg distil": ["--model", "x", "--data", "x", "--out", "x"],
    "deploy trials": ["--policy", "x"],
}


@pytest.mark.parametrize(("name", "field", "bounds"), _bounded_options())
def test_the_bounds_of_every_optional_number_are_checked(name, field, bounds):
    option = f"--{field.replace('_', '-')}"
    given = [*REQUIRED.get(name, []), option]
    below = int(bounds.least) - (0 if bounds.above else 1)
    with pytest.raises(UserError, match=rf"{option} is {below}(\.0)?; expected "):
        parse(name, [*given, str(below)])
    inside = max(1, int(bounds.least))
    assert getattr(parse(name, [*given, str(inside)]), field) == inside
    assert getattr(parse(name, given[:-1]), field) is None


def test_the_optional_numbers_are_found():
    """Those that a person has to be able to get wrong."""
    found = {(name, field) for name, field, _ in _bounded_options()}
    assert {("teacher compare", "trials"), ("ddg thresholds", "count"), ("ddg export", "steps")} <= found
    assert len(found) >= 7


_BOUNDED = Annotated[int, Range(1, 3)]


@pytest.mark.parametrize(
    ("kind", "expected"),
    [
        (_BOUNDED | None, _BOUNDED),
        (Optional[_BOUNDED], _BOUNDED),  # noqa: UP045 - the other form that Python has of it
        (_BOUNDED, _BOUNDED),
        (None | int, int),
        (int, int),
        (Literal["a"] | None, Literal["a"]),
        (tuple[int, ...], tuple[int, ...]),
    ],
)
def test_what_an_optional_type_states_is_the_type_without_none(kind, expected):
    assert stated(kind) == expected


# --- lists, paths, text --------------------------------------------------------------------------


def test_rows_without_a_name_are_no_whole_tables(tmp_path, capsys):
    out = tmp_path / "study"
    told = refused(["study", "table2", "--preset", "debug", "--out", str(out), "--rows"], capsys)
    assert told.startswith("--rows names none: give rows (sim_gt, rand_noise,") and not out.exists()
    whole = parse("study table2", ["--preset", "debug", "--out", str(out)])
    assert whole.rows is None and whole.table == ("main",)
    assert "ddg" in whole.planned().rows


PATHS = [
    (name, option, form)
    for name, command in COMMANDS.items()
    for option in _paths(command)[0]
    for form in ([option, ""], [f"{option}="], [option.replace("-", "_").replace("__", "--"), ""])
]


@pytest.mark.parametrize(("name", "option", "form"), PATHS)
def test_an_empty_path_is_not_the_current_folder(name, option, form):
    with pytest.raises(UserError, match=f"^{option} is empty: give a path; . is the current folder.$"):
        parse(name, form)


@pytest.mark.parametrize(
    "name", ["report", "teacher eval", "teacher compare", "student eval", "weights convert", "demos export"]
)
def test_an_empty_path_without_an_option_is_refused_as_well(name):
    for args in ([""], ["--out", "x", ""], ["runs/x", ""]):
        with pytest.raises(UserError, match="^[A-Z-]+ is empty: give a path; . is the current folder.$"):
            parse(name, args)


def test_every_command_s_paths_are_known():
    assert _paths(COMMANDS["run"]) == (["--out", "--config"], [])
    assert _paths(COMMANDS["report"]) == ([], ["OUT", "OTHERS"])
    assert _paths(COMMANDS["play"]) == (["--policy", "--generator", "--out"], [])


def test_an_empty_text_still_says_none():
    assert parse("run", ["--preset", "debug", "--student.init-from", ""]).config.student.init_from == ""
    assert parse("study table2", ["--paper-generator", ""]).paper_generator == ""
    assert parse("ddg export", ["--model", "x", "--out", "."]).out == Path(".")


def test_a_name_that_is_no_utf_8_is_refused_in_one_line(tmp_path):
    args = [sys.executable, "-m", "app.cli", "play", "--out", b"gr\xfcn.mp4"]
    done = subprocess.run(args, cwd=ROOT, capture_output=True, text=True, timeout=60)
    assert done.returncode == 2 and done.stdout == ""
    assert done.stderr.startswith(r"ddgrasp: 'gr\udcfcn.mp4' is no UTF-8: give another name, or set LC_ALL")
    assert done.stderr.count("\n") == 1


# --- which remedy --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("command", "expected"),
    [
        ("play --rig fr3 --objects tower", "object 'tower' is a plain shape, which the development rig"),
        (
            "study causes --policy x --objects apple ring",
            "object 'ring' is a plain shape, which the dev",
        ),
        (
            "deploy trials --policy x --rig fr3 --objects puck",
            "object 'puck' is a plain shape, which the dev",
        ),
        (
            "deploy trials --policy x --rig development --preset demo --config a.yaml",
            "--config a.yaml and --preset demo both name a configuration: drop one.",
        ),
        (
            "study causes --policy x --rows ideal --config a.yaml",
            "--config a.yaml cannot be read (No such file",
        ),
        ("play aple --objects aple", "'aple' stands without an option"),
        ("play apple", "'apple' stands without an option: objects are given by --objects apple."),
        ("play runs/a/policy.onnx", "an option: a policy is given by --policy runs/a/policy.onnx."),
        ("deploy trials x.onnx --rig fr3", "an option: a policy is given by --policy x.onnx."),
        ("play apple can --trials 2", "objects are given by --objects apple can."),
        ("play --viewer web --out a.mp4", "--out is a.mp4, and --viewer web writes no file: leave out one."),
        ("play --viewer mujoco --out a.mp4", "--out is a.mp4, and --viewer mujoco writes no file"),
        ("play --viewer rerun --out a.mp4", "--out is a.mp4, and --viewer rerun writes no file"),
        ("play --viewer mujoco --out a.rrd", "--out is a.rrd, and --viewer mujoco writes no file"),
        ("run --teacher.bogus 3", "--teacher.bogus, 3. Options: ddgrasp run --help-all."),
        ("run --teacher.num-env 3", "Did you mean --teacher.num-envs? Options: ddgrasp run --help-all."),
        ("run --num-envs 3", "Options: ddgrasp run --help-all."),
        ("run --bogus", "--bogus. Options: ddgrasp run --help."),
        ("deploy --scale 0.1", "--scale makes nothing smaller that `ddgrasp deploy` does: leave it out."),
        ("calibrate --scale=0.1", "--scale makes nothing smaller that `ddgrasp calibrate` does"),
        ("ddg --preset demo", "`ddgrasp ddg` is half a command: put fit, sample, score, curve, samplers, f"),
        ("weights --out x", "put convert or list before --out."),
    ],
)
def test_a_mistake_names_its_remedy(command, expected, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert expected in refused(command.split(), capsys)
    assert list(tmp_path.iterdir()) == []


def test_a_deployment_without_a_policy_names_the_one_that_comes_with_the_project(
    capsys, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    told = refused(["deploy"], capsys)
    assert told.startswith("--policy is runs/demo/export/policy.onnx, which does not exist: make one with `d")
    assert "--policy pretrained/student/policy.onnx" in told
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("words", [["--help-all"], ["ddg", "--help-all"], ["help"], ["ddg", "--help"]])
def test_help_that_was_asked_for_is_no_mistake(words, capsys):
    assert cli.main(words) == 0
    assert "usage: ddgrasp COMMAND [options]" in capsys.readouterr().out


@pytest.mark.parametrize("name", ["run", "deploy", "study causes", "record fr3"])
def test_help_names_the_presets_where_one_can_be_given(name, capsys):
    for option in ("--help", "--help-all"):
        with pytest.raises(SystemExit):
            parse(name, [option])
        assert "\nPresets: debug, demo, laptop, student_paper, ppo, ppo_paper," in capsys.readouterr().out
    with pytest.raises(SystemExit):
        parse("objects list", ["--help"])
    assert "Presets:" not in capsys.readouterr().out


@pytest.mark.parametrize("encoding", ["utf-8", "ascii"])
@pytest.mark.parametrize("name", ["deploy", "calibrate", "run"])
def test_help_shows_scale_where_it_makes_something_smaller(name, encoding):
    for option in ("--help", "--help-all"):
        printed = io.TextIOWrapper(io.BytesIO(), encoding, newline="")
        with contextlib.redirect_stdout(printed), pytest.raises(SystemExit):
            parse(name, [option])
        printed.seek(0)
        told = printed.read()
        assert ("--scale FLOAT" in told) == ("below 1 a trial run" in told) == (name == "run")
        assert "--seed INT" in told and ("╰" in told) == (encoding == "utf-8")
