"""The whole flow at its smallest: killed in every stage, resumed, reported. No quality is claimed."""

import json
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from app import pipeline
from ddgrasp import artifacts
from ddgrasp.presets import PRESETS

ROOT = Path(__file__).parents[1]
TIMEOUT_S = 600.0
KILL_AFTER_S = 1.0


def _start(out: Path) -> subprocess.Popen:
    command = [sys.executable, "-m", "app.cli", "run", "--preset", "debug", "--out", str(out), "--resume"]
    return subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def _manifests(out: Path) -> dict[str, bytes]:
    return {path.parent.name: path.read_bytes() for path in out.glob(f"*/{artifacts.MANIFEST}")}


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """(run directory, manifests at each kill, standard output of the last attempt).

    Killed once in every stage, a moment after it began, and started again.
    """
    out = tmp_path_factory.mktemp("flow") / "run"
    kills = []
    for stage in pipeline.STAGES:
        process = _start(out)
        deadline = time.monotonic() + TIMEOUT_S
        while not (out / stage.name / artifacts.STARTED).exists() and process.poll() is None:
            assert time.monotonic() < deadline, f"{stage.name} did not begin in time"
            time.sleep(0.05)
        time.sleep(KILL_AFTER_S)
        process.send_signal(signal.SIGKILL)
        _, errors = process.communicate()
        kills.append(_manifests(out))
        assert len(kills[-1]) >= len(kills) - 1, errors[-3000:]
    resumed = _start(out)
    output, errors = resumed.communicate(timeout=TIMEOUT_S)
    assert resumed.returncode == 0, errors[-3000:]
    return out, kills, output


def test_killed_and_resumed_every_stage_ends_and_none_is_redone(finished):
    out, kills, _ = finished
    after = _manifests(out)
    assert set(after) == {stage.name for stage in pipeline.STAGES}
    assert kills[-1].keys() >= {stage.name for stage in pipeline.STAGES[:-1]}
    for before in kills:
        assert {name: after[name] for name in before} == before
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


def test_the_last_line_printed_is_the_student_in_the_rig(finished):
    out, _, output = finished
    success = json.loads((out / "report.json").read_text())["student_rig"]["success"]
    last = output.rstrip().splitlines()[-1]
    assert "exported student in the pseudo-real rig" in last
    assert f"{100 * success['rate']:.1f} % of {success['n']}" in last
    assert f"({100 * success['low']:.1f} to {100 * success['high']:.1f})" in last


def test_the_page_has_a_picture_for_every_stage_that_makes_pictures(finished):
    page = (finished[0] / "report.html").read_text()
    assert page.count("data:image/png;base64,") >= 5
    assert "cannot be shown" not in page


def test_a_finished_run_is_only_reported_again(finished):
    out, _, _ = finished
    before = _manifests(out)
    start = time.monotonic()
    again = _start(out)
    _, errors = again.communicate(timeout=TIMEOUT_S)
    assert again.returncode == 0, errors[-3000:]
    assert time.monotonic() - start < 60
    assert _manifests(out) == before


def test_table_2_of_two_rows_from_the_run_s_own_parts(finished, tmp_path):
    out = tmp_path / "study"
    out.mkdir()
    (out / "shared").symlink_to(finished[0], target_is_directory=True)
    before = _manifests(finished[0])
    chosen = ("--rows", "sim_gt", "inpaint", "--objects", "cube", "--trials", "2", "--workers", "1")
    chosen += ("--student.dagger.rounds", "0")
    command = [sys.executable, "-m", "app.cli", "study", "table2", "--preset", "debug", "--out", str(out)]

    def run() -> subprocess.CompletedProcess:
        args = [*command, *chosen, "--resume"]
        return subprocess.run(args, cwd=ROOT, capture_output=True, text=True, timeout=TIMEOUT_S)

    made = run()
    assert made.returncode == 0, made.stderr[-3000:]
    assert "Inpaint" in made.stdout and "Table II" in made.stdout
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
    assert run().returncode == 0 and all(path.read_text() == text for path, text in kept.items())
