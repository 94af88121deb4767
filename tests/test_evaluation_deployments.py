"""What of a folder of deployments counts as success, and what the page says of the rest."""

import json
import os
from pathlib import Path

import cv2
import numpy as np
import pytest

from evaluation.report import deployments
from evaluation.report.deployments import Deployment

REFLEX = "the arm stopped itself: reflex"


def deployment(success: bool | None = None, fault: str = "", **about) -> Deployment:
    report = {"steps": 10, "holds": 0, "missed_deadlines": 0, "events": [], "interrupted": False}
    report |= {"policy": "p.onnx", "robot": "sim", "camera": "stereo"}
    report |= {"success": success, "fault": fault, "latency_ms": {"p50": None, "p99": None}}
    return Deployment(Path("20261128-120000"), {**report, **about})


def test_a_fault_that_nobody_judged_is_a_failure():
    made = [deployment(True), deployment(True), *(deployment(fault=REFLEX) for _ in range(3))]
    assert deployments.verdict(made) == (
        "Success 40.0 % of 5 (11.8 to 76.9). Ended by a fault: 3. Missed deadlines: 0 in 50 steps."
    )


@pytest.mark.parametrize(
    ("made", "counts", "ended"),
    [
        (deployment(True), True, "lifted and held"),
        (deployment(False), False, "failed"),
        (deployment(), None, "not judged"),
        (deployment(fault=REFLEX), False, f"fault: {REFLEX}"),
        (deployment(True, REFLEX), True, f"lifted and held, then fault: {REFLEX}"),
        (deployment(fault=REFLEX, dry_run=True), None, f"fault: {REFLEX}"),
        (deployment(fault=REFLEX, interrupted=True), None, f"fault: {REFLEX}"),
        (deployment(interrupted=True), None, "interrupted"),
        (deployment(True, interrupted=True), True, "lifted and held, then interrupted"),
        (deployment(dry_run=True), None, "dry run"),
    ],
)
def test_what_counts(made, counts, ended):
    assert (made.success, made.ended) == (counts, ended)


def test_who_was_not_judged_is_named_and_dry_runs_stand_beside():
    made = [deployment(True), deployment(fault=REFLEX), deployment(), deployment(interrupted=True)]
    made += [deployment(dry_run=True), deployment(True, dry_run=True)]
    said = deployments.verdict(made)
    assert said.startswith("Success 50.0 % of 2 (") and "), 2 not judged. Ended by a fault: 1. " in said
    assert said.endswith(" in 40 steps. Beside them 2 dry runs.")
    assert deployments.verdict(made[2:4]).startswith("Success none was judged. Ended by a fault: 0.")


def test_practice_on_the_rig_is_no_trial_of_the_arm():
    on_arm, on_rig = ({"robot": "franka", "camera": camera} for camera in ("realsense", "rig"))
    made = [deployment(False, **on_arm), deployment(True, **on_rig), deployment(True, **on_rig)]
    said = deployments.verdict(made)
    assert said.startswith("Success p.onnx on franka with realsense: 0.0 % of 1 (")
    assert "; p.onnx on franka with rig: 100.0 % of 2 (" in said and ". Ended by a fault: 0. " in said
    assert deployments.verdict(made[1:]).startswith("Success 100.0 % of 2 (")


def test_two_policies_have_a_rate_each():
    made = [deployment(False, policy="old.onnx"), deployment(True, policy="new.onnx")]
    said = deployments.verdict(made)
    assert (
        "new.onnx on sim with stereo: 100.0 % of 1 (" in said and "; old.onnx on sim with stereo: 0.0" in said
    )


def test_a_policy_that_was_exported_again_is_another():
    made = [deployment(True, policy_sha256="a" * 64), deployment(False, policy_sha256="b" * 64)]
    said = deployments.verdict(made)
    assert "p.onnx (aaaaaaaa) on sim with stereo: 100.0 % of 1 (" in said and "p.onnx (bbbbbbbb) on" in said


def test_a_policy_whose_path_was_typed_otherwise_is_the_same():
    made = [
        deployment(True, policy_sha256="a" * 64),
        deployment(policy="runs/../p.onnx", policy_sha256="a" * 64),
    ]
    made.append(deployment(False))  # of before deployments had a hash
    said = deployments.verdict(made)
    assert (
        "p.onnx (aaaaaaaa) on sim with stereo: 100.0 % of 1 (" in said
        and "p.onnx (hash not noted) on" in said
    )


def test_the_page_says_what_counts(tmp_path):
    folder = tmp_path / "20261128-120000"
    folder.mkdir()
    (folder / "steps.jsonl").touch()
    (folder / "report.json").write_text(json.dumps(deployment(fault=REFLEX).report))
    page = deployments.write(tmp_path, deployments.find(tmp_path)).read_text()
    assert "Success 0.0 % of 1" in page
    assert "those that a fault ended, which failed unless report.json says otherwise" in page


def test_a_folder_s_name_may_be_no_utf8(tmp_path):
    """OpenCV, given it, ended the process."""
    folder = Path(os.fsdecode(bytes(tmp_path) + b"/x\xff"))
    folder.mkdir()
    (folder / "steps.jsonl").touch()
    (folder / "report.json").write_text(json.dumps(deployment(True).report))
    film = cv2.imencode(".png", np.full((4, 6, 3), 90, np.uint8))[1].tobytes()
    (folder / "film.png").write_bytes(film)
    page = deployments.write(tmp_path, deployments.find(tmp_path)).read_text()
    assert r"<td>x\udcff</td>" in page and "data:image/webp" in page


def test_a_film_that_is_a_folder_is_named(tmp_path):
    (tmp_path / "steps.jsonl").touch()
    (tmp_path / "report.json").write_text(json.dumps(deployment(True).report))
    (tmp_path / "film.png").mkdir()
    assert "film.png cannot be shown" in deployments.render(deployments.find(tmp_path))
