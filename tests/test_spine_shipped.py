"""What comes with the project: found by its name where there is no such folder, never instead of one."""

from pathlib import Path

import pytest

from app.commands import parse
from ddgrasp.errors import UserError
from ddgrasp.shipped import PRETRAINED, holding, shipped
from ppo import policy

ROOT = Path(__file__).parents[1]


def test_the_clone_has_it_beside_the_packages():
    assert PRETRAINED == ROOT / "pretrained"


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ("pretrained/teacher", PRETRAINED / "teacher"),
        (Path("pretrained"), PRETRAINED),
        ("pretrained/no", PRETRAINED / "no"),
        ("runs/pretrained", Path("runs/pretrained")),
        ("", Path()),
    ],
)
def test_elsewhere_its_name_leads_there(given, expected, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert shipped(given) == expected


def test_a_folder_of_that_name_comes_first(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "pretrained" / "teacher").mkdir(parents=True)
    assert shipped("pretrained/teacher") == Path("pretrained/teacher")
    with pytest.raises(UserError, match="^pretrained/teacher holds no teacher"):
        policy.find("pretrained/teacher")


def test_commands_and_stages_find_it_from_any_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert policy.find("pretrained/teacher") == PRETRAINED / "teacher" / "policy.msgpack"
    command = parse("deploy", ["--policy", "pretrained/student/policy.onnx"])
    assert command.policy == PRETRAINED / "student" / "policy.onnx"
    assert command.config.preset == "demo"
    played = parse("play", ["--generator", "pretrained/ddg", "--out", "pretrained/ddg"])
    assert (played.generator, played.out) == (PRETRAINED / "ddg", Path("pretrained/ddg"))
    report = parse("report", ["pretrained", "pretrained/table2", "runs/x"])
    assert report.out == PRETRAINED and report.others == (PRETRAINED / "table2", Path("runs/x"))


def test_a_stage_is_found_by_its_file_in_its_folder_or_in_a_run(tmp_path, monkeypatch):
    assert holding(tmp_path, "params", "ddg") is None
    (tmp_path / "ddg").mkdir()
    assert holding(tmp_path, "params", "ddg") is None
    (tmp_path / "ddg" / "params").touch()
    assert (
        holding(tmp_path, "params", "ddg") == holding(tmp_path / "ddg", "params", "ddg") == tmp_path / "ddg"
    )
    (tmp_path / "params").touch()
    assert holding(tmp_path, "params", "ddg") == tmp_path
    monkeypatch.chdir(tmp_path)
    assert holding("pretrained/ddg", "manifest.json", "ddg") == PRETRAINED / "ddg"
