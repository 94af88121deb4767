"""`ddgrasp calibrate` from the first pose to what deploy says, the poses it plans, and what may go wrong.

The robot is an arm without inertia, the imager draws the board where the arm holds it.
"""

import errno
import json
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from app.cli import main
from app.commands import parse
from ddgrasp import policy_metadata
from ddgrasp.config import RandomConfig
from ddgrasp.errors import UserError
from ddgrasp.presets import get_preset
from deploy import clock, kinematics
from deploy import session as deploy_session
from deploy.calibration import poses, session, standing
from deploy.calibration.drive import ARRIVED_RAD, Driver
from deploy.calibration.hand_eye import invert, project, rotation_spread_rad
from deploy.calibration.session import CalibrationOptions
from deploy.calibration.standing import Offset, describe, offset
from deploy.clock import RobotClock
from deploy.devices import registry
from deploy.devices.fr3_imager import Fr3Imager, nominal_lens
from deploy.devices.options import SessionOptions
from deploy.devices.realsense_imager import lens_of
from deploy.interfaces import CameraError, RobotError
from deploy.safety import SafetyLimits
from deploy.session import for_devices
from deploy.setup import safety_filter
from deploy_support import HOME_RAD, KinematicRobot
from mjx_envs import draws
from mjx_envs import kinematics as quaternions
from mjx_envs.camera import look_at, nominal_pose
from rig.fr3.board import held_pose
from sensors.charuco_board import CharucoBoard

BOARD = CharucoBoard()
LENS = nominal_lens()
CONFIG = get_preset("debug")
SPREAD = RandomConfig()
INFO = policy_metadata.describe(CONFIG.student, CONFIG.export, CONFIG.world.profile)
SHIFT_M, TURN_RAD = np.array([0.004, -0.015, 0.003]), np.array([0.02, 0.0, -0.004])
T_BASE_CAM = draws.displaced(nominal_pose(), SHIFT_M, quaternions.quat_from_rotation_vector(TURN_RAD))
T_GRIP_BOARD = held_pose(BOARD, 3)
"""A few millimetres and degrees beside `CharucoBoard.held_pose`."""


class Arm(KinematicRobot):
    """Its own time passes whenever it is asked for: nobody waits."""

    fails_at = 10**9

    def __init__(self):
        super().__init__(SimpleNamespace(now=lambda: 0.0))
        self._time_s, self.commands = 0.0, 0

    def time_s(self) -> float:
        self._time_s += 0.11
        return self._time_s

    def command(self, q_target_rad, close):
        self.commands += 1
        if self.commands > self.fails_at:
            raise RobotError("the arm stopped itself: cartesian_reflex (it met something)")
        super().command(q_target_rad, close)


class DrawnImager:
    """The board's pattern, warped to where the arm holds it before a grey wall."""

    blind = False

    def __init__(self, arm: Arm):
        self._arm, self.calls, self.taken = arm, [], 0
        self._rng = np.random.default_rng(0)

    def start(self):
        self.calls.append("start")

    def lens(self):
        return LENS

    def truth(self):
        return T_BASE_CAM

    def stop(self):
        self.calls.append("stop")

    def picture(self):
        self.taken += 1
        size = (2 * LENS.width_px, 2 * LENS.height_px)
        gray = np.full(size[::-1], 120, np.uint8)
        if not self.blind:
            px, margin = 80, 40
            pattern = cv2.copyMakeBorder(
                BOARD.picture(px), margin, margin, margin, margin, cv2.BORDER_CONSTANT, value=(255,)
            )
            to_board = np.array([[1, 0, 0.5 - margin], [0, 1, 0.5 - margin], [0, 0, px / BOARD.square_m]])
            to_board *= BOARD.square_m / px
            T = invert(T_BASE_CAM) @ kinematics.grip_pose(self._arm.q_rad) @ T_GRIP_BOARD
            finer = np.array([[2.0, 0, 0.5], [0, 2.0, 0.5], [0, 0, 1]])
            H = finer @ LENS.matrix @ T[:3, [0, 1, 3]] @ to_board
            cv2.warpPerspective(pattern, H, size, gray, cv2.INTER_AREA, cv2.BORDER_TRANSPARENT)
        small = cv2.resize(gray, (LENS.width_px, LENS.height_px), interpolation=cv2.INTER_AREA)
        noisy = 0.7 * small + 30 + 2 * self._rng.standard_normal(small.shape)
        return np.clip(np.rint(noisy), 0, 255).astype(np.uint8)


@pytest.fixture(scope="module")
def planned():
    """Seven poses as `plan` finds them, once for all tests."""
    limits = safety_filter(CONFIG.deploy, INFO, "franka").limits
    return poses.plan(poses.Bench(limits, LENS, nominal_pose(), BOARD), 7, HOME_RAD, np.random.default_rng(0))


@pytest.fixture
def bench(monkeypatch, planned):
    """The arm and its imager under the names that the command line knows; waiting takes no time."""
    monkeypatch.setattr(clock, "time", SimpleNamespace(sleep=lambda s: None, monotonic=time.monotonic))
    monkeypatch.setattr(poses, "plan", lambda bench, count, *rest: planned[:count])
    arm = Arm()
    imager = DrawnImager(arm)
    monkeypatch.setitem(registry.ROBOTS, "franka", lambda setup: arm)  # type: ignore[arg-type]
    monkeypatch.setitem(registry.IMAGERS, "rig", lambda setup: imager)  # type: ignore[arg-type]
    return SimpleNamespace(arm=arm, imager=imager)


def options(tmp_path: Path, **changes) -> CalibrationOptions:
    given = CalibrationOptions("rig", "127.0.0.9", poses=7, speed_rad_s=0.6, yes=True)
    return replace(given, out=tmp_path / "cal.json", **changes)


def fast() -> object:
    """An arm at full speed, which keeps its own time: a camera of its own would have the machine's kept."""
    deploy = replace(CONFIG.deploy, franka=replace(CONFIG.deploy.franka, dynamics=1.0), clock="robot")
    return replace(CONFIG, deploy=deploy)


def test_a_run_finds_the_camera_and_deploy_says_so(tmp_path, bench):
    said: list[str] = []
    found = session.run(fast(), options(tmp_path), said.append)
    assert found is not None and bench.imager.calls == ["start", "stop"] and bench.arm.calls[-1] == "stop"
    away = offset(found.T_base_cam, T_BASE_CAM)
    assert away.distance_m < 1e-3 and away.angle_rad < np.radians(0.1) and found.rms_px < 0.25
    assert "pose 7 of 7: 24 of 24 corners" in said and any("against the truth" in line for line in said)
    assert bench.arm.close, "the hand keeps the board"
    kept = json.loads((tmp_path / "cal.json").read_text())
    assert len(kept["views"]) == 7 and all(view["used"] for view in kept["views"])
    assert kept["against_truth"]["distance_m"] == pytest.approx(away.distance_m)
    sheet = cv2.imread(str(tmp_path / "cal.png"))
    assert sheet is not None and sheet.shape == (720, 1280, 3)
    drawn = np.array(sheet, int)
    assert ((drawn[..., 1] - drawn[..., 2]) > 80).sum() > 500, "green rings"

    given = SessionOptions("franka", "rig", host="127.0.0.9", calibration=tmp_path / "cal.json")
    place = standing.standing(for_devices(CONFIG, given), given)
    assert place.line.startswith(f"calibrated {found.created[:10]}: the camera is 1")
    assert place.line.endswith("move it 15 mm to the robot's left; turn it 1.1 degrees down")
    record = place.as_dict()
    assert record is not None and record["trained_for"] is False
    np.testing.assert_allclose(record["shift_m"], SHIFT_M, atol=1e-3)
    np.testing.assert_allclose(record["turn_rad"], TURN_RAD, atol=2e-3)


def test_a_board_that_is_not_seen_ends_the_run_early_and_leaves_a_picture(tmp_path, bench):
    bench.imager.blind = True
    said: list[str] = []
    with pytest.raises(UserError, match=r"in none of 4 pictures; looked for: ChArUco board of 5 x 7"):
        session.run(fast(), options(tmp_path), said.append)
    assert (tmp_path / "not-seen.png").exists() and not (tmp_path / "cal.json").exists()
    assert "pose 4 of 7: board not seen" in said and bench.arm.calls[-1] == "stop"


def test_a_camera_without_pictures_is_told_from_a_board_that_is_not_seen(tmp_path, bench, monkeypatch):
    def unplugged():
        raise CameraError("unplugged")

    monkeypatch.setattr(bench.imager, "picture", unplugged)
    said: list[str] = []
    with pytest.raises(UserError, match="none of 7 poses gave a picture"):
        session.run(fast(), options(tmp_path), said.append)
    assert "pose 7 of 7: no picture (unplugged)" in said


@pytest.mark.parametrize(("device", "error"), [("imager", CameraError), ("arm", RobotError)])
def test_a_device_that_does_not_start_ends_the_run_in_one_line(tmp_path, bench, monkeypatch, device, error):
    def failing():
        raise error("no device is connected")

    monkeypatch.setattr(getattr(bench, device), "start", failing)
    with pytest.raises(UserError, match=r"^no device is connected\.$"):
        session.run(fast(), options(tmp_path), lambda text: None)
    assert bench.imager.calls[-1] == "stop"


def test_an_arm_that_stops_ends_the_run_in_one_line(tmp_path, bench):
    bench.arm.fails_at = 30
    with pytest.raises(UserError, match=r"ended at pose \d of 7: the arm stopped itself: .*\.$") as refused:
        session.run(fast(), options(tmp_path), lambda text: None)
    assert "\n" not in str(refused.value) and bench.imager.calls[-1] == "stop"


def test_an_arm_that_stops_late_costs_none_of_the_views_before(tmp_path, bench):
    command = bench.arm.command

    def stops(q_target_rad, close):
        if bench.imager.taken == 6:
            raise RobotError("the arm stopped itself: cartesian_reflex (it met something)")
        command(q_target_rad, close)

    bench.arm.command = stops
    said: list[str] = []
    found = session.run(fast(), options(tmp_path), said.append)
    assert found is not None and len(json.loads((tmp_path / "cal.json").read_text())["views"]) == 6
    assert any("ended at pose 7 of 7" in line and line.endswith("the views before it") for line in said)


def test_after_an_arm_has_met_something_it_goes_back(tmp_path, bench, planned, monkeypatch):
    """It gave way by itself: pushing on would be another contact."""
    read = bench.arm.read_state

    def met():
        state = read()
        near = 0.03 < np.abs(state.q_rad - planned[3]).max() < 0.2 and len(touches) == 0
        if near:
            touches.append(state.q_rad)
        return replace(state, met="12 N" if near else "")

    touches: list[np.ndarray] = []
    command, went = bench.arm.command, []

    def told(q_target_rad, close):
        command(q_target_rad, close)
        if touches:
            went.append(bench.arm.q_rad.copy())

    monkeypatch.setattr(bench.arm, "read_state", met)
    monkeypatch.setattr(bench.arm, "command", told)
    said: list[str] = []
    session.run(fast(), options(tmp_path), said.append)
    assert "pose 4 of 7: not reached, left out: something is in the way" in said and len(touches) == 1
    away_rad = [np.abs(planned - q).max(axis=1) for q in went]  # of every command, from every pose
    back = next(i for i, each in enumerate(away_rad) if each.min() < ARRIVED_RAD)
    assert away_rad[back].argmin() == 2, "to where it stood before"


def test_a_view_in_which_the_arm_moved_is_left_out(tmp_path, bench, monkeypatch):
    """Its joints would be between those of before and after the picture."""
    drawn = bench.imager.picture

    def sags():
        gray = drawn()
        if bench.imager.taken == 3:
            bench.arm.q_rad = bench.arm.q_rad + 2 * session.MOVED_RAD * np.eye(7)[1]
        return gray

    monkeypatch.setattr(bench.imager, "picture", sags)
    said: list[str] = []
    assert session.run(fast(), options(tmp_path), said.append) is not None
    assert "pose 3 of 7: the arm moved while the picture was taken, left out" in said
    assert len(json.loads((tmp_path / "cal.json").read_text())["views"]) == 6


def test_after_something_in_the_way_the_arm_goes_back_and_takes_free_ways_alone(
    tmp_path, bench, planned, monkeypatch
):
    free, limits = bench.arm.command, safety_filter(CONFIG.deploy, INFO, "franka").limits
    went: list[np.ndarray] = []
    halfway_rad = np.abs(planned[3] - planned[2]).max() / 2

    def blocked(q_target_rad, close):
        went.append(bench.arm.q_rad.copy())
        if np.abs(q_target_rad - planned[3]).max() > halfway_rad:
            free(q_target_rad, close)

    bench.arm.command = blocked
    said: list[str] = []
    found = session.run(fast(), options(tmp_path), said.append)
    assert "pose 4 of 7: not reached, left out: something is in the way" in said
    assert found is not None and sum(": 24 of 24 corners" in line for line in said) == 6
    planning = poses.Bench(limits, LENS, nominal_pose(), BOARD)
    assert all(poses.is_free(planning, q) for q in went), "no way that was not looked at"

    monkeypatch.setattr(poses, "is_free_way", lambda *way: False)
    with pytest.raises(UserError, match="none of 7 poses gave a picture"):
        session.run(fast(), options(tmp_path), said.append)
    assert said[-1] == "pose 7 of 7: left out, no free way from where the arm stands"


def test_an_arm_that_gets_neither_on_nor_back_ends_the_run(tmp_path, bench):
    free = bench.arm.command

    def jammed(q_target_rad, close):
        if bench.arm.commands < 20:
            free(q_target_rad, close)

    bench.arm.command = jammed
    with pytest.raises(
        UserError, match=r"ended at pose \d of 7: something is in its way, and on the way back"
    ):
        session.run(fast(), options(tmp_path), lambda text: None)


@pytest.mark.parametrize("trouble", [EOFError(), KeyboardInterrupt(), RobotError("cartesian_reflex")])
def test_taking_the_board_away_costs_no_calibration(tmp_path, bench, monkeypatch, trouble):
    def asked(question):
        if question.startswith("Take hold"):
            raise trouble

    monkeypatch.setattr("sys.stdin", SimpleNamespace(isatty=lambda: True))
    monkeypatch.setattr(session, "ask_person", asked)
    said: list[str] = []
    assert session.run(fast(), options(tmp_path, yes=False), said.append) is not None
    assert (tmp_path / "cal.json").exists() and "the board" in said[-1]


def test_a_log_that_nobody_writes_any_more_costs_no_calibration(tmp_path, bench):
    def gone(text):
        raise BrokenPipeError

    assert session.run(fast(), options(tmp_path), gone) is not None and (tmp_path / "cal.json").exists()


def test_a_picture_that_cannot_be_written_costs_no_calibration(tmp_path, bench, monkeypatch):
    monkeypatch.setattr(session, "atomic_write_bytes", Mock(side_effect=OSError(errno.ENOSPC, "full")))
    said: list[str] = []
    with pytest.raises(OSError, match="full"):
        session.run(fast(), options(tmp_path), said.append)
    assert (tmp_path / "cal.json").exists() and said[-1] == "the hand keeps the board"


def test_a_refused_calibration_leaves_the_one_before_and_its_picture(tmp_path, bench):
    before = {}
    for name in ("cal.json", "cal.png"):
        before[name] = name.encode()
        (tmp_path / name).write_bytes(before[name])
    narrow = replace(BOARD, square_m=0.020, marker_m=0.015)
    with pytest.raises(UserError, match=r"contradict one another .* Look at \S+cal-refused\.png"):
        session.run(fast(), options(tmp_path, board=narrow), lambda text: None)
    assert {name: (tmp_path / name).read_bytes() for name in before} == before
    assert cv2.imread(str(tmp_path / "cal-refused.png")) is not None


def test_where_calibrate_writes_by_itself_is_tried_too(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "runs").touch()
    with pytest.raises(UserError, match=r"calibration\.json, and \S+runs is no folder"):
        parse("calibrate", []).run()


def test_an_arm_that_does_not_stop_is_said(tmp_path, bench, monkeypatch):
    def refuse():
        raise RobotError("no answer")

    monkeypatch.setattr(bench.arm, "stop", refuse)
    said: list[str] = []
    assert session.run(fast(), options(tmp_path), said.append) is not None
    assert said[-1] == "the arm did not stop as it should: no answer"


@pytest.mark.parametrize("name", ["", "cal.png"])
def test_where_no_calibration_can_be_written_nothing_moves(tmp_path, bench, name):
    with pytest.raises(UserError, match="expected the name of a file, for example calibration.json"):
        session.run(fast(), replace(options(tmp_path), out=tmp_path / name), lambda text: None)
    assert bench.arm.commands == 0 and bench.imager.calls == []


def test_a_dry_run_moves_nothing(tmp_path, bench):
    said: list[str] = []
    assert session.run(fast(), options(tmp_path, dry_run=True), said.append) is None
    assert bench.arm.commands == 0 and np.array_equal(bench.arm.q_rad, HOME_RAD)
    assert any("arm and hand x -0.55 to 0.95, y -0.8 to 0.8, z 0 to 1.3 (" in line for line in said)
    assert said[-1].startswith("nothing moved; ") and (tmp_path / "dry-run.png").exists()
    assert sum(line.startswith("pose ") for line in said) == 7


def test_nobody_to_ask_moves_nothing(tmp_path, bench, monkeypatch):
    monkeypatch.setattr("sys.stdin", SimpleNamespace(isatty=lambda: False))
    with pytest.raises(UserError, match=r"Ready\? Nobody can be asked here: give --yes"):
        session.run(fast(), options(tmp_path, yes=False), lambda text: None)
    assert bench.arm.commands == 0


def test_an_arm_that_was_led_aside_is_planned_for_from_where_it_is(tmp_path, bench, monkeypatch):
    begun, real = [], session.poses.is_free_way

    def noted(bench, stood, target):
        begun.append(stood)
        return real(bench, stood, target)

    aside = np.array(HOME_RAD) + 0.05

    def led(question: str) -> None:
        if question.startswith("Hold"):
            bench.arm.q_rad = aside.copy()

    monkeypatch.setattr("sys.stdin", SimpleNamespace(isatty=lambda: True))
    monkeypatch.setattr(session, "ask_person", led)
    monkeypatch.setattr(session.poses, "is_free_way", noted)
    session.run(fast(), options(tmp_path, yes=False), lambda text: None)
    np.testing.assert_allclose(begun[0], aside)


def test_a_board_is_asked_for_whatever_may_move_unasked(tmp_path, bench, monkeypatch):
    monkeypatch.setitem(registry.IMAGERS, "realsense", lambda setup: bench.imager)
    monkeypatch.setattr("sys.stdin", SimpleNamespace(isatty=lambda: False))
    with pytest.raises(UserError, match="is given a board when it is open, and nobody can be asked for one"):
        session.run(fast(), options(tmp_path, camera="realsense"), lambda text: None)
    assert bench.arm.commands == 0
    asked: list[str] = []
    monkeypatch.setattr("sys.stdin", SimpleNamespace(isatty=lambda: True))
    monkeypatch.setattr(session, "ask_person", asked.append)
    session.run(fast(), options(tmp_path, camera="realsense"), lambda text: None)
    assert [question.split()[0] for question in asked] == ["Hold", "Take"]


def test_a_person_who_is_not_ready_is_not_told_that_nothing_has_moved(tmp_path, bench, monkeypatch):
    """The arm is at its start pose by then, its gripper homed."""
    monkeypatch.setattr("sys.stdin", SimpleNamespace(isatty=lambda: True))
    monkeypatch.setattr("builtins.input", lambda question: "n")
    with pytest.raises(UserError, match=r"^not confirmed: the arm stays where it is\.$"):
        session.run(fast(), options(tmp_path, yes=False), lambda text: None)
    assert bench.arm.commands == 0 and bench.arm.calls == ["start", "stop"]


def test_planned_poses_show_the_whole_board_and_turn_about_several_axes(planned):
    limits = safety_filter(CONFIG.deploy, INFO, "franka").limits
    bench = poses.Bench(limits, LENS, nominal_pose(), BOARD)
    hands = [kinematics.grip_pose(q) for q in planned]
    for q, T_base_grip in zip(planned, hands, strict=True):
        assert poses.is_free(bench, q)
        assert (q > limits.lower_rad).all() and (q < limits.upper_rad).all()
        T_cam_board = invert(nominal_pose()) @ T_base_grip @ BOARD.held_pose()
        pixels = project(T_cam_board, BOARD.outline_m(), LENS)
        assert (pixels > 20).all() and (pixels < (1260, 700)).all()
        assert T_cam_board[2, 2] > np.cos(poses.TILT_RAD * np.sqrt(2)), "face to face"
    assert np.degrees(rotation_spread_rad(hands)).min() > 7


def test_a_workspace_without_room_is_said():
    limits = replace(safety_filter(CONFIG.deploy, INFO, "franka").limits, workspace_upper_m=(0.3, 0.1, 0.05))
    with pytest.raises(UserError, match=r"0 of 2 poses .* deploy\.workspace"):
        poses.plan(poses.Bench(limits, LENS, nominal_pose(), BOARD), 2, HOME_RAD, np.random.default_rng(0))


def test_a_board_too_large_for_the_picture_is_said():
    limits = safety_filter(CONFIG.deploy, INFO, "franka").limits
    bench = poses.Bench(limits, LENS, nominal_pose(), CharucoBoard(square_m=0.3, marker_m=0.2))
    with pytest.raises(UserError, match="a pattern of 1500 x 2100 mm does not fit into the picture"):
        poses.plan(bench, 2, HOME_RAD, np.random.default_rng(0))


def test_the_jacobian_is_the_derivative_of_the_grip_pose():
    q = HOME_RAD + 0.1 * np.arange(7)
    J, step = kinematics.grip_jacobian(q), 1e-6
    T = kinematics.grip_pose(q)
    for joint in range(7):
        moved = kinematics.grip_pose(q + step * np.eye(7)[joint])
        turn = Rotation.from_matrix(moved[:3, :3] @ T[:3, :3].T).as_rotvec()
        expected = np.concatenate([moved[:3, 3] - T[:3, 3], turn]) / step
        np.testing.assert_allclose(J[:, joint], expected, atol=1e-5)


def test_an_arm_that_is_held_up_is_given_up_and_steps_keep_the_speed():
    arm, clock = Arm(), RobotClock()
    clock.follow(arm)
    driver = Driver(arm, safety_filter(CONFIG.deploy, INFO, "franka"), clock, 0.3)
    steps = []
    free = arm.command

    def stuck(q_target_rad, close):
        steps.append(np.abs(q_target_rad - arm.q_rad).max())
        if arm.q_rad[0] < 0.2:
            free(q_target_rad, close)

    arm.command = stuck  # type: ignore[method-assign]
    assert driver.go(HOME_RAD + [0.15, 0, 0, 0, 0, 0, 0])
    assert not driver.go(HOME_RAD + [0.5, 0, 0, 0, 0, 0, 0])
    assert max(steps) <= 0.03 + 1e-9


@pytest.mark.parametrize(
    ("shift_mm", "turn_deg", "said"),
    [
        ((3, -4, 0), (0, 0.5, 0), "within training's ±10 mm and ±0.86 degrees on each axis"),
        ((12, 0, -20), (0, 0, 0), "move it 12 mm towards the robot, 20 mm up"),
        ((0, 15, 0), (-2, 0, 1.5), "move it 15 mm to the robot's right; turn it 2.0 degrees up, 1.5 degrees "
         "anticlockwise"),
    ],
)  # fmt: skip
def test_which_way_to_move_the_camera(shift_mm, turn_deg, said):
    away = Offset(1e-3 * np.array(shift_mm, float), np.radians(np.array(turn_deg, float)))
    assert describe(away, SPREAD).endswith(said)


def test_offsets_are_what_training_displaces_by():
    away = offset(T_BASE_CAM, nominal_pose())
    np.testing.assert_allclose(away.shift_m, SHIFT_M, atol=1e-12)
    np.testing.assert_allclose(away.turn_rad, TURN_RAD, atol=1e-9)


def test_without_a_calibration_deploy_says_what_it_assumes(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    place = standing.standing(CONFIG, SessionOptions("franka", "realsense"))
    assert place.line == (
        "not calibrated: assumes the camera at (0.94, 0.00, 0.56) m in the robot's base frame, looking at "
        "(0.48, 0.00, 0.05), within ±10 mm and ±0.86 degrees on each axis; `ddgrasp calibrate` measures it"
    )
    assert standing.standing(CONFIG, SessionOptions("mine", "realsense")) == place  # by another driver
    assert place.as_dict() is None and standing.standing(CONFIG, SessionOptions()).line == ""


def test_a_policy_of_another_place_is_told_where_it_was_trained(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    trained = {"position": [0.5, 0.7, 0.9], "look_at": [0.5, 0.0, 0.0]}
    place = standing.standing(CONFIG, SessionOptions("franka", "realsense"), trained)
    assert (
        "assumes the camera at (0.50, 0.70, 0.90) m in the robot's base frame, looking at (0.50, "
        in place.line
    )
    made = standing.Calibration(
        "2026-11-23T10:00:00", "realsense", CONFIG.deploy.franka.host, look_at(*trained.values()), 0.1
    )
    standing.save(standing.DEFAULT_FILE, made)
    place = standing.standing(CONFIG, SessionOptions("franka", "realsense"), trained)
    assert place.offset is not None and place.offset.distance_m == pytest.approx(0.0) and place.trained_for


def with_serial(serial: str):
    realsense = replace(CONFIG.deploy.realsense, serial=serial)
    return replace(CONFIG, deploy=replace(CONFIG.deploy, realsense=realsense))


def test_a_calibration_is_of_the_camera_that_it_measured(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    host, options = CONFIG.deploy.franka.host, SessionOptions("franka", "realsense")
    made = standing.Calibration("2026-11-23T10:00:00", "realsense", host, nominal_pose(), 0.1, "0123")
    standing.save(standing.DEFAULT_FILE, made)
    for same in ("", "0123"):
        place = standing.standing(with_serial(same), options)
        assert place.calibration is not None and place.calibration.serial == "0123" and place.trained_for
    other = standing.standing(with_serial("4567"), options)
    assert other.calibration is None
    assert "is of camera 'realsense' with serial number 0123 and the robot at" in other.line
    with pytest.raises(UserError, match="not of 'realsense' with serial number 4567 at "):
        standing.standing(with_serial("4567"), replace(options, calibration=standing.DEFAULT_FILE))
    opened = []

    def make_devices(setup):
        opened.append(setup.config.deploy.realsense.serial)
        raise UserError("enough")

    monkeypatch.setattr(deploy_session, "make_devices", make_devices)
    policy = Path(__file__).parents[1] / "pretrained/student/policy.onnx"
    options = replace(options, yes=True, out=tmp_path / "runs")
    for serial in ("", "4567"):
        with pytest.raises(UserError, match="enough"):
            policy = Path(__file__).parents[1] / "pretrained/student/policy.onnx"
            deploy_session.deploy(
                with_serial(serial), policy, replace(options, yes=True, out=tmp_path / "runs")
            )
    assert opened == ["0123", "4567"]
    for serial in ("", "0123"):
        standing.check_own(standing.DEFAULT_FILE, "realsense", host, serial)
    with pytest.raises(UserError, match="of camera 'realsense' with serial number 0123 and .*another"):
        standing.check_own(standing.DEFAULT_FILE, "realsense", host, "4567")
    rig = replace(options, camera="rig", calibration=standing.DEFAULT_FILE, host=host)
    with pytest.raises(UserError, match="serial number 0123 and the robot at .*, not of 'rig' at"):
        standing.standing(with_serial("4567"), rig)


@pytest.mark.parametrize("up", [-1.0, 1.0])
def test_a_camera_that_looks_straight_up_or_down_has_a_pose(up):
    T_base_cam = look_at((0.5, 0.0, 0.9), (0.5, 0.0, 0.9 + up))
    np.testing.assert_allclose(T_base_cam[:3, 2], (0.0, 0.0, up))
    np.testing.assert_allclose(np.linalg.det(T_base_cam[:3, :3]), 1.0)
    tilted = look_at((0.5, 0.0, 0.9), (0.5 + 1e-6, 0.0, 0.9 + up))
    np.testing.assert_allclose(T_base_cam[:3, :3], tilted[:3, :3], atol=1e-5)


def test_a_calibration_of_another_robot_is_not_taken(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    made = standing.Calibration("2026-11-23T10:00:00", "rig", "127.0.0.9", nominal_pose(), 0.1)
    standing.save(standing.DEFAULT_FILE, made)
    with pytest.raises(UserError, match="is of camera 'rig' and the robot at '127.0.0.9': name"):
        parse("calibrate", ["--host", "127.0.0.9", "--yes"]).run()
    with pytest.raises(UserError, match="is of camera 'rig' and the robot at '127.0.0.9': name"):
        parse("calibrate", ["--host", "127.0.0.9", "--dry-run"]).run()
    standing.check_own(standing.DEFAULT_FILE, "rig", "127.0.0.9")
    place = standing.standing(CONFIG, SessionOptions("franka", "realsense"))
    assert "is of camera 'rig' and the robot at 127.0.0.9): assumes the camera at" in place.line
    named = SessionOptions("franka", "realsense", calibration=standing.DEFAULT_FILE)
    with pytest.raises(UserError, match=r"not of 'realsense' at 172\.16\.0\.2: `ddgrasp calibrate`"):
        standing.standing(CONFIG, named)


def written(**changes) -> str:
    """A calibration file with something else in it."""
    T = nominal_pose().tolist()
    right = {"version": 1, "created": "", "camera": "rig", "host": "", "T_base_cam": T, "rms_px": 0.1}
    return json.dumps(right | changes)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (None, "does not exist"),
        ("{", "is not valid JSON"),
        ("{}", r"is no calibration \('version'\)"),
        ('{"version": 9}', "has version 9, 1 is read"),
        ('{"version": 1, "T_base_cam": [[1, 2]], "rms_px": 1}', "no rigid transform"),
        (
            f'{{"version": 1, "T_base_cam": [[1{"0" * 400}]], "rms_px": 1}}',
            r"is no calibration \(.*too large",
        ),
        (written(rms_px=10**400), r"is no calibration \(.*too large"),
        ("[" * 100_000, "is not valid JSON"),
        (f'{{"version": {"1" * 5000}}}', "is not valid JSON"),
    ],
)
def test_files_that_are_no_calibration(tmp_path, text, said):
    path = tmp_path / "mine.json"
    if text is not None:
        path.write_text(text)
    with pytest.raises(UserError, match=said) as refused:
        standing.load(path)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("wrong", ["by columns", "mirrored", "no number"])
def test_poses_that_no_camera_can_have_are_no_calibration(tmp_path, wrong):
    """Written by hand of what another program measured: by columns, as Franka's own poses are."""
    T, path = nominal_pose(), tmp_path / "mine.json"
    if wrong == "by columns":
        T = T.T
    elif wrong == "mirrored":
        T[:3, 0] *= -1.0
    else:
        T[0, 3] = np.nan
    made = {"version": 1, "created": "2026-11-23", "camera": "realsense", "host": "172.16.0.2", "rms_px": 0.1}
    path.write_text(json.dumps(made | {"T_base_cam": T.tolist()}))
    with pytest.raises(UserError, match="is no calibration .T_base_cam is no rigid transform"):
        standing.load(path)


def test_a_folder_is_no_calibration_and_the_file_in_it_is_named(tmp_path):
    with pytest.raises(UserError, match=rf"is a folder: name the file, {tmp_path}/calibration\.json\.$"):
        standing.load(tmp_path)


def test_the_live_rig_s_hand_holds_the_board_where_the_truth_says(open_gl, planned):
    pytest.importorskip("franky_sim", reason="needs pip install -e '.[fr3]'")
    from rig.fr3.process import Fr3Rig
    from rig.fr3.scene import primitive

    with Fr3Rig("127.0.0.31", primitive("cube"), 3, q_rad=planned[1].tolist(), with_board=True) as rig:
        imager = Fr3Imager(rig.host, T_BASE_CAM)
        imager.start()
        gray, q_rad = imager.picture(), np.array(rig.channel.ask("state")["q_rad"])
        imager.stop()
    found = BOARD.find(gray)
    T_cam_board = invert(T_BASE_CAM) @ kinematics.grip_pose(q_rad) @ T_GRIP_BOARD
    away_px = found.pixels - project(T_cam_board, BOARD.corners_m(), LENS)[found.ids]
    assert gray.shape == (720, 1280) and len(found.ids) == 24
    assert np.abs(away_px.mean(axis=0)).max() < 0.1 and np.abs(away_px).max() < 0.3


def test_the_realsense_s_intrinsics_are_opencv_s():
    told = SimpleNamespace(fx=630.0, fy=631.0, ppx=641.5, ppy=358.2, width=1280, height=720, coeffs=[0.0] * 5)
    lens = lens_of(told)
    np.testing.assert_array_equal(lens.matrix, [[630, 0, 641.5], [0, 631, 358.2], [0, 0, 1]])
    assert (lens.width_px, lens.height_px, lens.distortion.shape) == (1280, 720, (5,))


def test_the_board_command_writes_a_page_and_refuses_other_files(tmp_path, capsys):
    assert main(["calibrate", "board", "--out", str(tmp_path / "b.pdf"), "--board.square-mm", "25"]) == 0
    assert (tmp_path / "b.pdf").read_bytes().startswith(b"%PDF")
    assert "5 x 7 squares, 25 mm each" in capsys.readouterr().out
    assert main(["calibrate", "board", "--out", str(tmp_path / "b.docx")]) == 2
    assert main(["calibrate", "board", "--board.square-mm", "90"]) == 2
    assert "fits no page of A4, A3" in capsys.readouterr().err


def test_the_calibration_of_another_robot_s_camera_is_not_taken(tmp_path):
    path = tmp_path / "cal.json"
    standing.save(path, standing.Calibration("2026-11-23", "realsense", "10.0.0.7", nominal_pose(), 0.1))
    named = SessionOptions("franka", "realsense", calibration=path)
    with pytest.raises(UserError, match=r"the robot at 10\.0\.0\.7, not of 'realsense' at 172\.16\.0\.2"):
        standing.standing(CONFIG, named)


WIDE = SafetyLimits(
    workspace_lower_m=(-1.0,) * 3, workspace_upper_m=(1.0,) * 3, arm_lower_m=(-2.0,) * 3,
    arm_upper_m=(2.0,) * 3,
)  # fmt: skip


def roomy(**limits) -> poses.Bench:
    return poses.Bench(replace(WIDE, **limits), LENS, nominal_pose(), BOARD)


def test_no_pose_has_a_part_of_the_arm_outside_its_box():
    assert poses.is_free(roomy(), HOME_RAD)
    assert not poses.is_free(roomy(arm_lower_m=(-0.05, -2.0, -2.0)), HOME_RAD), "the shoulder's back"
    assert not poses.is_free(roomy(arm_upper_m=(2.0, 2.0, 0.6)), HOME_RAD), "the elbow's top"


def test_the_board_keeps_off_the_table_and_the_walls():
    corners = (kinematics.grip_pose(HOME_RAD) @ BOARD.held_pose() @ np.c_[BOARD.outline_m(), np.ones(4)].T)[
        :3
    ]
    low, far = corners[2].min(), corners[0].max()
    for room_m, free in ((0.01, False), (0.03, True)):
        assert poses.is_free(roomy(arm_lower_m=(-2.0, -2.0, low - room_m)), HOME_RAD) == free
    for room_m, free in ((-0.005, False), (0.005, True)):
        assert poses.is_free(roomy(arm_upper_m=(far + room_m, 2.0, 2.0)), HOME_RAD) == free


def test_the_board_keeps_off_the_arm():
    folded = HOME_RAD + np.array([0, 0, 0, 0, 0, -1.8, 0])  # the hand turned back to the forearm
    assert poses.is_free(roomy(), HOME_RAD) and not poses.is_free(roomy(), folded)


def test_a_way_is_free_only_if_all_of_it_is():
    aside = np.array([0.8, 0, 0, 0, 0, 0, 0])
    far_m = kinematics.grip_position(HOME_RAD)[0] - 0.02
    narrow = roomy(workspace_upper_m=(far_m, 1.0, 1.0))
    assert poses.is_free(narrow, HOME_RAD - aside) and poses.is_free(narrow, HOME_RAD + aside)
    assert not poses.is_free_way(narrow, HOME_RAD - aside, HOME_RAD + aside)
    assert poses.is_free_way(roomy(), HOME_RAD - aside, HOME_RAD + aside)
