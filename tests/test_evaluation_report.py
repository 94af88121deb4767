"""report.json and report.html from manifests on disk."""

import base64
import json
import re
from dataclasses import replace
from pathlib import Path

import cv2
import matplotlib
import numpy as np
import pytest

from app.commands import parse
from ddgrasp import artifacts, machine
from ddgrasp.config import Config, StudentConfig
from ddgrasp.errors import UserError
from ddgrasp.progress import CURVES, PICTURES, Progress
from ddgrasp.stages import get_stage
from evaluation import wilson
from evaluation.report import figures
from evaluation.report.comparison import differences
from evaluation.report.html import flatten, numbers
from evaluation.report.meanings import explain
from evaluation.report.run_page import render_html
from evaluation.report.stage import write_report
from evaluation.report.summary import build_report, print_summary, summary_rows
from evaluation.report.targets import targets
from lerobot_support import write_deployment
from report_support import unexplained
from rig.film import INVALID_RGB, colored

CONFIG = Config(preset="debug")
ROOT = Path(__file__).parents[1]
METRICS = {
    "teacher": {"success": {"successes": 9, "n": 10}, "objects": {"cube": {"successes": 4, "n": 5}}},
    "demos": {"episodes": 120},
    "record": {"frames": 300, "invalid_fraction": 0.107},
    "ddg": {"loss": 0.02},
    "student": {
        "student_clean": {"success": {"successes": 7, "n": 10}},
        "student_ddg": {"success": {"successes": 6, "n": 10}},
        "tried": [{"encoder": "mean", "success": 0.1}, {"encoder": "keypoints", "success": 0.6}],
    },
    "export": {"max_abs_diff": 3e-6},
    "deploy": {
        "student_rig": {"success": {"successes": 5, "n": 10}},
        "latency_ms": {"p50": 12.0, "p99": 20.25},
    },
}


@pytest.fixture
def run_dir(tmp_path):
    for name, metrics in METRICS.items():
        origin = "loaded" if name == "student" else "trained"
        artifacts.finish(tmp_path / name, name, CONFIG, seconds=10, metrics=metrics, origin=origin)
    return tmp_path


def test_the_report_has_the_promised_keys(run_dir):
    write_report(run_dir)
    report = json.loads((run_dir / "report.json").read_text())
    half = {"rate": 0.5, "n": 10, "successes": 5, "low": pytest.approx(0.23659, abs=1e-5)}
    assert half.items() <= report["student_rig"]["success"].items()
    assert report["teacher"]["success"]["rate"] == 0.9
    assert report["teacher"]["objects"]["cube"]["rate"] == 0.8
    assert report["student_clean"]["success"]["high"] > 0.7 > report["student_clean"]["success"]["low"]
    assert report["student_ddg"]["success"]["n"] == 10
    assert report["export"]["max_abs_diff"] == 3e-6
    assert report["deploy"]["latency_ms"] == {"p50": 12.0, "p99": 20.25}
    assert report["stages"]["teacher"] == {
        **report["stages"]["teacher"],
        "seconds": 10,
        "trained": True,
        "loaded": False,
    }
    assert report["stages"]["student"]["loaded"] is True
    assert report["machine"]["cores"] >= 1 and report["stages"]["ddg"]["machine"] == report["machine"]


def test_the_page_names_what_each_stage_was_made_on_not_where_it_was_written(run_dir, monkeypatch):
    here = render_html(build_report(run_dir), run_dir)
    assert "Made on " in here and "made on" not in here
    gpu = {"processor": "Xeon", "cores": 16, "system": "Linux x86_64", "accelerators": ["NVIDIA H100"]}
    monkeypatch.setattr(machine, "describe", lambda: gpu)
    artifacts.finish(run_dir / "teacher", "teacher", CONFIG, seconds=10, metrics=METRICS["teacher"])
    report = build_report(run_dir)
    assert report["stages"]["teacher"]["machine"] == gpu != report["machine"]
    assert "teacher made on Xeon, 16 cores, NVIDIA H100. " in render_html(report, run_dir)


def test_a_run_of_before_machines_were_noted_has_a_page_too(run_dir):
    for path in run_dir.glob("*/manifest.json"):
        value = json.loads(path.read_text())
        del value["machine"]
        path.write_text(json.dumps(value))
    report = build_report(run_dir)
    assert report["machine"] == {}
    assert "Made on a machine that was not noted then." in render_html(report, run_dir)


def test_a_seed_is_no_markup(run_dir):
    page = render_html(build_report(run_dir) | {"seed": "<script>1</script>"}, run_dir)
    assert "Seed &lt;script&gt;1&lt;/script&gt;." in page and "<script>" not in page


def test_the_table_ends_with_the_student_in_the_rig(run_dir, capsys):
    print_summary(build_report(run_dir))
    lines = capsys.readouterr().out.splitlines()
    assert lines[-1].split() == (
        "deploy exported student on the development rig: success 50.0 % of 10 (23.7 to 76.3)".split()
    )
    assert any("success 90.0 % of 10" in line and "this run" in line for line in lines)
    assert any("clean depth: success 70.0 % of 10" in line and "loaded" in line for line in lines)


def test_a_folder_of_another_stage_is_not_reported_as_the_one_it_is_called(tmp_path):
    artifacts.finish(tmp_path / "ddg", "export", CONFIG, seconds=1, metrics={"max_abs_diff": 1e-5})
    artifacts.finish(tmp_path / "student", "student", CONFIG, seconds=1, metrics=METRICS["student"])
    assert "ddg" not in build_report(tmp_path)["stages"]


def test_depth_that_is_not_the_generator_s_is_not_called_so(tmp_path):
    config = replace(CONFIG, student=StudentConfig(depth_source="dextrah"))
    artifacts.finish(tmp_path / "student", "student", config, seconds=1, metrics=METRICS["student"])
    said = [row[-1] for row in summary_rows(build_report(tmp_path))]
    assert any(text.startswith("depth of its training (dextrah): success 60.0 %") for text in said)
    assert not any("generated" in text for text in said)


@pytest.mark.parametrize(
    ("source", "expected"),
    [
        ("ideal", "depth of its training (ideal, 4 elliptic holes a picture): success 60.0 %"),
        ("learned", "generated depth (4 elliptic holes a picture): success 60.0 %"),
    ],
)
def test_holes_cut_into_training_depth_are_told(tmp_path, source, expected):
    config = replace(CONFIG, student=StudentConfig(depth_source=source, ellipse_dropout=4.0))
    artifacts.finish(tmp_path / "student", "student", config, seconds=1, metrics=METRICS["student"])
    assert any(row[-1].startswith(expected) for row in summary_rows(build_report(tmp_path)))


def test_a_picture_cut_short_is_named(run_dir):
    pictures = run_dir / "ddg" / PICTURES
    pictures.mkdir(exist_ok=True)
    np.savez_compressed(pictures / "maps.npz", depth=np.random.default_rng(0).random((8, 90, 160)))
    data = (pictures / "maps.npz").read_bytes()
    (pictures / "maps.npz").write_bytes(data[: len(data) // 2])
    write_report(run_dir)
    assert "maps.npz cannot be shown" in (run_dir / "report.html").read_text()


def test_an_incomplete_run_says_what_was_not_run(tmp_path):
    artifacts.finish(tmp_path / "teacher", "teacher", CONFIG, seconds=1, metrics=METRICS["teacher"])
    rows = summary_rows(build_report(tmp_path))
    assert rows[-1] == ("deploy", "", "", "not run")
    (tmp_path / "student" / "checkpoints").mkdir(parents=True)
    (tmp_path / "student" / "checkpoints" / "100").touch()
    said = {row[0]: row[-1] for row in summary_rows(build_report(tmp_path))}
    assert said["student"] == "begun, not finished: the same command with --resume goes on"
    assert said["export"] == "not run"
    assert "student_rig" not in build_report(tmp_path)


def test_what_an_earlier_parent_led_to_is_left_out(tmp_path):
    made: dict[str, artifacts.Artifact] = {}
    for name, metrics in METRICS.items():
        parents = [made[parent] for parent in get_stage(name).parents]
        about = {"seconds": 10, "metrics": metrics, "parents": parents}
        made[name] = artifacts.finish(tmp_path / name, name, CONFIG, **about)
    assert build_report(tmp_path)["outdated"] == {}
    again = replace(
        made["student"].manifest, metrics={"student_clean": {"success": {"successes": 0, "n": 7}}}
    )
    artifacts.write_manifest(tmp_path / "student", again)
    report = build_report(tmp_path)
    assert report["outdated"] == {"export": "student", "deploy": "export"}
    assert "student_rig" not in report and report["student_clean"]["success"]["n"] == 7
    rows = {row[0]: row[3] for row in summary_rows(report) if row[0]}
    assert rows["export"] == "left out: made of another student than is here"
    assert rows["deploy"] == "left out: made of export, which is left out"


def test_a_score_of_an_earlier_generator_is_said_to_be_left_out(tmp_path):
    ddg = artifacts.finish(tmp_path / "ddg", "ddg", CONFIG, seconds=1, metrics={"loss": 0.02})
    artifacts.finish(tmp_path / "score", "score", CONFIG, seconds=1, metrics={}, parents=[ddg])
    artifacts.write_manifest(tmp_path / "ddg", replace(ddg.manifest, metrics={"loss": 0.01}))
    rows = {row[0]: row[3] for row in summary_rows(build_report(tmp_path))}
    assert rows["score"] == "left out: made of another ddg than is here"


def test_a_generator_of_recordings_from_elsewhere_is_not_left_out_with_the_run_s(tmp_path):
    teacher = artifacts.finish(tmp_path / "teacher", "teacher", CONFIG, seconds=1, metrics=METRICS["teacher"])
    artifacts.finish(tmp_path / "record", "record", CONFIG, seconds=1, metrics={}, parents=[teacher])
    artifacts.finish(tmp_path / "ddg", "ddg", CONFIG, seconds=1, metrics={"loss": 0.02})  # ddg fit --data
    artifacts.write_manifest(tmp_path / "teacher", replace(teacher.manifest, metrics={}))
    assert build_report(tmp_path)["outdated"] == {"record": "teacher"}


def test_names_of_folders_are_no_markup(tmp_path, capsys):
    config = replace(CONFIG, student=StudentConfig(init_from="runs/old[v2]:cat:[/x]"))
    artifacts.finish(tmp_path / "student", "student", config, seconds=1, metrics={})
    print_summary(build_report(tmp_path))
    assert "runs/old[v2]:cat:[/x]" in capsys.readouterr().out.replace("\n", "")


def test_a_machine_too_slow_for_the_real_clock_is_said(tmp_path):
    """Where a simulated camera's picture takes longer than frames may be old, no step runs the network."""
    nothing = {"p50": None, "p99": None}
    artifacts.finish(tmp_path / "deploy", "deploy", CONFIG, seconds=1, metrics={"latency_ms": nothing})
    report = write_report(tmp_path)
    assert summary_rows(report)[-1][-1].startswith("frame to command not measured: on the real clock every")
    assert "frame to command not measured" in (tmp_path / "report.html").read_text()


def test_what_is_no_run_is_refused_for_what_it_is(run_dir, tmp_path):
    (tmp_path / "empty").mkdir()
    (tmp_path / "file").touch()
    log = tmp_path / "tried" / "ddg" / "trials.jsonl"
    log.parent.mkdir(parents=True)
    log.touch()
    row = tmp_path / "table2" / "trials" / "development-test-0" / "ddg"
    row.mkdir(parents=True)
    (tmp_path / "table2" / "study.html").touch()
    write_deployment(tmp_path / "arm" / "one")
    for place, said in (
        ("empty", "holds no finished stage: nothing to report"),
        ("file", "is a file: name the folder"),
        ("absent", "is not there"),
        ("teacher", f"is one finished stage: name the run that it is of, {run_dir}"),
        ("tried", "holds trials, of ddg: name one of these folders"),
        ("arm", "holds deployments: they are reported a folder at a time"),
        ("table2", f"is a study, whose tables are in {tmp_path}/table2/study.html: name folders of its rows"),
    ):
        with pytest.raises(UserError, match=said):
            build_report(tmp_path / place)


def test_the_page_is_self_contained_and_shows_curves_and_pictures(run_dir):
    progress = Progress(run_dir / "ddg", quiet=True)
    progress.scalars(1, loss=1.0)
    progress.scalars(2, loss=0.5)
    progress.scalars(2, grad_norm=3.0)
    depth = np.full((20, 30), 800, np.uint16)
    depth[5:9] = 0
    progress.picture(
        "grafting", rgb=np.zeros((20, 30, 3), np.uint8), clean=depth / np.float32(1000), grafted=depth
    )
    progress.close()
    write_report(run_dir)
    page = (run_dir / "report.html").read_text()
    images = re.findall(r'<img alt="([^"]*)" src="data:image/png;base64,([^"]*)"', page)
    assert [alt for alt, _ in images] == ["loss of ddg", "grad_norm of ddg", "grafting"]
    for _, data in images:
        png = cv2.imdecode(np.frombuffer(base64.b64decode(data), np.uint8), cv2.IMREAD_COLOR)
        assert png.shape[0] > 50 and png.std() > 5
    assert not re.search(r'(src|href)="?(?!data:|"?#|"?data:)', page)
    assert "<td>keypoints</td><td>60 %</td>" in page


def test_the_page_opens_with_the_verdict_and_leads_to_every_section(run_dir):
    write_report(run_dir)
    page = (run_dir / "report.html").read_text()
    opening = page[: page.index("<nav")]
    assert "Targets: 2 met, 3 not met, 1 not measured." in opening
    assert "<td class=missed>not met" in opening and "50.0 % of 10 (23.7 to 76.3)" in opening
    anchors = re.findall(r'<a href="#([^"]*)"', page)
    assert anchors == re.findall(r'<h2 id="([^"]*)"', page)
    assert len(anchors) == len(METRICS) + 2


@pytest.mark.parametrize(("missed", "mark"), [(0, "met"), (2, "missed")])
def test_missed_deadlines_are_red(run_dir, missed, mark):
    metrics = METRICS["deploy"] | {"missed_deadlines": missed}
    artifacts.finish(run_dir / "deploy", "deploy", CONFIG, seconds=10, metrics=metrics)
    write_report(run_dir)
    assert f"at most 0<td>{missed}<td class={mark}>" in (run_dir / "report.html").read_text()


def test_targets_are_judged_by_what_was_measured():
    report = {"config": {"export": {"max_abs_diff": 1e-4}}}
    assert {target["met"] for target in targets(report)} == {"not measured"}
    report["teacher"] = {
        "success": wilson.success(954, 1000),
        "objects": {"cube": wilson.success(99, 100), "can": wilson.success(91, 100)},
    }
    report["export"], report["deploy"] = {"max_abs_diff": 2e-4}, {"latency_ms": {"p99": 99.0}}
    report["score"] = {"targets": [{"target": "FID", "measured": "0.1", "met": "met"}]}
    judged = [target["met"] for target in targets(report)]
    assert judged == ["met", "not met", "met", "not met", "not measured", "met", "not measured"]
    assert "91.0 % of 100" in targets(report)[1]["measured"]
    report["score_real"] = {"targets": [{"target": "FID", "measured": "0.3", "met": "not met"}]}
    named = {target["target"]: target["measured"] for target in targets(report)}
    assert (named["FID"], named["real depth: FID"]) == ("0.1", "0.3") and len(named) == 8


def test_every_number_of_a_whole_run_has_a_meaning_and_a_unit_where_it_needs_one():
    report = json.loads((ROOT / "pretrained" / "report.json").read_text())
    assert unexplained(report) == []
    shown = dict(flatten(report["record"]) + flatten(report["deploy"]))
    assert shown["invalid_fraction"] == "9.48 %" and shown["sense_ms.p50"] == "56.07 ms"
    assert explain("deploy.sense_ms.p50") == ("ms", "reading camera and joints: half take no longer")
    assert explain("loss/v_loss") == ("", "training loss: the value network's")
    assert explain("nonsense.of.ours") == ("", "")


def test_a_name_is_explained_if_all_of_its_parts_are(tmp_path):
    rate = {"rate": 0.5, "n": 2, "successes": 1, "low": 0.1, "high": 0.9}
    measured = {
        "sense_ms": {"p50": 1.0, "p51": 1.0}, "since_ms": {"p50": 1.0}, "success": rate, "flag": True,
        "objects": {"pear": rate}, "rows": [{"object": "pear", "jerk_max": 1.0, "jerk_least": 1.0}],
        "safety": {"action": 3, "holds_more": 1}, "text": "of nobody",
    }  # fmt: skip
    (curves := tmp_path / "deploy" / CURVES).parent.mkdir()
    curves.write_text('{"step": 1, "loss/v_loss": 1, "loss/w_loss": 1, "reward/lift": 1}\n')
    report = {"stages": {"deploy": {}}, "deploy": measured}
    assert unexplained(report, tmp_path) == [
        "deploy.jerk_least", "deploy.safety.holds_more", "deploy.sense_ms.p51", "deploy.since_ms.p50",
        "loss/w_loss",
    ]  # fmt: skip


def test_a_number_means_what_its_stage_measures():
    network, loop = "one evaluation of the network", "from a frame to the command"
    metrics = {"latency_ms": {"p50": 2.0}}
    assert network in numbers(metrics, "export") and loop in numbers(metrics, "deploy")
    assert explain("export.latency_ms.p50") == ("ms", f"{network}, on one thread: half take no longer")
    assert explain("deploy.latency_ms.p50")[1].startswith(loop)
    assert explain("deploy.safety.action")[1].endswith(": beyond the action's range")
    assert explain("student.tried.action")[1].endswith("loss of the actions, through perception")


def test_invalid_depth_has_a_colour_that_no_depth_has():
    depth = np.linspace(0.5, 2.0, 1000, dtype=np.float32).reshape(20, 50)
    depth[3, 4] = 0.0
    rgb = figures.color_depth(depth, 0.5, 2.0).astype(int)
    np.testing.assert_array_equal(rgb[3, 4], INVALID_RGB)
    rgb[3, 4] = rgb[3, 5]
    assert np.abs(rgb - INVALID_RGB).max(axis=-1).min() > 75


def test_depth_looks_as_in_films_and_as_the_scale_beside_it_says():
    depth = np.linspace(0.4, 2.1, 1000, dtype=np.float32).reshape(20, 50)
    depth[3, 4] = 0.0
    rgb = figures.color_depth(depth, 0.5, 2.0)
    np.testing.assert_array_equal(rgb, colored((depth * 1000).round().astype(np.uint16), 500, 2000))
    scale = matplotlib.colormaps[figures.DEPTH_COLORS](np.clip((depth - 0.5) / 1.5, 0, 1))[..., :3]
    off = np.abs(rgb - 255 * scale)[depth > 0]
    assert off.max() < 4  # of 255: the nearest millimetre, the nearest of 256 colours


def test_millimetres_and_metres_look_alike():
    metres = np.array([[0.0, 0.75], [1.25, 2.0]], np.float32)
    np.testing.assert_allclose(figures.depth_to_metres((metres * 1000).astype(np.uint16)), metres, atol=1e-6)
    np.testing.assert_array_equal(figures.depth_to_metres(np.array([[np.nan, np.inf]])), [[0.0, 0.0]])


def test_film_strips_have_a_row_per_panel():
    strip = figures.draw_panels(
        {"clean": np.full((3, 18, 32), 0.8), "noisy": np.full((3, 18, 32), 800, np.uint16)}
    )
    single = figures.draw_panels({"clean": np.full((18, 32), 0.8)})
    sizes = [cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR).shape for png in (strip, single)]
    assert sizes[0][0] > sizes[1][0] and sizes[0][1] > sizes[1][1]
    assert figures.draw_panels({"long": np.full((60, 18, 32), 0.8)}) == figures.draw_panels(
        {"long": np.full((figures.MAX_FRAMES, 18, 32), 0.8)}
    )
    with pytest.raises(ValueError, match="picture panel of shape"):
        figures.draw_panels({"bad": np.zeros(3)})


def test_two_runs_side_by_side_show_what_differs_alone(run_dir, tmp_path_factory, capsys):
    other = tmp_path_factory.mktemp("other")
    config = replace(CONFIG, seed=7, teacher=replace(CONFIG.teacher, num_envs=64))
    for name, metrics in METRICS.items():
        changed = metrics | ({"frames": 301} if name == "record" else {})
        artifacts.finish(other / name, name, config, seconds=10, metrics=changed, origin="trained")
    settings, results = differences([build_report(run_dir), build_report(other)])
    assert settings == [("seed", "0", "7"), ("teacher.num_envs", str(CONFIG.teacher.num_envs), "64")]
    assert results == [("record.frames", "300", "301")]
    parse("report", [str(run_dir), str(other)]).run()
    assert "record.frames" in capsys.readouterr().out
    page = (run_dir / "comparison.html").read_text()
    assert "teacher.num_envs" in page and "student_rig" not in page
    same, nothing = differences([build_report(run_dir)] * 2)
    assert same == nothing == []


def test_a_stage_that_was_made_with_other_settings_says_so(run_dir, tmp_path_factory):
    other = tmp_path_factory.mktemp("other")
    for name, metrics in METRICS.items():
        artifacts.finish(other / name, name, CONFIG, seconds=10, metrics=metrics, origin="trained")
    score = replace(CONFIG.score, frames=CONFIG.score.frames + 1)
    for directory, config in ((run_dir, CONFIG), (other, replace(CONFIG, score=score, seed=3))):
        artifacts.finish(directory / "score", "score", config, seconds=1, metrics={}, origin="trained")
    assert build_report(run_dir)["stages"]["score"]["made_with"] == {}
    write_report(other)
    report = build_report(other)
    assert report["stages"]["score"]["made_with"] == {"score.frames": score.frames}, "its seed is teacher's"
    assert "Made with other settings than the run's: 1" in (other / "report.html").read_text()
    settings, _ = differences([build_report(run_dir), report])
    assert settings == [("score: score.frames", str(CONFIG.score.frames), str(score.frames))]


def test_numbers_that_read_alike_and_differ_are_shown_whole(run_dir):
    one, other = build_report(run_dir), build_report(run_dir)
    other["ddg"]["loss"], other["deploy"]["latency_ms"]["p50"] = 0.020000125, None
    one["student_rig"]["success"], other["student_rig"]["success"] = (
        wilson.success(k, 10**6) for k in (500_000, 500_001)
    )
    assert differences([one, other, one]) == (
        [],
        [
            ("ddg.loss", "0.02", "0.020000125", "0.02"),
            ("deploy.latency_ms.p50", "12 ms", "", "12 ms"),
            ("student_rig.success", "500000 of 1000000", "500001 of 1000000", "500000 of 1000000"),
        ],
    )
