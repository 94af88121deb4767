"""Trials of a policy on a rig: what it is shown, which logs are of the same trials, who works in a folder."""

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from app import table2
from ddgrasp import artifacts
from ddgrasp.config import Config
from ddgrasp.errors import UserError
from ddgrasp.policy_metadata import POLICY_FILE
from ddgrasp.presets import get_preset
from ddgrasp.progress import Progress
from ddgrasp.shipped import PRETRAINED
from deploy import treatment
from deploy.policy import OnnxPolicy
from deploy.trial_log import read_log
from deploy_support import constant_bias, describe, write_policy
from evaluation import rig_trials
from evaluation.report import trials_page
from evaluation.rig_trials import Series, differing
from evaluation.table2.rows import ROWS
from foundation import store
from mjx_envs.objects import OBJECTS
from sensors.inpainting import inpainted
from weights_support import depth_anything_v2_small

CONFIG = get_preset("debug")
PROFILE = CONFIG.world.profile
SERIES = Series("development", ("cube",), trials=1, seconds=0.5)
QUIET = Progress(quiet=True)
TRIALS = rig_trials.TRIALS_FILE


@pytest.fixture
def policy(tmp_path) -> Path:
    info = describe(profile=PROFILE)
    return write_policy(tmp_path / "policy.onnx", info, bias=constant_bias(0.0))


def test_what_a_policy_was_trained_on_besides_the_papers_objects_can_be_tried(policy, tmp_path, monkeypatch):
    everything = Series("development", trials=2)
    assert len(everything.plan()) == 12 * 2
    assert everything.configured(CONFIG, policy).world.objects == everything.names()
    monkeypatch.setitem(OBJECTS, "mine", replace(OBJECTS["cube"], name="mine", category_id=99))
    series = replace(everything, objects=("stick", "mine", "cube"), seconds=0.3, trials=1)
    first = {trial.object_name: trial.index for trial in series.plan()}
    assert first["cube"] == everything.trial("cube", 0).index and len(set(first.values())) == 3
    assert min(first["stick"], first["mine"]) >= 12 * 1000
    assert series.configured(CONFIG, policy).world.objects == (*everything.names(), "stick", "mine")
    table = rig_trials.run(CONFIG, policy, series, tmp_path / "out", 0, QUIET)
    assert list(table["objects"]) == ["stick", "mine", "cube"] and table["other"]["n"] == 2
    more = replace(series, objects=("ring", "stick"))
    table = rig_trials.run(CONFIG, policy, more, tmp_path / "out", 0, QUIET)
    assert list(table["objects"]) == ["ring", "stick", "mine", "cube"] and table["all"]["n"] == 4
    assert len(read_log(tmp_path / "out" / TRIALS)[1]) == 4


@pytest.fixture
def seen(monkeypatch) -> list[np.ndarray]:
    """Every frame that a policy is given from here on, in this process."""
    frames, act = [], OnnxPolicy.act

    def watched(self, depth, *told):
        frames.append(depth.copy())
        return act(self, depth, *told)

    monkeypatch.setattr(OnnxPolicy, "act", watched)
    return frames


@pytest.fixture
def small_network(tmp_path_factory, monkeypatch) -> Config:
    """A configuration with which the monocular network, with random weights, takes little time."""
    depth_anything_v2_small(tmp_path_factory.getbasetemp())
    monkeypatch.setattr(store, "WEIGHTS_DIR", tmp_path_factory.getbasetemp())
    prior = replace(CONFIG.ddg.prior, input_px=28)
    return replace(CONFIG, ddg=replace(CONFIG.ddg, prior=prior))


def holes(frames: list[np.ndarray]) -> list[int]:
    return [int((frame == 0).sum()) for frame in frames]


# --- what the policy is shown --------------------------------------------------------------------


def test_a_policy_is_shown_depth_as_recorded_or_inpainted(tmp_path, policy, seen):
    rig_trials.run(CONFIG, policy, SERIES, tmp_path / "recorded", 0, QUIET)
    recorded = [*seen]
    assert len(recorded) == 5 and min(holes(recorded)) > 100
    seen.clear()
    rig_trials.run(CONFIG, policy, replace(SERIES, depth="inpaint"), tmp_path / "inpaint", 0, QUIET)
    assert holes(seen) == [0] * 5
    np.testing.assert_array_equal(seen[0], inpainted(recorded[0]))


def test_a_policy_is_shown_other_tables(tmp_path, policy, seen):
    rig_trials.run(CONFIG, policy, replace(SERIES, camera="other_tables"), tmp_path / "other", 0, QUIET)
    rig_trials.run(CONFIG, policy, SERIES, tmp_path / "own", 0, QUIET)
    headers = [read_log(tmp_path / name / TRIALS)[0] for name in ("other", "own")]
    assert [header["camera"] for header in headers] == ["other_tables", "stereo"]
    other, own = np.stack(seen[:5]), np.stack(seen[5:])
    assert other.shape == own.shape and np.mean(other != own) > 0.1


def test_other_tables_by_configuration_are_the_same_ones_and_other_trials(tmp_path, policy, seen):
    config = replace(CONFIG, record=replace(CONFIG.record, other_tables=True))
    rig_trials.run(CONFIG, policy, replace(SERIES, camera="other_tables"), tmp_path / "asked", 0, QUIET)
    rig_trials.run(config, policy, SERIES, tmp_path / "configured", 0, QUIET)
    np.testing.assert_array_equal(np.stack(seen[:5]), np.stack(seen[5:]))
    rig_trials.run(CONFIG, policy, SERIES, tmp_path / "own", 0, QUIET)
    configured, own = (read_log(tmp_path / name / TRIALS)[0] for name in ("configured", "own"))
    asked = read_log(tmp_path / "asked" / TRIALS)[0]
    assert rig_trials.differing(configured, asked, ("camera",)) == []
    assert rig_trials.differing(configured, own, ("camera",)) == ["camera is other_tables, not stereo"]
    assert (
        json.loads((tmp_path / "configured" / "table.json").read_text())["asked"]["camera"] == "other_tables"
    )
    with pytest.raises(UserError, match="begun otherwise"):
        rig_trials.check_place(CONFIG, policy, SERIES, tmp_path / "configured")


def test_a_policy_is_shown_the_monocular_network_s_depth(tmp_path, policy, seen, small_network):
    rig_trials.run(small_network, policy, replace(SERIES, depth="monocular"), tmp_path / "out", 0, QUIET)
    assert len(seen) == 5 and holes(seen) == [0] * 5


@pytest.mark.flaky(reruns=2, only_rerun=["UDP receive: Timeout"])
def test_so_it_is_on_the_test_rig(tmp_path, policy, seen, open_gl, monkeypatch):
    pytest.importorskip("franky_sim", reason="needs pip install -e '.[fr3]'")
    pytest.importorskip("franky", reason="needs pip install -e '.[fr3]'")
    recorded = []

    def kept(depth, radius_px):
        recorded.append(depth.copy())
        return inpainted(depth, radius_px)

    monkeypatch.setattr(treatment, "inpainted", kept)
    fr3 = replace(SERIES, rig="fr3", shapes="primitive", camera="coarse", depth="inpaint")
    rig_trials.run(CONFIG, policy, fr3, tmp_path, 0, QUIET)
    assert min(holes(recorded)) > 100 and holes(seen) == [0] * 5


@pytest.mark.parametrize("row", ["inpaint", "monocular"])
def test_so_it_is_in_table_2(tmp_path, policy, seen, small_network, row):
    assert ROWS[row].depth == row
    exported = artifacts.finish(tmp_path / "export", "export", small_network, seconds=0.0, metrics={})
    policy.rename(exported.directory / POLICY_FILE)
    study = table2.Study(small_network, tmp_path / "study", (row,), SERIES, 0, {})
    table2._try(study, row, small_network, exported)
    assert len(seen) == 5 and holes(seen) == [0] * 5


# --- which trials are the same -------------------------------------------------------------------

HEADER = {"rig": "fr3", "shapes": "mesh", "split": "test", "number": 3, "seconds": 12.0, "rules": 2}
HEADER |= {
    "ends": "with success",
    "draws_hash": "ab",
    "camera": "stereo",
    "contact": 30.0,
    "retry": True,
    "policy_sha256": "1",
}


def beside(tmp_path: Path, **changes) -> str:
    """What the page says of a log with this header beside HEADER's."""
    made = []
    for name, header in (("one", HEADER), ("other", {**HEADER, **changes})):
        lines = [{key: value for key, value in header.items() if value is not None}, TRIAL]
        (tmp_path / name).mkdir()
        (tmp_path / name / rig_trials.TRIALS_FILE).write_text("".join(json.dumps(v) + "\n" for v in lines))
        assert (trials := trials_page.find(tmp_path / name)) is not None
        made.append(trials)
    return trials_page.compare(made)[1][-1][-1]


TIMES = ("sense_s", "infer_s", "act_s", "latency_s", "period_s")
TRIAL = {"index": 0, "object_name": "cube", "realtime": False, "success": True, "steps": 1, "holds": 0}
TRIAL |= {"missed_deadlines": 0, "safety": {}, "events": [], **dict.fromkeys(TIMES, [])}


def test_trials_that_came_out_otherwise_are_named(tmp_path):
    outcomes = {"one": (True, True, False, False), "other": (True, False, True, False)}
    found = []
    for folder, won in outcomes.items():
        trials = [TRIAL | {"index": 7000 + i, "success": success} for i, success in enumerate(won)]
        (tmp_path / folder).mkdir()
        lines = "".join(json.dumps(line) + "\n" for line in (HEADER, *trials))
        (tmp_path / folder / rig_trials.TRIALS_FILE).write_text(lines)
        found.append(trials_page.find(tmp_path / folder))
    page = trials_page.write_comparison(found).read_text()
    assert f"<td>{tmp_path / 'other'}</td><td>cube 7002</td><td>cube 7001</td>" in page


@pytest.mark.parametrize(
    "change",
    [
        {"rig": "development"}, {"shapes": "primitive"}, {"split": "development"}, {"number": 4},
        {"seconds": 6.0}, {"rules": 1}, {"rules": None}, {"ends": "when the time is over"},
        {"draws_hash": "cd"},
    ],
    ids=str,
)  # fmt: skip
def test_logs_of_other_trials_are_not_paired(tmp_path, change):
    assert beside(tmp_path, **change) == "other trials"


@pytest.mark.parametrize(
    "change",
    [{"policy_sha256": "2"}, {"camera": "ideal"}, {"contact": 100.0}, {"retry": False}, {"depth": "inpaint"},
     {"draws_hash": None}],
    ids=str,
)  # fmt: skip
def test_logs_of_the_same_trials_tried_otherwise_are_paired(tmp_path, change):
    assert beside(tmp_path, **change) == "0 won, 0 lost of 1, p 1"


def test_headers_say_in_what_they_differ():
    assert differing(HEADER, HEADER) == []
    other = {**HEADER, "rules": 1, "contact": 100.0}
    assert differing(other, HEADER) == ["rules is 1, not 2"]
    assert differing(other, HEADER, ("contact",)) == ["rules is 1, not 2", "contact is 100.0, not 30.0"]
    development = {"rig": "development"}  # whose arm does not stop itself
    assert differing({**HEADER, **development}, {**other, **development, "rules": 2}, ("contact",)) == []


def test_seconds_that_an_old_header_lacks_are_in_the_configuration_s_hash():
    new = {**HEADER, "config_hash": "ab"}
    old = {key: value for key, value in new.items() if key != "seconds"}
    assert differing(old, new) == ["seconds is None, not 12.0"]
    assert differing(old, new, ("config_hash",)) == []
    assert differing({**old, "config_hash": "cd"}, new, ("config_hash",)) == ["config_hash is cd, not ab"]


def test_a_header_says_what_the_policy_sees_and_what_its_trials_are_drawn_from(policy):
    def header(config: Config = CONFIG, **changes) -> dict:
        series = replace(SERIES, **changes)
        return rig_trials._header(series.configured(config, policy), policy, series)

    assert header(depth="inpaint")["depth"] == "inpaint" and "depth" not in header()
    assert differing(header(depth="inpaint"), header()) == []
    for changed in (dict(camera_position_m=0.03), dict(joint_rad=0.0)):
        world = replace(CONFIG.world, random=replace(CONFIG.world.random, **changed))
        (found,) = differing(header(replace(CONFIG, world=world)), header())
        assert found.startswith("draws_hash is ")
    blurred = replace(CONFIG.record, stereo=replace(CONFIG.record.stereo, lens_blur_px=1.0))
    found = differing(header(replace(CONFIG, record=blurred)), header())
    assert found[0].startswith("draws_hash is ") and found[1:] == ["stereo is ['lens_blur_px 1.0'], not None"]
    trained_otherwise = replace(CONFIG, student=replace(CONFIG.student, depth_source="ideal"))
    assert differing(header(trained_otherwise), header()) == []


def test_trials_before_a_camera_set_otherwise_say_so(tmp_path, policy, capsys):
    stereo = replace(CONFIG.record.stereo, exposure_target=0.7)
    config = replace(CONFIG, record=replace(CONFIG.record, stereo=stereo))
    rig_trials.run(config, policy, SERIES, tmp_path / "set", 0, Progress())
    assert "camera stereo, its record.stereo set to exposure_target 0.7" in capsys.readouterr().err
    assert read_log(tmp_path / "set" / rig_trials.TRIALS_FILE)[0]["stereo"] == ["exposure_target 0.7"]
    log = tmp_path / "set" / rig_trials.TRIALS_FILE
    header, *trials = log.read_text().splitlines(keepends=True)
    before = {key: value for key, value in json.loads(header).items() if key != "stereo"}
    log.write_text("".join([json.dumps(before) + "\n", *trials]))  # as begun before it was named
    rig_trials.run(config, policy, replace(SERIES, trials=2), tmp_path / "set", 0, QUIET)
    assert read_log(log)[0] == before and len(read_log(log)[1]) == 2
    without_errors = replace(SERIES, camera="ideal")
    assert "stereo" not in rig_trials._header(config, policy, without_errors)  # has no such camera
    rig_trials.run(CONFIG, policy, SERIES, tmp_path / "own", 0, Progress())
    assert "record.stereo" not in capsys.readouterr().err
    assert "stereo" not in read_log(tmp_path / "own" / rig_trials.TRIALS_FILE)[0]


def test_a_log_of_before_goes_on_and_keeps_its_header(tmp_path, policy):
    rig_trials.run(CONFIG, policy, SERIES, tmp_path, 0, QUIET)
    log = tmp_path / rig_trials.TRIALS_FILE
    header, *trials = log.read_text().splitlines(keepends=True)
    before = {key: value for key, value in json.loads(header).items() if key not in ("draws_hash", "trained")}
    log.write_text("".join([json.dumps(before) + "\n", *trials]))
    rig_trials.run(CONFIG, policy, replace(SERIES, trials=2), tmp_path, 0, QUIET)
    assert read_log(log)[0] == before and len(read_log(log)[1]) == 2
    other = replace(CONFIG, world=replace(CONFIG.world, random=replace(CONFIG.world.random, joint_rad=0.0)))
    with pytest.raises(UserError, match="begun otherwise: config_hash is"):
        rig_trials.run(other, policy, SERIES, tmp_path, 0, QUIET)


def test_a_log_of_an_earlier_version_goes_on_where_its_fields_alone_were_fewer(tmp_path, policy):
    rig_trials.run(CONFIG, policy, SERIES, tmp_path, 0, QUIET)
    log = tmp_path / TRIALS
    header, *trials = log.read_text().splitlines(keepends=True)
    now, then, *_ = rig_trials._header(CONFIG, policy, SERIES)["config_hash"]
    assert json.loads(header)["config_hash"] == now != then
    log.write_text("".join([json.dumps(json.loads(header) | {"config_hash": then}) + "\n", *trials]))
    rig_trials.run(CONFIG, policy, replace(SERIES, trials=2), tmp_path, 0, QUIET)
    assert read_log(log)[0]["config_hash"] == then and len(read_log(log)[1]) == 2
    holes = replace(CONFIG, student=replace(CONFIG.student, ellipse_dropout=4.0))  # of a later version
    with pytest.raises(UserError, match="begun otherwise: config_hash is"):
        rig_trials.check_place(holes, policy, SERIES, tmp_path)


@pytest.mark.parametrize("row", ["ddg", "sim_gt"])
def test_the_configuration_of_shipped_logs_is_known_whatever_fields_have_come_since(row):
    kept = read_log(PRETRAINED / "table2" / "trials" / "development-test-10" / row / TRIALS)[0]
    series = Series("development", split="test", number=10, trials=50)
    folder = PRETRAINED / "table2" / row
    config = artifacts.config_from_json(artifacts.read_manifest(folder).config)
    header = rig_trials._header(config, folder / POLICY_FILE, series)
    assert kept["policy_sha256"] == header["policy_sha256"]
    assert kept["config_hash"] in header["config_hash"][1:]


def test_another_object_s_trial_of_the_same_number_is_not_taken_for_it(tmp_path, policy, monkeypatch):
    rig_trials.run(CONFIG, policy, SERIES, tmp_path, 0, QUIET)
    known = Series.known
    monkeypatch.setattr(Series, "known", lambda self: ("stick", *known(self)))
    with pytest.raises(UserError, match=r"has trial 4000 of 'cube', a number that 'banana' has now"):
        rig_trials.run(CONFIG, policy, replace(SERIES, objects=("banana",)), tmp_path, 0, QUIET)


def test_what_a_policy_was_trained_on_is_seen_whichever_list_has_it(tmp_path, policy):
    config = replace(CONFIG, world=replace(CONFIG.world, objects=("wheel", "tin")))
    series = replace(SERIES, objects=("wheel", "apple"), trials=1)
    table = rig_trials.run(config, policy, series, tmp_path, 0, QUIET)
    assert read_log(tmp_path / rig_trials.TRIALS_FILE)[0]["trained"] == ["wheel", "tin"]
    found = trials_page.find(tmp_path)
    assert found
    for made in (table, found.table):
        assert made["seen"]["n"] == made["unseen"]["n"] == 1
    assert "wheel, tin" in trials_page.write(found).read_text()


# --- one process at a time -----------------------------------------------------------------------

WORKS = """
import sys, time
from pathlib import Path
from ddgrasp.alone import alone_in
with alone_in(Path(sys.argv[1])):
    print("at work", flush=True)
    time.sleep(60)
"""


def test_a_series_that_runs_already_is_not_run_twice(tmp_path, policy, seen):
    out = tmp_path / "out"
    out.mkdir()
    command = [sys.executable, "-c", WORKS, str(out)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as other:
        assert other.stdout and other.stdout.readline() == "at work\n"
        try:
            with pytest.raises(UserError) as refused:
                rig_trials.run(CONFIG, policy, SERIES, out, 0, QUIET)
            rig_trials.run(CONFIG, policy, SERIES, tmp_path / "elsewhere", 0, QUIET)
        finally:
            other.kill()
    assert str(refused.value) == (
        f"another process is at work in {out}: wait for it, or choose another --out."
    )
    assert len(seen) == 5 and not any(out.iterdir())
    assert rig_trials.run(CONFIG, policy, SERIES, out, 0, QUIET)["all"]["n"] == 1
