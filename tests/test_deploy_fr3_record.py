"""Recording on the FR3 rig: a way that the arm can be led, the development rig's format, going on."""

import contextlib
from dataclasses import replace

import numpy as np
import pytest

from ddgrasp import contract, policy_metadata
from ddgrasp.contract import HOME_RAD
from ddgrasp.errors import UserError
from ddgrasp.files import read_json
from ddgrasp.presets import get_preset
from ddgrasp.progress import Progress
from deploy import fr3_record, kinematics
from deploy.clock import RobotClock
from deploy.devices.franka_robot import LOST
from deploy.fr3_record import Takes
from deploy.guided_path import ABOVE_M, GRIP_STEPS, STEP_RAD, GuidedPath, plan
from deploy.interfaces import RobotError
from deploy.safety import SafetyFilter
from deploy.setup import safety_filter
from deploy_support import KinematicRobot, ScriptedCamera, depth_mm
from rig.fr3.scene import primitive
from sensors.recordings.recording import find_recordings

PRESET = get_preset("debug")
CONFIG = replace(PRESET, record=replace(PRESET.record, trajectories=2, frames=6))
LIMITS = safety_filter(
    PRESET.deploy, policy_metadata.describe(PRESET.student, PRESET.export, PRESET.world.profile), "franka"
).limits
PLACE = {"x_m": 0.50, "y_m": -0.08, "yaw_rad": 0.4}


def test_the_way_goes_to_the_object_takes_it_and_lets_it_go():
    cube = primitive("cube")
    stops = plan(cube, PLACE, LIMITS, np.random.default_rng(0))
    above, down = (kinematics.grip_pose(stop.q_rad) for stop in stops[:2])
    np.testing.assert_allclose(down[:3, 3], [0.50, -0.08, cube.rest_height_m], atol=1e-3)
    np.testing.assert_allclose(above[:3, 3] - down[:3, 3], [0, 0, ABOVE_M], atol=1e-3)
    closing = np.array([np.cos(0.4 + np.pi / 2), np.sin(0.4 + np.pi / 2), 0])  # the cube's y axis
    assert np.abs(down[:3, 1] @ closing) > 0.999 or np.abs(down[:3, 1] @ np.cross(closing, [0, 0, 1])) > 0.999
    assert [stop.close for stop in stops] == [False, False, *[True] * 5, *[False] * 5]
    for stop in stops:
        assert (stop.q_rad > LIMITS.lower_rad).all() and (stop.q_rad < LIMITS.upper_rad).all()
        assert kinematics.grip_position(stop.q_rad)[2] > 0.015


def test_an_arm_is_led_from_stop_to_stop_and_round_again():
    stops = plan(primitive("cube"), PLACE, LIMITS, np.random.default_rng(0))
    way, q = GuidedPath(stops), np.array(HOME_RAD)
    closed, steps = [], []
    for _ in range(300):
        action = way.action(q)
        step = action[:7] * contract.ACTION_SCALE_RAD
        closed.append(action[7] > 0)
        steps.append(np.abs(step).max())
        q = q + 0.9 * step
    assert max(steps) <= STEP_RAD + 1e-9
    changes = np.flatnonzero(np.diff(np.array(closed, int)))
    assert len(changes) >= 4, "it went round only once"
    assert changes[1] - changes[0] > GRIP_STEPS


def test_an_arm_that_is_held_up_is_led_on():
    stops = plan(primitive("cube"), PLACE, LIMITS, np.random.default_rng(0))
    way = GuidedPath(stops)
    asked = [way.action(np.array(HOME_RAD))[7] for _ in range(200)]
    assert max(asked) > 0, "it waits for an arm that does not come"


class Refusing(KinematicRobot):
    """Has a time of its own, and fails as it is to stop."""

    def __init__(self, clock: RobotClock, said: str):
        super().__init__(clock)
        self._time_s, self._said = 0.0, said
        clock.follow(self)

    def time_s(self) -> float:
        self._time_s += 0.11
        return self._time_s

    def stop(self) -> None:
        raise RobotError(self._said)


@pytest.mark.parametrize(("said", "lost"), [("the arm stopped itself: joint_reflex", False), (LOST, True)])
def test_an_arm_that_stops_itself_as_it_is_told_to_costs_none_of_the_frames(said, lost):
    clock = RobotClock()
    camera, robot = ScriptedCamera(clock, [depth_mm()]), Refusing(clock, said)
    way = GuidedPath(plan(primitive("cube"), PLACE, LIMITS, np.random.default_rng(0)))
    safety = SafetyFilter(LIMITS, contract.ACTION_SCALE_RAD)
    frames = fr3_record._led(camera, robot, safety, clock, way, 4)
    with pytest.raises(RobotError, match=LOST) if lost else contextlib.nullcontext():
        assert len(list(frames)) == 4
    assert camera.stopped


@pytest.mark.parametrize(
    ("takes", "message"),
    [
        (Takes(0, ("aple",)), "Unknown object 'aple'. Did you mean 'apple'"),
        (Takes(0, ("mug",), "primitive"), "Unknown object 'mug'"),
    ],
)
def test_unknown_objects_are_named_before_anything_runs(tmp_path, takes, message):
    pytest.importorskip("manifold3d", reason="needs pip install -e '.[fr3]'")
    with pytest.raises(UserError, match=message):
        fr3_record.record(CONFIG, takes, tmp_path / "out", Progress(quiet=True))
    assert not (tmp_path / "out").exists()


def test_what_is_no_recording_stays_where_one_was_to_be(tmp_path):
    pytest.importorskip("manifold3d", reason="needs pip install -e '.[fr3]'")
    notes = tmp_path / "out" / "fr3_0001" / "notes.txt"
    notes.parent.mkdir(parents=True)
    notes.write_text("mine")
    with pytest.raises(UserError, match="fr3_0001 is no recording"):
        fr3_record.record(CONFIG, Takes(0, ("cube",)), tmp_path / "out", Progress(quiet=True))
    assert notes.read_text() == "mine" and not (tmp_path / "out" / fr3_record.SETTINGS_FILE).exists()


def test_recordings_before_one_table_and_before_many_do_not_mix(tmp_path):
    takes = Takes(0, ("cube",))
    many = replace(CONFIG, record=replace(CONFIG.record, other_tables=True))
    for first, then in ((CONFIG, many), (many, CONFIG)):
        out = tmp_path / str(first.record.other_tables)
        fr3_record._begin(first, takes, out)
        fr3_record._begin(first, takes, out)
        assert read_json(out / fr3_record.SETTINGS_FILE)["record"].get("other_tables", False) is (
            first is many
        )
        with pytest.raises(UserError, match="were made otherwise"):
            fr3_record._begin(then, takes, out)


def test_two_trajectories_of_the_rig_are_recordings_and_are_kept(tmp_path, open_gl):
    pytest.importorskip("franky_sim", reason="needs pip install -e '.[fr3]'")
    pytest.importorskip("franky", reason="needs pip install -e '.[fr3]'")
    out, takes = tmp_path / "fr3", Takes(0, ("cube", "can"))
    one = replace(CONFIG, record=replace(CONFIG.record, trajectories=1))
    (first,) = fr3_record.record(one, takes, out, Progress(quiet=True))
    assert "other_tables" not in read_json(out / fr3_record.SETTINGS_FILE)["record"], "as before"
    written = (first.path / "meta.json").stat().st_mtime_ns
    fr3_record.record(CONFIG, takes, out, Progress(quiet=True))
    recordings = find_recordings(out)
    assert [(r.name, len(r), r.meta["object"]) for r in recordings] == [
        ("fr3_0000", 6, "cube"),
        ("fr3_0001", 6, "can"),
    ]
    assert (first.path / "meta.json").stat().st_mtime_ns == written
    profile = CONFIG.world.profile
    for recording in recordings:
        assert (recording.height_px, recording.width_px) == (profile.height_px, profile.width_px)
        assert recording.optics() == (profile.fx_px, profile.baseline_m) and recording.consecutive
        assert sorted(path.name for path in recording.path.iterdir()) == ["color", "depth", "meta.json"]
        assert recording.rgb(0).shape == (profile.height_px, profile.width_px, 3)
        before, after = (recording.depth_mm(i).astype(int) for i in (0, 5))
        assert 0.01 < np.mean(before == 0) < 0.5
        moved = (before > 0) & (after > 0) & (np.abs(after - before) > 30)
        assert moved.mean() > 0.002, "nothing moves in the pictures"
    with pytest.raises(UserError, match="recordings that were made otherwise"):
        fr3_record.record(CONFIG, replace(takes, seed=1), out, Progress(quiet=True))
