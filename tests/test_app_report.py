"""`ddgrasp report`: what comes with the project is read alone; columns are told apart in 80 of a terminal."""

import re
import shutil
from pathlib import Path

import pytest

from app import cli
from app.commands.other import told_apart
from ddgrasp.shipped import PRETRAINED

LOGS = PRETRAINED / "table2" / "trials" / "development-9"


@pytest.fixture
def shipped_run(tmp_path, monkeypatch) -> Path:
    """A stand-in for `pretrained/`, so that a fault here overwrites nothing that is tracked."""
    run = tmp_path / "pretrained"
    for name in ("teacher", "student"):
        (run / name).mkdir(parents=True)
        shutil.copy(PRETRAINED / name / "manifest.json", run / name)
    (run / "report.json").write_text("tracked")
    monkeypatch.setattr("app.commands.checks.PRETRAINED", run)
    monkeypatch.chdir(tmp_path)
    return run


def _files(folder: Path) -> dict[str, bytes]:
    return {str(path): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_a_report_of_what_comes_with_the_project_is_printed_alone(shipped_run, capsys):
    before = _files(shipped_run)
    assert cli.main(["report", "pretrained"]) == 0
    told = capsys.readouterr().out
    assert told.startswith("pretrained comes with the project: nothing is written there; copy it to have")
    assert "Targets:" in told and "teacher" in told
    assert _files(shipped_run) == before


def test_so_is_a_comparison_that_begins_with_it(shipped_run, capsys, tmp_path):
    mine = tmp_path / "mine"
    shutil.copytree(shipped_run, mine)
    before = _files(shipped_run)
    assert cli.main(["report", "pretrained", "mine"]) == 0
    assert capsys.readouterr().out.startswith("pretrained comes with the project: nothing is written there")
    assert cli.main(["report", "mine", "pretrained"]) == 0
    assert capsys.readouterr().out.startswith("mine/comparison.html\n") and _files(shipped_run) == before


def test_a_copy_is_written_into(shipped_run, capsys, tmp_path):
    shutil.copytree(shipped_run, mine := tmp_path / "mine")
    assert cli.main(["report", "mine"]) == 0
    assert capsys.readouterr().out.startswith("mine/report.json\nmine/report.html\n")
    assert (mine / "report.json").read_text() != "tracked" and (mine / "report.html").exists()


@pytest.mark.parametrize(
    ("folders", "expected"),
    [
        ("runs/a runs/b", "a b"),
        ("runs/a/trials runs/b/trials", "a b"),
        ("runs/a/x/trials runs/b/trials", "a/x b"),
        ("runs/a runs/a/b", "a a/b"),
        ("/one/ddg two/ddg", "/one two"),
        ("a a", "a a"),
        (". runs/b", ". runs/b"),
    ],
)
def test_folders_are_told_apart_by_what_they_do_not_share(folders, expected):
    assert told_apart([Path(folder) for folder in folders.split()]) == expected.split()


@pytest.mark.skipif(not LOGS.is_dir(), reason="a wheel has no table2")
def test_columns_of_several_trials_are_told_apart_in_80_columns(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", "80")
    names = ["ddg_no_graft", "rand_noise_ripple", "rand_noise_double", "upper_bound"]
    for name in names:
        shutil.copytree(LOGS / name, tmp_path / "a_long_name_of_a_folder" / name)
    assert cli.main(["report", *(str(tmp_path / "a_long_name_of_a_folder" / name) for name in names)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines[1:])) <= 80
    first = next(i for i, line in enumerate(lines) if line.startswith(" apple"))
    starts = [rate.start() for rate in re.finditer(r"[\d.]+ % of 50", lines[first])]
    heading = lines[lines.index("") + 1 : first]  # as many lines as the longest name takes
    columns = zip(starts, [*starts[1:], 80], strict=True)
    assert ["".join(line[at:end].strip() for line in heading) for at, end in columns] == names
