"""What perception is off by, from positions and angles set by hand; and what is kept of it."""

import re
from functools import partial
from pathlib import Path

import jax
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from app import cli
from ddgrasp import artifacts
from ddgrasp.config import RandomConfig
from ddgrasp.contract import GRIPPER_MAX_WIDTH_M, HOME_RAD
from ddgrasp.layout import OBSERVATION, QPOS
from ddgrasp.policy_metadata import POLICY_FILE
from ddgrasp.presets import PRESETS
from ddgrasp.scaling import with_values
from demos.store import STORE, EpisodeStore
from deploy.calibration.poses import reach
from deploy.safety import SafetyLimits
from deploy.trials import drawn
from deploy_support import constant_bias, describe, write_policy
from evaluation import perception, perception_table, rig_trials
from learning.params import save_params
from rig.world import RigWorld, make_world
from student_jax import act
from student_jax.data import YAW_MULTIPLE, aux_targets
from student_jax.policy import (
    AUX_BESIDE,
    PARAMS_FILE,
    POSITION_CENTER_M,
    Aux,
    param_shapes,
    position_from_world,
)

LAY = np.array([0.5, 0.0, 0.03])


def _seen(hand_m: list, lifted_m: list) -> perception.Seen:
    """A trial in which the hand is so far above the grasp, and the object so far above where it lay."""
    seen = perception.Seen()
    for hand, lifted in zip(hand_m, lifted_m, strict=True):
        observation = np.zeros(40)
        at = LAY + [0, 0, lifted]
        observation[OBSERVATION.object_pos] = at
        observation[OBSERVATION.grasp_pos] = at + [0, 0, 0.01]
        observation[OBSERVATION.grip_pos] = at + [0, 0, 0.01 + hand]
        observation[OBSERVATION.grasp_quat] = [0, np.cos(0.1), np.sin(0.1), 0]
        seen.observation.append(observation)
        seen.grasped.append(False)
    return seen


def _reported(seen: perception.Seen, away_m, turn_rad: float, held: list) -> Aux:
    truth = aux_targets(np.stack(seen.observation), np.zeros(len(held), bool))
    at = np.stack([row[OBSERVATION.grasp_pos] for row in seen.observation])
    yaw = np.arctan2(truth.yaw[:, 1], truth.yaw[:, 0]) + YAW_MULTIPLE * turn_rad
    logit = np.where(held, 3.0, -3.0)
    return Aux(position_from_world(at + away_m), np.stack([np.cos(yaw), np.sin(yaw)], 1), logit)


def test_every_part_of_a_trial_has_its_errors():
    seen = _seen([0.3, 0.2, 0.05, 0.0, 0.0], [0, 0, 0, 0.01, 0.1])
    reported = _reported(seen, np.array([0.003, -0.004, 0.002]), -0.2, [False, False, True, True, False])
    rows = perception.tabulate([perception.errors(seen, reported)], [True], ["cube"])
    assert [(row["trials"], row["hand"], row["steps"]) for row in rows] == [
        (outcome, hand, steps)
        for outcome in ("all", "success")
        for hand, steps in (("far", 2), ("near", 1), ("carried", 1))
    ] + [("cube", "near", 1)]  # step four has touched the object and not lifted it: in none
    for row in rows:
        assert row["horizontal_mm"] == pytest.approx(5.0, abs=0.1)
        assert row["height_mm"] == pytest.approx(2.0, abs=0.1)
        means = [row[f"mean_{axis}_mm"] for axis in "xyz"]
        assert means == pytest.approx([3.0, -4.0, 2.0], abs=0.1)
        assert row["yaw_deg"] == pytest.approx(np.degrees(0.2), abs=0.1)
    assert [row["held_wrong"] for row in rows[:3]] == [0.0, 1.0, 1.0]
    text = perception_table.describe(rows).splitlines()
    assert len(text) == 8 and "horizontal_mm" in text[0]


def test_what_is_round_has_no_error_of_yaw():
    seen = _seen([0.3, 0.05], [0, 0])
    seen.symmetry = 0
    reported = _reported(seen, np.zeros(3), 0.7, [False, False])
    apart = perception.errors(seen, reported)
    (row, *_) = perception.tabulate([apart], [True], ["apple"])
    assert row["yaw_deg"] is None
    both = perception.tabulate(
        [apart, perception.errors(turned := _seen([0.3], [0]), _reported(turned, np.zeros(3), 0.2, [False]))],
        [True, True], ["apple", "cube"],
    )  # fmt: skip
    assert [row["n_trials"] for row in both if row["trials"] == "all"] == [2, 1], "far in two, near in one"
    assert both[0]["yaw_deg"] == pytest.approx(np.degrees(0.2), abs=0.1)


def test_an_angle_is_off_from_the_nearest_that_grasps_as_well():
    """A quarter turn of a cube is none; half a turn of anything is none."""
    for symmetry, turn_deg, off_deg in ((2, 80, 80), (2, 100, 80), (4, 80, 10), (4, 50, 40), (4, -100, 10)):
        seen = _seen([0.3], [0])
        seen.symmetry = symmetry
        made = perception.errors(seen, _reported(seen, np.zeros(3), np.radians(turn_deg), [False]))
        assert np.degrees(made.yaw_rad) == pytest.approx(off_deg, abs=0.1)


def test_what_both_fingers_have_is_held_before_it_is_lifted():
    seen = _seen([0.05, 0.05], [0, 0])
    seen.grasped = [False, True]
    for said, wrong in (([False, True], 0.0), ([False, False], 0.5), ([True, False], 1.0)):
        (row, *_) = perception.tabulate(
            [perception.errors(seen, _reported(seen, np.zeros(3), 0.0, said))], [True], ["cube"]
        )
        assert (row["hand"], row["held_wrong"]) == ("near", wrong)


def test_the_rig_says_what_both_fingers_have_and_how_an_object_may_be_turned():
    world = RigWorld(("cube", "apple"), random=RandomConfig(**dict.fromkeys(("size", "object_mass"), 0.0)))
    world.reset(0, "apple")
    depth, state = np.zeros((3, 4, 6), np.uint16), np.zeros(9)
    round_one, seen = perception.Seen(), perception.Seen()
    perception._keep(round_one, depth, state, world)
    world.reset(0, "cube")
    grasp = np.eye(4)
    w, x, y, z = world.observation()[OBSERVATION.grasp_quat]
    grasp[:3, :3] = Rotation.from_quat([x, y, z, w]).as_matrix()
    grasp[:3, 3] = world.observation()[OBSERVATION.grasp_pos]
    q = reach(grasp, np.array(HOME_RAD), SafetyLimits())
    assert q is not None
    world.data.qpos[QPOS.arm], world.data.qpos[QPOS.fingers] = q, GRIPPER_MAX_WIDTH_M / 2
    for close in (False, True, False):
        world.command(q, close)
        world.step(1.0)
        perception._keep(seen, depth, state, world)
    assert seen.grasped == [False, True, False] and round_one.grasped == [False]
    assert (round_one.symmetry, seen.symmetry) == (0, 4)


def test_rows_stay_until_the_student_is_made_anew(tmp_path):
    directory = tmp_path / "student"
    artifacts.finish(directory, "student", PRESETS["debug"], seconds=1.0, metrics={})
    perception_table.save(directory, "stereo", [{"steps": 1}])
    perception_table.save(directory, "ideal", [{"steps": 2}])
    perception_table.save(directory, "stereo", [{"steps": 3}])
    assert perception_table.load(directory) == [
        {"camera": "ideal", "steps": 2},
        {"camera": "stereo", "steps": 3},
    ]
    artifacts.finish(directory, "student", PRESETS["debug"], seconds=2.0, metrics={"other": 1})
    assert perception_table.load(directory) == []


@pytest.fixture
def run_dir(tmp_path) -> Path:
    """A run whose arm stands still, and whose student sees the object held at POSITION_CENTER_M, always."""
    config = PRESETS["debug"]
    profile = config.world.profile
    params = jax.tree.map(
        lambda leaf: np.zeros(leaf.shape, leaf.dtype), param_shapes(config.student, profile)
    )
    bias = params["aux_output"]["bias"]
    bias[AUX_BESIDE.held], bias[AUX_BESIDE.near] = 3.0, -30.0
    (tmp_path / "student").mkdir()
    save_params(tmp_path / "student" / PARAMS_FILE, params)
    student = artifacts.finish(tmp_path / "student", "student", config, seconds=1.0, metrics={})
    (tmp_path / "export").mkdir()
    info = describe(profile=profile)
    write_policy(tmp_path / "export" / POLICY_FILE, info, bias=constant_bias(0.0))
    artifacts.finish(tmp_path / "export", "export", config, seconds=1.0, metrics={}, parents=[student])
    return tmp_path


def test_a_student_is_measured_before_the_camera_that_is_asked_for(run_dir, monkeypatch):
    monkeypatch.setattr(rig_trials, "Series", partial(rig_trials.Series, seconds=0.2))
    shares, keep = [], perception._keep

    def kept(seen: perception.Seen, depth: np.ndarray, *rest: np.ndarray) -> None:
        shares.append(float(np.mean(depth == 0)))
        keep(seen, depth, *rest)

    monkeypatch.setattr(perception, "_keep", kept)
    command, holes = ["student", "perception", str(run_dir), "--objects", "cube", "--trials", "1"], {}
    for camera in ("ideal", "stereo", "generator"):
        shares.clear()
        assert cli.main([*command, "--camera", camera]) == 0
        holes[camera] = np.mean(shares)
    assert holes["ideal"] < 0.001 < 0.02 < min(holes["stereo"], holes["generator"])
    assert holes["stereo"] != holes["generator"]
    cameras = sorted({row["camera"] for row in perception_table.load(run_dir / "student")})
    assert cameras[1:] == ["ideal", "stereo"] and re.fullmatch(r"generator \w{8}", cameras[0])


def test_a_student_is_measured_beside_the_rig_s_truth_and_not_an_earlier_one(run_dir, monkeypatch, capsys):
    short = partial(rig_trials.Series, seconds=0.5)
    monkeypatch.setattr(rig_trials, "Series", short)
    command = ["student", "perception", str(run_dir), "--objects", "cube", "--trials", "1"]
    assert cli.main(command) == 0
    rows = perception_table.load(run_dir / "student")
    assert [(row["camera"], row["trials"], row["hand"], row["steps"]) for row in rows] == [
        ("stereo", "all", "far", 5),
        ("stereo", "failure", "far", 5),
    ]
    series = short("development", ("cube",), 1)
    config = series.configured(PRESETS["debug"], run_dir / "export" / POLICY_FILE)
    world, trial = make_world(config.world), series.plan()[0]
    world.reset(drawn(config, trial).world_seed, trial.object_name)
    away_mm = 1e3 * (np.array(POSITION_CENTER_M) - world.observation()[OBSERVATION.grasp_pos])
    assert [rows[0][f"mean_{axis}_mm"] for axis in "xyz"] == pytest.approx(away_mm, abs=0.1)
    assert rows[0]["horizontal_mm"] == pytest.approx(np.linalg.norm(away_mm[:2]), abs=0.1)
    assert rows[0]["held_wrong"] == 1.0
    artifacts.finish(run_dir / "student", "student", PRESETS["debug"], seconds=2.0, metrics={})
    capsys.readouterr()
    assert cli.main(command) == 2
    assert "export is of an earlier student: delete it" in capsys.readouterr().err


def test_what_was_touched_and_lies_where_it_lay_has_been_touched():
    seen = _seen([0.05, 0.0, 0.05], [0, 0.01, 0])
    made = perception.errors(seen, _reported(seen, np.zeros(3), 0.0, [False] * 3))
    assert made.touched.tolist() == [False, True, True]


def test_a_student_is_measured_on_its_run_s_demonstrations_with_errors_on_their_depth(run_dir, monkeypatch):
    run = with_values(PRESETS["debug"], {"student.depth_source": "dextrah"})
    for stage in ("student", "export"):
        artifacts.finish(run_dir / stage, stage, run, seconds=1.0, metrics={})
    (run_dir / "demos").mkdir()
    store, profile = EpisodeStore(run_dir / "demos" / STORE, create=True), run.world.profile
    clean_mm = np.full((3, profile.height_px, profile.width_px), 900, np.uint16)
    for number, index in enumerate((0, 4, 0, 0)):  # apples and a cube, ever farther from where it is seen
        observation = np.stack(_seen([0.05] * 3, [0.0] * 3).observation).astype(np.float32)
        observation[:, OBSERVATION.grasp_pos] = np.array(POSITION_CENTER_M) + [0.01 * number, 0, 0]
        observation[:, OBSERVATION.grip_pos] = observation[:, OBSERVATION.grasp_pos] + [0, 0, 0.05]
        steps = {
            "depth_mm": clean_mm, "state": np.zeros((3, 8), np.float32),
            "action": np.zeros((3, 8), np.float32), "observation": observation, "held": np.zeros(3, bool),
        }  # fmt: skip
        store.append(steps, {"object_index": np.int32(index), "variant": np.int32(index)})
    artifacts.finish(run_dir / "demos", "demos", run, seconds=1.0, metrics={})
    given, perceive = [], act.perceive

    def seen(config, profile, params, depth, state):
        given.append(depth)
        return perceive(config, profile, params, depth, state)

    monkeypatch.setattr(act, "perceive", seen)
    assert cli.main(["student", "perception", str(run_dir), "--camera", "training", "--trials", "2"]) == 0
    rows = {row["trials"]: row for row in perception_table.load(run_dir / "student") if row["hand"] == "near"}
    assert {row["camera"] for row in rows.values()} == {"training"} and rows["all"]["n_trials"] == 3
    assert (rows["cube"]["n_trials"], rows["cube"]["mean_x_mm"]) == (1, -10.0)
    assert (rows["apple"]["n_trials"], rows["apple"]["mean_x_mm"]) == (2, -10.0)  # 0 and 20 mm, not 30
    assert len(given) == 3 and all(depth.shape == (3, 3, *clean_mm.shape[1:]) for depth in given)
    assert all(0.01 < np.mean(depth != 900) for depth in given)
