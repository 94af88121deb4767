"""The whole flow at its smallest: killed in every stage, resumed, reported. No quality is claimed.

The commands, and the code at the end, are those of docs/tutorials/.
"""

import json
import multiprocessing
import os
import signal
import subprocess
import sys
import time
from multiprocessing.context import ForkServerProcess
from pathlib import Path

import numpy as np
import pytest

from app import cli, pipeline
from ddgrasp import artifacts, attempts
from ddgrasp.presets import PRESETS
from report_support import unexplained
from tutorial_support import code, moved, small

ROOT = Path(__file__).parents[1]
TIMEOUT_S = 600.0
KILL_AFTER_S = 1.0


def _run(out: Path) -> list[str]:
    run, _ = small("reproduce.md")
    return [*moved(run, {"runs/small": out}), "--resume"]


def _start(out: Path) -> subprocess.Popen:
    command = [sys.executable, "-m", "app.cli", *_run(out)]
    return subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def _main(command: list[str], log: Path) -> None:
    os.chdir(ROOT)
    with log.open("w") as file:
        for stream in (1, 2):
            os.dup2(file.fileno(), stream)
    sys.exit(cli.main(command))


def _fork(command: list[str], log: Path) -> ForkServerProcess:
    """The command, begun in a process that has imported all stages already; both outputs go to `log`."""
    forks = multiprocessing.get_context("forkserver")  # imports are half of a short command's time
    forks.set_forkserver_preload([stage.module for stage in pipeline.STAGES])
    process = forks.Process(target=_main, args=(command, log))
    process.start()
    return process


def _given(command: list[str], log: Path) -> str:
    """Both outputs of a command that succeeds."""
    process = _fork(command, log)
    try:
        process.join(TIMEOUT_S)
        assert process.exitcode == 0, log.read_text()[-3000:]
    finally:
        process.kill()
    return log.read_text()


def _manifests(out: Path) -> dict[str, bytes]:
    return {path.parent.name: path.read_bytes() for path in out.glob(f"*/{artifacts.MANIFEST}")}


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """(run directory, manifests and exit code at each kill, standard output of the last attempt).

    Killed once in every stage, a moment after it began, and started again.
    """
    folder = tmp_path_factory.mktemp("flow")
    out, log = folder / "run", folder / "log.txt"
    log.touch()
    kills = []
    for stage in pipeline.STAGES:
        process = _fork(_run(out), log)
        try:
            deadline = time.monotonic() + TIMEOUT_S
            while not (out / stage.name / attempts.STARTED).exists() and process.is_alive():
                assert time.monotonic() < deadline, f"{stage.name} did not begin in time"
                time.sleep(0.05)
            time.sleep(KILL_AFTER_S)
        finally:
            process.kill()
            process.join()
        kills.append((_manifests(out), process.exitcode))
        assert len(kills[-1][0]) >= len(kills) - 1, log.read_text()[-3000:]
    resumed = _start(out)
    output, errors = resumed.communicate(timeout=TIMEOUT_S)
    assert resumed.returncode == 0, errors[-3000:]
    return out, kills, output


def test_killed_and_resumed_every_stage_ends_and_none_is_redone(finished):
    out, kills, _ = finished
    after = _manifests(out)
    assert set(after) == {stage.name for stage in pipeline.STAGES}
    assert kills[-1][0].keys() >= {stage.name for stage in pipeline.STAGES[:-1]}
    for before, _ in kills:
        assert {name: after[name] for name in before} == before
    codes = {
        stage.name: code
        for stage, (before, code) in zip(pipeline.STAGES, kills, strict=True)
        if stage.name not in before
    }
    assert set(codes.values()) == {-signal.SIGKILL}  # no attempt failed by itself
    assert codes.keys() >= {"teacher", "ddg", "student"}  # seconds long; others may have been done by then
    for stage in pipeline.STAGES:
        artifact = artifacts.require(out, stage.name, PRESETS["debug"])
        for parent in stage.parents:
            assert artifact.manifest.parents[parent] == artifacts.read_artifact(out / parent).hash


def test_the_report_has_every_promised_number(finished):
    out, _, _ = finished
    report = json.loads((out / "report.json").read_text())
    for name in ("teacher", "student_rig", "student_clean", "student_ddg"):
        success = report[name]["success"]
        assert 0 <= success["low"] <= success["rate"] <= success["high"] <= 1
        assert success["rate"] == success["successes"] / success["n"]
    assert report["student_rig"]["success"]["n"] == PRESETS["debug"].evaluation.rig_trials
    assert 0 <= report["export"]["max_abs_diff"] <= 1e-4
    assert 0 < report["deploy"]["latency_ms"]["p50"] <= report["deploy"]["latency_ms"]["p99"]
    for stage in pipeline.STAGES:
        entry = report["stages"][stage.name]
        assert entry["seconds"] > 0
        assert entry["trained"] != entry["loaded"]


def test_every_number_and_curve_of_the_report_is_explained(finished):
    out, _, _ = finished
    assert unexplained(json.loads((out / "report.json").read_text()), out) == []


def test_the_last_line_printed_is_the_student_in_the_rig(finished):
    out, _, output = finished
    success = json.loads((out / "report.json").read_text())["student_rig"]["success"]
    last = output.rstrip().splitlines()[-1]
    assert "exported student on the development rig" in last
    assert f"{100 * success['rate']:.1f} % of {success['n']}" in last
    assert f"({100 * success['low']:.1f} to {100 * success['high']:.1f})" in last


def test_the_page_has_a_picture_for_every_stage_that_makes_pictures(finished):
    page = (finished[0] / "report.html").read_text()
    assert page.count("data:image/png;base64,") >= 5
    assert "cannot be shown" not in page


def test_a_finished_run_is_only_reported_again(finished):
    out, _, _ = finished
    before = _manifests(out)
    again = _start(out)
    _, errors = again.communicate(timeout=TIMEOUT_S)
    assert again.returncode == 0, errors[-3000:]
    assert _manifests(out) == before  # what is made again says when and how long


def test_table_2_of_two_rows_from_the_run_s_own_parts(finished, tmp_path):
    out = tmp_path / "study"
    out.mkdir()
    (out / "shared").symlink_to(finished[0], target_is_directory=True)
    before = _manifests(finished[0])
    _, command = small("reproduce.md")
    command = moved(command, {"runs/small-table2": out})
    printed = _given(command, tmp_path / "log.txt")
    assert "Inpaint" in printed and "Table II" in printed
    assert _manifests(finished[0]) == before
    student = artifacts.read_artifact(out / "students" / "ideal" / "student").manifest
    assert student.config["student"]["depth_source"] == "ideal"
    assert student.config["student"]["training"]["disparity_noise_px"] == 0
    for parent in ("teacher", "demos", "ddg"):
        assert student.parents[parent] == artifacts.read_artifact(finished[0] / parent).hash
    study = json.loads((out / "study.json").read_text())
    (of,) = study["sets"].values()
    assert {row: table["all"]["n"] for row, table in of["rows"].items()} == {"sim_gt": 2, "inpaint": 2}
    assert study["rows"]["inpaint"]["student"] == study["rows"]["sim_gt"]["student"]
    for name in ("study.html", "study.png", "trials/development-development-0/inpaint/trials.jsonl"):
        assert (out / name).stat().st_size > 0
    trials = (out / "trials").rglob("trials.jsonl")
    kept = {path: path.read_text() for path in trials}
    _given(command, tmp_path / "log.txt")
    assert all(path.read_text() == text for path, text in kept.items())


def test_the_tutorial_s_generator_is_drawn(finished, tmp_path):
    """The run's own one: fitting on a folder is `tests/test_ddg_stage.py`'s."""
    _, sample = small("your_camera.md")
    places = {
        "runs/small": finished[0],
        "runs/small-room": tmp_path,
        "runs/small-room/ddg": finished[0] / "ddg",
    }
    _given(moved(sample, places), tmp_path / "log.txt")
    assert (tmp_path / "samples.png").stat().st_size > 0


def test_the_tutorial_s_code_takes_another_simulator_s_depth(finished):
    names: dict = {}
    for block in code("your_simulator.md"):
        exec(block.replace("pretrained/ddg", str(finished[0] / "ddg")), names)
    clean_m, reported_m, one_m = names["clean_m"], names["reported_m"], names["one_m"]
    assert reported_m.shape == clean_m.shape and one_m.shape == clean_m[0].shape
    np.testing.assert_array_equal(names["noisy"](clean_m, episode=0), reported_m)
    for noisy_m in (reported_m, np.asarray(one_m)):
        assert np.isfinite(noisy_m).all() and (noisy_m >= 0).all()


def test_the_tutorial_s_policy_answers_on_a_rig_and_in_a_loop_of_ones_own(finished, tmp_path):
    out = finished[0]
    (command,) = small("your_robot.md")
    _given(moved(command, {"runs/small": out, "runs/small-deployments": tmp_path}), tmp_path / "log.txt")
    assert [path.name for path in tmp_path.rglob("report.json")] == ["report.json"]
    (block,) = code("your_robot.md")
    names: dict = {}
    exec(block.replace("runs/demo", str(out)), names)
    assert names["action"].shape == (8,) and (abs(names["action"]) <= 1).all()
    assert (abs(names["target_rad"] - names["joints_rad"]) <= 0.1 + 1e-6).all()
