"""Where a policy loses, by cause: which rows there are, and the table that they leave behind."""

import hashlib
import json
import re
from dataclasses import asdict, replace
from pathlib import Path
from typing import get_args

import numpy as np
import pytest

from app.commands import parse
from ddgrasp.errors import UserError
from ddgrasp.layout import QPOS
from ddgrasp.presets import get_preset
from deploy.changes import Change, SightName, WorldName
from deploy.fr3_trials import Fr3Bench, Fr3Runner
from deploy.generated_camera import GENERATED
from deploy.trial_log import read_log
from deploy.trials import Rig, Trial, TrialResult, drawn
from deploy_support import constant_bias, describe, write_policy
from evaluation import causes, rig_trials
from evaluation.report import trials_page
from evaluation.rig_trials import Series
from mjx_envs.camera import nominal_camera
from rig.camera import RigCamera
from rig.world import make_world

CONFIG = get_preset("debug")
PROFILE = CONFIG.world.profile
ROOT = Path(__file__).parents[1]
SERIES = Series("development", objects=("cube", "can"), trials=1, seconds=0.5)


@pytest.fixture
def policy(tmp_path):
    info = describe(profile=PROFILE)
    return write_policy(tmp_path / "policy.onnx", info, bias=constant_bias(0.0, -1.0))


def test_every_row_is_one_change_of_what_it_is_compared_with():
    for name, row in causes.ROWS.items():
        reference = causes.ROWS[row.against].bench
        if isinstance(row.bench, Change) and name != causes.REFERENCE:
            assert isinstance(reference, Change)
            fields = ("world", "sight", "off")
            assert sum(getattr(row.bench, f) != getattr(reference, f) for f in fields) == 1, name
    fr3 = causes.ROWS["fr3"]
    assert fr3.bench == Fr3Bench("primitive", "ideal", bare=True, paired=True) and fr3.against == "ideal"


def test_help_and_page_name_every_row(capsys):
    with pytest.raises(SystemExit):
        parse("study causes", ["--help"])
    told = re.split(r"[ ,.│\n]+", capsys.readouterr().out)
    assert [name for name in causes.ROWS if name not in told] == []
    page = (ROOT / "docs" / "test_rig.md").read_text()
    assert [name for name in causes.ROWS if f"`{name}`" not in page] == [causes.REFERENCE]


def test_no_name_of_a_world_or_a_sight_stands_for_another_s():
    config = replace(CONFIG, world=replace(CONFIG.world, objects=("cube",)))
    worlds = {name: type(Change(world=name).make_world(config)) for name in get_args(WorldName)}
    assert len({*worlds.values()}) == len(worlds) - 1, worlds  # other tables are the camera's
    with pytest.raises(ValueError, match="no camera sees 'foggy'"):
        Change(sight="foggy")._camera(config, make_world(config.world))  # type: ignore[arg-type]


def test_rows_bring_what_they_are_compared_with():
    pytest.importorskip("franky_sim", reason="needs pip install -e '.[fr3]'")
    assert causes.chosen(("off_2mm",)) == ("development", "off_2mm")
    assert causes.chosen(("fr3",)) == ("development", "ideal", "fr3")
    assert causes.chosen(("all",)) == tuple(causes.ROWS)
    with pytest.raises(UserError, match="Unknown row 'mesh'. Did you mean 'meshes'"):
        causes.chosen(("mesh",))
    with pytest.raises(UserError, match="--rows names none: give all, or of development, ideal"):
        causes.chosen(())


def test_the_table_is_kept_and_its_trials_are_not_run_again(tmp_path, policy):
    out = tmp_path / "causes"
    names = causes.chosen(("ideal", "off_10mm"))
    made = causes.run(CONFIG, policy, names, SERIES, out, 0)
    rows = {row["row"]: row for row in made["rows"]}
    assert list(rows) == ["development", "ideal", "off_10mm"]
    assert rows["development"]["pairs"] is None and rows["development"]["success"]["n"] == 2
    pairs = rows["off_10mm"]["pairs"]
    assert (pairs["n"], pairs["only_reference"], pairs["only_row"], pairs["p"]) == (2, 0, 0, 1.0)
    assert rows["ideal"]["seconds_per_trial"] > 0
    lines = (out / causes.TABLE_FILE).read_text().splitlines()
    assert len(lines) == 5 and "0.0 % of 2 (0.0 to 65.8)" in lines[2] and "| 0, 0 of 2 |" in lines[4]
    assert json.loads((out / causes.JSON_FILE).read_text())["rows"] == made["rows"]
    log = (out / "ideal" / rig_trials.TRIALS_FILE).read_bytes()
    assert causes.run(CONFIG, policy, names, SERIES, out, 0)["rows"] == made["rows"]
    assert (out / "ideal" / rig_trials.TRIALS_FILE).read_bytes() == log
    other = Series("development", ("cube",), 1, number=1, seconds=0.5)
    with pytest.raises(UserError, match="begun otherwise: .*number is 0 there, 1 here"):
        causes.run(CONFIG, policy, names, other, out, 0)


def test_other_tables_are_no_row_where_every_row_has_them_and_settings_of_the_camera_are_told(
    tmp_path, policy, capsys
):
    stereo = replace(CONFIG.record.stereo, exposure_target=0.6)
    config = replace(CONFIG, record=replace(CONFIG.record, other_tables=True, stereo=stereo))
    names, series = causes.chosen(("other_tables",)), replace(SERIES, objects=("cube",))
    made = causes.run(config, policy, names, series, tmp_path, 0)
    assert [row["row"] for row in made["rows"]] == [causes.REFERENCE] and made["other_tables"] is True
    assert read_log(tmp_path / causes.REFERENCE / rig_trials.TRIALS_FILE)[0]["stereo"] == made["stereo"]
    assert made["stereo"] == ["exposure_target 0.6"]
    assert "row other_tables is left out" in "".join(capsys.readouterr())
    assert "record.stereo set to exposure_target 0.6:\n" in (tmp_path / causes.TABLE_FILE).read_text()


def test_a_plain_shape_is_added_to_trials_that_stay(tmp_path, policy):
    series, names = replace(SERIES, objects=("cube",)), causes.chosen(("off_10mm",))
    more = replace(series, objects=("cube", "stick"))
    causes.run(CONFIG, policy, names, series, tmp_path / "grown", 0)
    log = tmp_path / "grown" / "off_10mm" / rig_trials.TRIALS_FILE
    before = log.read_text()
    made = causes.run(CONFIG, policy, names, more, tmp_path / "grown", 0)
    assert [row["success"]["n"] for row in made["rows"]] == [2, 2] and log.read_text().startswith(before)
    causes.run(CONFIG, policy, names, more, tmp_path / "at once", 0)
    timed = ("sense_s", "infer_s", "act_s", "latency_s", "period_s")
    alone, beside = (
        [json.loads(line) | dict.fromkeys(timed) for line in path.read_text().splitlines()]
        for path in (log, tmp_path / "at once" / "off_10mm" / rig_trials.TRIALS_FILE)
    )
    assert alone == beside, "a scene with room for more objects is the same to the others"


def _first_frame(rig, trial, of):
    """(depth of a trial's first step, `of` its (model, data) at that moment)."""
    made = []

    def watch(step, camera):
        made.append((step.frame.depth.astype(int), of(*camera.scene())))
        return True

    rig.run(trial, watch)
    return made[0]


@pytest.mark.parametrize(
    "change",
    [Change(sight="ideal", off=(0.05, 0.0)), Change("furniture", sight="ideal")],
    ids=["camera off", "furniture"],
)
def test_every_trial_is_seen_in_its_changed_world_from_where_its_camera_stands(policy, change):
    config = causes.one_pose(SERIES.configured(CONFIG, policy))
    rig, plain = Rig(config, policy, change), Rig(config, policy, Change(sight="ideal"))
    for trial in SERIES.plan():  # two in one rig: nothing stays of the first
        draw = drawn(config, trial)
        pose = change.displaced(draw.T_world_cam, draw.world_seed)

        def rendered(model, data, pose=pose):
            profile = config.world.profile
            return RigCamera(model, config.record.stereo, profile, ideal=True).clean_mm(data, pose)

        seen, expected = _first_frame(rig, trial, rendered)
        np.testing.assert_array_equal(seen, expected)
        before, _ = _first_frame(plain, trial, rendered)
        assert np.mean(np.abs(seen - before) > 3) > 0.01


def test_a_generators_errors_take_the_place_of_the_cameras_or_of_one_kind_of_them():
    world = make_world(CONFIG.world)
    world.reset(3, "cube")
    pose = nominal_camera(PROFILE).T_world_cam
    camera = RigCamera(world.model, CONFIG.record.stereo, PROFILE)
    clean = camera.clean_mm(world.data, pose)
    own = camera.depth_mm(world.data, pose, np.random.default_rng(7), "cube")

    def seen(sight: SightName):
        made = Change(sight=sight).make_camera(CONFIG, world)
        return made.depth_mm(world.data, pose, np.random.default_rng(7), "cube")

    whole, holes, values = (seen(name) for name in GENERATED)
    np.testing.assert_array_equal(whole, seen("generator"))  # the same trial, the same errors
    assert 0.02 < np.mean(whole == 0) < 0.3 and 0.02 < np.mean(own == 0) < 0.3
    assert np.mean((whole == 0) != (own == 0)) > 0.01
    np.testing.assert_array_equal(holes == 0, whole == 0)
    np.testing.assert_array_equal(values == 0, own == 0)
    both = (own > 0) & (whole > 0)
    np.testing.assert_array_equal(holes[both], own[both])
    np.testing.assert_array_equal(values[both], whole[both])
    np.testing.assert_array_equal(holes[(own == 0) & (whole > 0)], clean[(own == 0) & (whole > 0)])


def test_frames_of_a_trial_share_a_generators_noise_and_another_trial_has_its_own():
    world = make_world(CONFIG.world)
    world.reset(3, "cube")
    pose, camera = nominal_camera(PROFILE).T_world_cam, Change(sight="generator").make_camera(CONFIG, world)
    first, other = np.random.default_rng(7), np.random.default_rng(8)
    frames = [camera.depth_mm(world.data, pose, rng) == 0 for rng in (first, first, other)]
    assert np.mean(frames[0] != frames[1]) < 0.7 * np.mean(frames[0] != frames[2])


def test_rows_with_a_generator_ask_for_its_file_before_anything_runs(tmp_path, policy):
    out, other = tmp_path / "causes", tmp_path / "generator.onnx"
    for content, wrong in ((None, "generator.onnx"), (policy.read_bytes(), "ddgrasp ddg export")):
        if content:
            other.write_bytes(content)
        with pytest.raises(UserError, match=wrong):
            causes.run(CONFIG, policy, ("development", "generator"), SERIES, out, 0, other)
    other_shape = ROOT / "pretrained" / "d435" / "generator.onnx"
    with pytest.raises(UserError, match="takes the shape of 320x240"):
        causes.run(CONFIG, policy, ("development", "generator"), SERIES, out, 0, other_shape)
    assert not out.exists()
    made = causes.run(CONFIG, policy, ("development", "generator"), SERIES, out, 0)
    sha256 = hashlib.sha256((ROOT / "pretrained" / "ddg" / "generator.onnx").read_bytes()).hexdigest()
    assert made["generator_sha256"] == sha256
    told = ["generator_sha256" in read_log(path)[0] for path in sorted(out.glob("*/trials.jsonl"))]
    assert told == [False, True]


def test_logs_of_other_lengths_are_not_paired_and_old_ones_without_go_on(tmp_path, policy):
    short, long = replace(SERIES, objects=("cube",)), replace(SERIES, objects=("cube",), seconds=0.6)
    for name, series in (("short", short), ("again", short), ("long", long)):
        causes.run(CONFIG, policy, (causes.REFERENCE,), series, tmp_path / name, 0)

    def trials(name: str) -> trials_page.Trials:
        made = trials_page.find(tmp_path / name / causes.REFERENCE)
        assert made is not None
        return made

    assert (trials("short").belong_to["seconds"], trials("long").belong_to["seconds"]) == (0.5, 0.6)
    names = ("short", "again", "long")
    assert trials_page.compare([trials(n) for n in names])[1][-1][2:] == (
        "0 won, 0 lost of 1, p 1",
        "other trials",
    )
    log = tmp_path / "again" / causes.REFERENCE / rig_trials.TRIALS_FILE
    log.write_text(log.read_text().replace(', "seconds": 0.5', "", 1))
    old = log.read_bytes()
    assert trials_page.compare([trials("short"), trials("again")])[1][-1][2:] == ("other trials",)
    causes.run(CONFIG, policy, (causes.REFERENCE,), short, tmp_path / "again", 0)
    assert log.read_bytes() == old
    with pytest.raises(UserError, match="begun otherwise: config_hash is "):
        causes.run(CONFIG, policy, (causes.REFERENCE,), long, tmp_path / "again", 0)


def test_new_rows_of_a_folder_that_an_earlier_version_began_are_compared_with_its_own(tmp_path, policy):
    short = replace(SERIES, objects=("cube",))
    causes.run(CONFIG, policy, (causes.REFERENCE,), short, tmp_path, 0)
    log = tmp_path / causes.REFERENCE / rig_trials.TRIALS_FILE
    config = causes.one_pose(replace(short, rig="development").configured(CONFIG, policy))
    now, then, *_ = rig_trials.made_with(config, policy, ())["config_hash"]
    log.write_text(log.read_text().replace(now, then))
    made = causes.run(CONFIG, policy, (causes.REFERENCE, "ideal"), short, tmp_path, 0)
    assert read_log(tmp_path / "ideal" / rig_trials.TRIALS_FILE)[0]["config_hash"] == then
    assert made["rows"][-1]["pairs"] is not None


def test_a_row_that_was_begun_otherwise_is_said_before_any_is_tried(tmp_path, policy):
    names = causes.chosen(("ideal", "off_10mm"))
    short = replace(SERIES, objects=("cube",))
    causes.run(CONFIG, policy, names, short, tmp_path, 0)
    log = tmp_path / "off_10mm" / rig_trials.TRIALS_FILE
    log.write_text(log.read_text().replace('"rules": ', '"rules": 9', 1))
    for name in ("development", "ideal"):
        (tmp_path / name / rig_trials.TRIALS_FILE).unlink()
    with pytest.raises(UserError, match=r"off_10mm/trials.jsonl was begun otherwise: rules is 9\d there"):
        causes.run(CONFIG, policy, names, short, tmp_path, 0)
    assert not list(tmp_path.glob("development/*.jsonl"))


def test_rows_that_were_tried_otherwise_are_not_compared(tmp_path, policy):
    names = causes.chosen(("ideal",))
    causes.run(CONFIG, policy, names, SERIES, tmp_path, 0)
    log, kept = tmp_path / "ideal" / rig_trials.TRIALS_FILE, (tmp_path / "ideal" / "trials.jsonl").read_text()
    log.write_text(kept.replace(', "seconds": 0.5', "", 1))  # of before, which had them in the hash alone
    assert causes.table(tmp_path)[1]["pairs"]["n"] == 2
    for key in ("config_hash", "policy_sha256", "rules"):
        header, *lines = kept.splitlines(keepends=True)
        log.write_text("".join([json.dumps({**json.loads(header), key: "other"}) + "\n", *lines]))
        _, ideal = causes.table(tmp_path)
        assert ideal["pairs"] is None and ideal["success"]["n"] == 2
        assert ideal["differs"][0].startswith(f"{key} is other, not ")
        assert causes.markdown([ideal]).splitlines()[2].split("|")[4].strip() == "tried otherwise"


def test_pairs_and_holm_are_those_of_the_outcomes(tmp_path, policy):
    names = causes.chosen(("ideal",))
    causes.run(CONFIG, policy, names, SERIES, tmp_path, 0)
    log = tmp_path / "development" / rig_trials.TRIALS_FILE
    log.write_text(log.read_text().replace('"success": false', '"success": true'))
    reference, ideal = causes.table(tmp_path)
    assert reference["success"]["rate"] == 1.0 and ideal["success"]["rate"] == 0.0
    pairs = ideal["pairs"]
    assert (pairs["only_reference"], pairs["only_row"], pairs["difference"]) == (2, 0, 1.0)
    assert pairs["p"] == pairs["p_holm"] == 0.5  # 2 of 2 one way: 2 / 2^2
    header, *trials = log.read_text().splitlines(keepends=True)
    other = [json.dumps({**json.loads(trial), "index": 99}) + "\n" for trial in trials[:1]]
    log.write_text("".join([header, *other]))  # no trial in common
    _, ideal = causes.table(tmp_path)
    assert ideal["pairs"] is None and ideal["against"] is None


def test_p_is_corrected_for_every_row_and_never_said_to_be_0(tmp_path):
    outcomes = {"development": [True] * 16, "ideal": [True] * 10 + [False] * 6, "meshes": [False] * 16}
    for name, wins in outcomes.items():
        times = dict.fromkeys(("sense_s", "infer_s", "act_s", "latency_s", "period_s"), [])
        lines: list[dict] = [{"row": name}]
        for index, success in enumerate(wins):
            trial = TrialResult(index, "cube", False, success, 1, 0, 0, {}, [], **times)
            lines.append(asdict(trial))
        (tmp_path / name).mkdir()
        log = tmp_path / name / rig_trials.TRIALS_FILE
        log.write_text("".join(json.dumps(line) + "\n" for line in lines))
    rows = causes.table(tmp_path)
    _, ideal, meshes = (row["pairs"] for row in rows)
    assert ideal["p"] == ideal["p_holm"] == 2 / 2**6
    assert (meshes["p"], meshes["p_holm"]) == (2 / 2**16, 2 * 2 / 2**16)
    shown = [line.split("|")[6].strip() for line in causes.markdown(rows).splitlines()[2:]]
    assert shown == ["", "0.0312", "< 0.0001"]


def test_seconds_a_trial_are_a_worker_s_and_of_every_session(tmp_path):
    times = tmp_path / causes.TIMES_FILE
    assert causes._seconds_per_trial(tmp_path) is None
    causes._add_time(tmp_path, 30.0, 8, 2)
    causes._add_time(tmp_path, 10.0, 2, 4)  # of which two have nothing to do
    assert causes._seconds_per_trial(tmp_path) == (30.0 * 2 + 10.0 * 2) / 10
    times.write_text(json.dumps({"seconds_per_trial": 5.0, "workers": 4}))  # as until 2026-11-28
    assert causes._seconds_per_trial(tmp_path) == 20.0
    causes._add_time(tmp_path, 10.0, 1, 0)
    assert causes._seconds_per_trial(tmp_path) == (20.0 + 10.0) / 2


def test_a_trial_of_the_fr3_is_the_development_rig_s(policy, tmp_path):
    config, trial = causes.one_pose(SERIES.configured(CONFIG, policy)), Trial(9000, "can")
    draw = drawn(config, trial)
    world = make_world(config.world)
    world.reset(draw.world_seed, "can")
    runner = Fr3Runner(config, policy, Fr3Bench("primitive", "ideal", bare=True, paired=True))
    made = runner.draw(trial)
    at = world.data.qpos[QPOS.object_pos]
    assert (made.place["x_m"], made.place["y_m"]) == pytest.approx((at[0], at[1]))
    np.testing.assert_array_equal(made.T_world_cam, draw.T_world_cam)
    assert made.policy_seed == draw.policy_seed
    quat = world.data.qpos[QPOS.object_quat]
    yaw_rad = made.place["yaw_rad"]
    np.testing.assert_allclose(
        np.abs(quat), np.abs([np.cos(yaw_rad / 2), 0, 0, np.sin(yaw_rad / 2)]), atol=1e-9
    )


def test_a_bare_fr3_stands_on_the_development_rig_s_ground(policy, tmp_path, open_gl):
    pytest.importorskip("franky_sim", reason="needs pip install -e '.[fr3]'")
    pytest.importorskip("franky", reason="needs pip install -e '.[fr3]'")
    config = causes.one_pose(SERIES.configured(CONFIG, policy))
    trial, seen = SERIES.plan()[0], {}

    def keep(name):
        def watch(step, camera):
            seen.setdefault(name, step.frame.depth)

        return watch

    fr3 = Fr3Runner(config, policy, Fr3Bench("primitive", "ideal", bare=True, paired=True))
    try:
        result, _ = fr3.run(trial, keep("fr3"))
    finally:
        fr3.close()
    Rig(config, policy, Change(sight="ideal")).run(trial, keep("development"))
    assert result.steps == 5 and not any("fault" in event for event in result.events)
    ours, theirs = (seen[name].astype(int) for name in ("fr3", "development"))
    lower = slice(PROFILE.height_px // 2, None)  # below the arms: ground and object
    assert np.mean(np.abs(ours - theirs)[lower] <= 3) > 0.97


def test_can_and_block_rest_as_their_meshes_do_in_every_row():
    world = replace(CONFIG.world, random=replace(CONFIG.world.random, other_pose_share=0.5))
    assert causes.one_pose(replace(CONFIG, world=world)).world.random.other_pose_share == 0.0
