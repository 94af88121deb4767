"""Camera and robot drivers as far as they go without hardware, and what a user sees who chose wrongly."""

import json
import math
import os
import signal
import socket
import struct
import sys
import threading
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from app.cli import main
from app.commands import parse
from ddgrasp import contract
from ddgrasp.config import CAMERAS, ROBOTS, FrankaConfig
from ddgrasp.errors import UserError
from ddgrasp.presets import get_preset
from deploy import kinematics, session
from deploy.clock import SimClock
from deploy.devices import franka_faults, franka_hand, franka_probe, franka_robot, registry
from deploy.devices.franka_hand import FrankaHand, HandError
from deploy.devices.franka_robot import LOST, FrankaRobot
from deploy.devices.franka_spring import FrankaSpring
from deploy.devices.options import Setup
from deploy.devices.realsense_camera import RealSenseCamera
from deploy.devices.replay_camera import ReplayCamera
from deploy.interfaces import RobotError
from deploy.loop import ControlLoop, LoopSettings
from deploy.loop_report import LoopReport
from deploy.policy import OnnxPolicy
from deploy.safety import SafetyFilter, SafetyLimits
from deploy.session import SessionOptions, deploy, for_devices
from deploy_support import (
    HOME_RAD,
    KinematicRobot,
    ScriptedCamera,
    constant_bias,
    depth_mm,
    describe,
    write_policy,
)
from recording_support import flat, write_depth

SIZE = (45, 80)


@pytest.fixture
def recording(tmp_path) -> Path:
    """Four frames, 700, 710, 720 and 730 mm everywhere."""
    frames = (flat(SIZE, 700 + 10 * index) for index in range(4))
    return write_depth(tmp_path / "recording", frames, consecutive_frames=True)


def test_replay_follows_the_clock_and_ends_on_its_last_frame(recording):
    clock = SimClock()
    camera = ReplayCamera.open(recording, clock)
    camera.start()
    seen = []
    for now_s in (0.0, 0.05, 0.1, 0.3, 0.4, 0.9):
        clock.sleep_until(now_s)
        frame = camera.read()
        seen.append((int(frame.depth[0, 0]), round(frame.timestamp_s, 6)))
    assert seen == [(700, 0.0), (700, 0.0), (710, 0.1), (730, 0.3), (730, 0.3), (730, 0.3)]


@pytest.mark.parametrize(("hz", "shown_mm"), [(30.0, 730), (20.0, 720), (10.0, 710), (2.0, 710), (None, 710)])
def test_replay_keeps_the_pace_of_a_faster_recording(recording, hz, shown_mm):
    meta = json.loads((recording / "meta.json").read_text())
    (recording / "meta.json").write_text(json.dumps(meta | {"hz": hz}))
    clock = SimClock()
    camera = ReplayCamera.open(recording, clock)
    camera.start()
    clock.sleep_until(0.1)
    assert camera.read().depth[0, 0] == shown_mm


def test_a_recording_of_another_size_is_played_as_the_policys_camera_would_have_seen_it(tmp_path):
    columns = np.tile(np.arange(1, 849, dtype=np.uint16), (480, 1))
    mine = {"fx_px": contract.D455_STREAM.fx_px}
    for name, meta in (("known", mine), ("unknown", {})):
        write_depth(tmp_path / name, [columns], **meta)
    known, unknown = (
        ReplayCamera.open(tmp_path / name, SimClock(), PROFILE).read().depth for name in ("known", "unknown")
    )
    assert known.dtype == np.uint16 and known.shape == (180, 320)
    np.testing.assert_array_equal(known[90, [0, 1, 160, 318, 319]], [0, 2, 426, 847, 0])
    assert unknown.shape == (480, 848)  # which the loop refuses


def test_loop_over_a_replay_holds_once_the_recording_ends(recording, tmp_path):
    clock = SimClock()
    info = describe(profile=contract.D455.scaled(1 / 16))
    # Joint 1 moves by 1e-4 rad per millimetre beyond 700 in the newest frame.
    gain, bias = np.zeros((3, 4, 8)), constant_bias(-0.7)
    gain[2, :, 0] = 1e-3
    policy = OnnxPolicy(write_policy(tmp_path / "p.onnx", info, depth_gain=gain, bias=bias))
    robot = KinematicRobot(clock)
    limits = SafetyLimits(acceleration_rad_s2=(1e6,) * 7)
    camera = ReplayCamera.open(recording, clock)
    loop = ControlLoop(camera, robot, policy, SafetyFilter(limits, 0.1), clock, LoopSettings(0.1))
    report = loop.run(max_steps=6)
    assert robot.q_rad[0] - HOME_RAD[0] == pytest.approx(1e-4 * (0 + 10 + 20 + 30), abs=1e-7)
    assert robot.calls == ["start"] + ["command"] * 4 + ["hold"] * 2 + ["stop"]
    assert report.events[0].reason.startswith("stale frame: the same one again")


PROFILE = contract.D455.scaled(0.25)


def stream_intrinsics(**changes: float) -> SimpleNamespace:
    """As librealsense reports the stream: pixel centres are whole numbers."""
    stream = contract.D455_STREAM
    nominal = dict(fx=stream.fx_px, fy=stream.fy_px, ppx=stream.cx_px - 0.5, ppy=stream.cy_px - 0.5)
    return SimpleNamespace(**{**nominal, **changes})


def test_realsense_takes_the_pixel_on_every_ray():
    camera = RealSenseCamera(SimClock(), PROFILE)
    columns = np.tile(np.arange(848, dtype=np.uint16), (480, 1))
    depth = camera.convert(columns)
    assert depth.dtype == np.uint16 and depth.shape == (180, 320)
    # 320 pixels look as wide as 853: 2 and 2/3 each, 2.5 columns of the widest view are missing on each side
    np.testing.assert_array_equal(depth[90, [0, 1, 160, 318, 319]], [0, 1, 425, 846, 0])
    rows = camera.convert(np.tile(np.arange(480, dtype=np.uint16)[:, None], (1, 848)))
    np.testing.assert_array_equal(rows[[0, 90, 179], 160], [1, 241, 478])
    camera._stream = camera._checked(stream_intrinsics(ppx=433.5, fy=contract.D455_STREAM.fy_px * 1.05))
    assert camera.convert(columns)[90, 160] == 435  # another principal point, the same ray
    camera._unit_m = 0.0001  # a device set to a tenth of a millimetre
    np.testing.assert_array_equal(camera.convert(np.full((480, 848), 7004, np.uint16))[20:-20, 20:-20], 700)


def test_a_d455_sees_where_the_object_is_lifted_to():
    position, aim = np.array(contract.CAMERA_POSITION_M), np.array(contract.CAMERA_LOOK_AT_M)
    forward = (aim - position) / np.linalg.norm(aim - position)
    lifted_m = forward @ (np.array(contract.LIFT_TARGET_M) - position)
    assert contract.D455_STREAM.nearest_m == pytest.approx(0.339, abs=5e-4)
    assert contract.D455_STREAM.nearest_m < lifted_m - contract.LIFT_TOLERANCE_M < contract.D455.nearest_m
    assert get_preset("demo").record.stereo.min_range_m == pytest.approx(
        contract.D455_STREAM.nearest_m, abs=1e-3
    )


def test_realsense_refuses_what_it_cannot_deliver():
    with pytest.raises(UserError, match=r"1280x720 depth, more than the stream's 848x480"):
        RealSenseCamera(SimClock(), contract.D455)
    camera = RealSenseCamera(SimClock(), PROFILE)
    with pytest.raises(UserError, match=r"camera's fx is 380.0 px, a D455's at 848x480 is 449.6 px"):
        camera._checked(stream_intrinsics(fx=380.0))
    with pytest.raises(UserError, match=r"camera's cy is 300.0 px, a D455's at 848x480 is 240.0 px"):
        camera._checked(stream_intrinsics(ppy=299.5))


@pytest.mark.parametrize(("stamp_ms", "exposed_s"), [(999_960.0, 4.96), (1_000_200.0, 5.0)])
def test_realsense_timestamps_become_ages_on_the_loops_clock(monkeypatch, stamp_ms, exposed_s):
    """No frame is of the future, where the camera's clock is ahead of the host's."""

    class DepthFrame:
        def get_frame_timestamp_domain(self):
            return "global_time"

        def get_timestamp(self):
            return stamp_ms  # of a patched time of day, 1,000,000

    class Library:
        class timestamp_domain:
            hardware_clock = "hardware_clock"

    clock = SimClock()
    clock.sleep_until(5.0)
    camera = RealSenseCamera(clock, PROFILE)
    camera._rs = Library
    monkeypatch.setattr("deploy.devices.realsense_camera.time.time", lambda: 1000.0)
    assert camera._exposed_s(DepthFrame()) == pytest.approx(exposed_s)


class SlowGripper:
    """Answers as a gripper over a slow network: a command that begins before the last `stop` is through is
    the one that it stops."""

    width = 0.08

    def __init__(self):
        self.begun, self.done, self.stops = [], [], 0
        self._stopped = threading.Event()
        self.grasp_may_end, self.stop_may_go = threading.Event(), threading.Event()

    def grasp(self, *_, **__):
        self.begun.append("grasp")
        self.grasp_may_end.wait(20)
        self.done.append("grasp")

    def open(self, _):
        self.begun.append("open")
        self._stopped.clear()
        if self._stopped.wait(0.1):
            raise RuntimeError("Command aborted")
        self.done.append("open")

    def stop(self):
        self.stops += 1
        self.stop_may_go.wait(20)
        self._stopped.set()


def until(condition) -> None:
    """Waits for it, at most 20 s."""
    end_s = time.monotonic() + 20
    while not condition():
        assert time.monotonic() < end_s
        time.sleep(0.001)


def called_off(errors) -> tuple[FrankaHand, SlowGripper]:
    """A hand that is to open while it closes, which ends by itself before the stop is through."""
    gripper = SlowGripper()
    hand = FrankaHand(gripper, errors, 70.0)
    hand.set(True)
    until(lambda: gripper.begun)
    for close in (False, True, False):
        hand.set(close)
    gripper.grasp_may_end.set()
    until(lambda: gripper.done == ["grasp"])
    return hand, gripper


def test_fingers_that_are_stuck_and_say_so_are_told_again_and_then_an_error():
    """libfranka returns false for it and raises nothing: the loop would take the hand for open."""
    for answers, opened in (([False, True], 2), ([False, False], 2), ([True], 1)):
        told = iter(answers)
        gripper = SimpleNamespace(width=0.04, open=lambda speed, told=told: next(told), stop=lambda: None)
        hand = FrankaHand(gripper, (KeyError,), 20.0)
        hand.set(False)
        if answers[-1]:
            until(lambda told=told, hand=hand: not told.__length_hint__() and not hand._busy)
            assert hand.width_m() == 0.04
        else:
            until(lambda hand=hand: hand._error is not None)
            with pytest.raises(HandError, match="told to open, twice, the hand stands at 40 mm"):
                hand.width_m()
        hand.stop()
        assert len(answers) - len(list(told)) == opened


def test_a_stop_that_comes_late_does_not_meet_the_next_command():
    hand, gripper = called_off((RuntimeError,))
    time.sleep(0.03)
    gripper.stop_may_go.set()
    until(lambda: hand.width_m() and len(gripper.done) == 2)  # the width raises what stopped the hand
    hand.stop()
    assert gripper.done == ["grasp", "open"] and gripper.stops == 1


def test_a_stop_that_never_ends_is_the_hand_s_error(monkeypatch):
    monkeypatch.setattr(franka_hand, "END_S", 0.1)
    hand, gripper = called_off((ConnectionError,))
    with pytest.raises(HandError, match=r"did not answer a stop within 0\.1 s"):
        until(lambda: not hand.width_m())
    assert gripper.begun == ["grasp"]
    hand.stop()
    gripper.stop_may_go.set()


@pytest.mark.parametrize("answers", [False, True])
def test_an_arm_without_its_hand_is_told_from_no_arm(monkeypatch, answers):
    """One that another program has takes the connection and stays silent: franky would wait for ever."""
    monkeypatch.setattr(franka_probe, "ANSWER_S", 0.3)
    robot = FrankaRobot(FrankaConfig(host="127.0.0.1"), SimClock(), None)
    robot._errors = (RuntimeError,)

    def refused(host: str):
        assert answers
        raise RuntimeError(f"libfranka gripper: Connection to {host} refused")

    robot._franky = SimpleNamespace(Gripper=refused)
    said = "refused" if answers else "timed out"
    with socket.create_server(("127.0.0.1", 0)) as server:
        monkeypatch.setattr(franka_probe, "GRIPPER_PORT", server.getsockname()[1])
        if answers:
            answer = struct.pack("<HIIHH4x", 0, 0, 18, 0, 3)
            threading.Thread(target=lambda: server.accept()[0].sendall(answer), daemon=True).start()
        with pytest.raises(UserError, match=rf"answers, its gripper does not \(.*{said}.*in Desk"):
            robot._gripper()
    with pytest.raises(UserError, match=r"its gripper does not \(.*refused"):
        robot._gripper()


def ask_once(monkeypatch, port_name: str, said: bytes, ask):
    """What `ask` makes of a server at 127.0.0.1 that says `said` to a connection and hangs up."""

    def answer(server: socket.socket) -> None:
        with server.accept()[0] as client:
            client.recv(64)
            client.sendall(said)

    with socket.create_server(("127.0.0.1", 0)) as server:
        monkeypatch.setattr(franka_probe, port_name, server.getsockname()[1])
        threading.Thread(target=answer, args=(server,), daemon=True).start()
        return ask()


@pytest.mark.parametrize(
    "said",
    [
        b"HTTP/1.1 400 Bad Request\r\n\r\n",
        b"SSH",
        bytes(20),
        struct.pack("<IIIHH4x", 1, 0, 20, 0, 10),
        struct.pack("<IIIHH4x", 0, 7, 20, 0, 10),
        struct.pack("<IIIHH4x", 0, 0, 2**31, 0, 10),
        struct.pack("<IIIHH4x", 0, 0, 20, 2, 10),
    ],
    ids=["http", "ssh", "zeros", "command", "number", "size", "status"],
)
def test_what_does_not_answer_as_a_franka_does_is_none(monkeypatch, said):
    """franky would wait for its answer for ever, and hear no Ctrl-C meanwhile."""
    expected = r"^what answers at 127\.0\.0\.1:\d+ is no Franka .*check --host"
    with pytest.raises(UserError, match=expected) as refused:
        ask_once(monkeypatch, "ROBOT_PORT", said, lambda: franka_probe.check_arm("127.0.0.1", "fr3"))
    assert "\n" not in str(refused.value)


def test_a_hand_s_port_that_something_else_has_is_no_hand(monkeypatch):
    said = b"HTTP/1.1 400 Bad Request\r\n\r\n"
    with pytest.raises(UserError, match=r"^what answers at 127\.0\.0\.1:\d+ is no Franka "):
        ask_once(monkeypatch, "GRIPPER_PORT", said, lambda: franka_probe.check_hand("127.0.0.1"))


@pytest.mark.parametrize(("status", "size"), [(0, 16), (0, 20), (1, 20)])
def test_an_fr3_s_answer_passes(monkeypatch, status, size):
    """Padded or not; that the versions do not fit franky finds out, and says so."""
    said = struct.pack("<IIIHH", 0, 0, size, status, 9) + bytes(size - 16)
    ask_once(monkeypatch, "ROBOT_PORT", said, lambda: franka_probe.check_arm("127.0.0.1", "fr3"))


def test_a_control_unit_that_hangs_up_refuses(monkeypatch):
    with pytest.raises(UserError, match="refuses connections: activate FCI"):
        ask_once(monkeypatch, "ROBOT_PORT", b"", lambda: franka_probe.check_arm("127.0.0.1", "fr3"))


def test_a_mistyped_address_is_no_franka():
    with pytest.raises(UserError, match=r"no Franka at '172\.16\.\.0\.2' \(.*check --host"):
        franka_probe.check_arm("172.16..0.2", "fr3")


def test_arm_and_hand_are_as_stiff_and_strong_as_configured(monkeypatch):
    made = []

    class NotedSpring(FrankaSpring):
        def __init__(self, franky, arm, stiffness_nm_rad):
            made.append(stiffness_nm_rad)

    monkeypatch.setattr(franka_robot, "FrankaSpring", NotedSpring)
    monkeypatch.setattr(franka_robot, "FrankaHand", lambda gripper, errors, force_n: made.append(force_n))
    monkeypatch.setattr(franka_robot, "check_arm", lambda host, model: None)
    library = SimpleNamespace(
        Robot=lambda *host, **settings: None, RealtimeConfig=SimpleNamespace(Enforce=1, Ignore=2),
        Exception=KeyError, NetworkException=KeyError,
    )  # fmt: skip
    monkeypatch.setattr(franka_robot, "load_franky", lambda: library)
    config = FrankaConfig(host="127.0.0.9", stiffness_nm_rad=123.0, grip_force_n=21.0)
    robot = FrankaRobot(config, SimClock(), None)
    monkeypatch.setattr(robot, "_prepare", lambda: None)
    monkeypatch.setattr(robot, "_gripper", lambda: None)
    robot.start()
    robot._spring()
    assert made == [21.0, 123.0]


class Homing:
    """A hand that homes, or does not; a future of franky's too."""

    def __init__(self, homed: bool | None):
        self._homed, self.stopped, self.opened = homed, False, False

    def homing_async(self) -> "Homing":
        return self

    def open_async(self, speed_m_s: float) -> "Homing":
        self.opened = True
        return self

    def wait(self, timeout: float) -> bool:
        return self._homed is not None

    def get(self) -> bool | None:
        return self._homed

    def stop(self) -> None:
        self.stopped = True


def test_a_hand_that_does_not_home_ends_the_start(monkeypatch):
    monkeypatch.setattr(franka_robot, "HOMING_S", 0.05)
    robot = FrankaRobot(FrankaConfig(host="127.0.0.9"), SimClock(), None)
    homed = Homing(True)
    robot._home(homed)
    assert homed.opened
    with pytest.raises(HandError, match="homing failed: take away what is between its fingers"):
        robot._home(Homing(False))
    never = Homing(None)
    with pytest.raises(HandError, match="homing did not end in 0.05 s"):
        robot._home(never)
    assert never.stopped


def test_a_width_that_cannot_be_had_is_the_hand_s_error():
    class Mute:
        @property
        def width(self) -> float:
            raise ConnectionError("no answer")

    with pytest.raises(HandError, match="no answer") as error:
        FrankaHand(Mute(), (ConnectionError,), 70.0)
    assert isinstance(error.value.__cause__, ConnectionError)


class ScriptedSpring(FrankaSpring):
    """Notes that it is told to brake."""

    def __init__(self):
        self.told: list[str] = []

    def felt(self):
        return "", None

    def stay(self):
        self.told.append("stay")

    def stop(self):
        self.told.append("stop")

    def release(self):
        self.told.append("release")


@pytest.mark.parametrize(
    ("error", "said"),
    [
        ("CommandException", "the gripper failed: gripper: Command failed!"),
        ("NetworkException", f"{LOST} 127.0.0.9 is lost (the gripper's: gripper: Command failed!)"),
    ],
)
def test_a_hand_that_fails_leaves_an_arm_that_is_told_to_brake(error, said):
    franky = pytest.importorskip("franky", reason="needs pip install -e '.[franka]'")
    recoveries = []
    robot, spring = FrankaRobot(FrankaConfig(host="127.0.0.9"), SimClock(), None), ScriptedSpring()
    robot._errors, robot._lost_by = (franky.Exception, RuntimeError), (franky.NetworkException, RuntimeError)
    robot._arm = SimpleNamespace(
        poll_motion=lambda: None,
        state=SimpleNamespace(q=HOME_RAD),
        recover_from_errors=lambda: recoveries.append(1),
    )
    robot._following, robot._moved = spring, True
    robot._hand = FrankaHand(SlowGripper(), robot._errors, 70.0)
    robot._hand._error = getattr(franky, error)("gripper: Command failed!")
    with pytest.raises(RobotError) as failed:
        robot.read_state()
    assert str(failed.value) == said and not recoveries
    robot.hold()
    robot.stop()
    assert spring.told == ["stay", "stop", "release"]


ARM = FrankaConfig(host="127.0.0.9")


def _connected(config: FrankaConfig = ARM, **arm) -> FrankaRobot:
    """A driver at whose other end is an arm that has these attributes."""
    franky = pytest.importorskip("franky", reason="needs pip install -e '.[franka]'")
    robot = FrankaRobot(config, SimClock(), None)
    robot._franky, robot._arm = franky, SimpleNamespace(**arm)
    robot._errors, robot._lost_by = (franky.Exception, RuntimeError), (franky.NetworkException, RuntimeError)
    return robot


class Limit:
    """One of franky's, as it stands for a Panda."""

    def __init__(self, *values: float):
        self.values = np.array(values)

    def get(self) -> np.ndarray:
        return self.values

    def set(self, values: np.ndarray) -> None:
        self.values = values


class Prepared:
    """An arm that is well, and notes what it is told before it moves."""

    has_errors = False

    def __init__(self):
        self.told: dict = {}
        self.joint_velocity_limit = Limit(2.175, 2.175, 2.175, 2.175, 2.61, 2.61, 9.0)
        self.joint_acceleration_limit = Limit(15.0, 7.5, 10.0, 12.5, 15.0, 20.0, 20.0)
        self.state = SimpleNamespace(
            robot_mode="Idle", current_errors=[], joint_contact=[0.0] * 7, cartesian_contact=[0.0] * 6
        )

    def recover_from_errors(self) -> bool:
        return True

    def set_collision_behavior(self, **thresholds: float) -> None:
        self.told |= thresholds

    def set_load(self, mass_kg: float, F_x_Cload: list, load_inertia: list) -> None:
        self.told |= {"load_kg": mass_kg, "centre_m": F_x_Cload, "inertia": load_inertia}


def test_an_arm_is_told_its_thresholds_its_load_and_its_own_limits_before_it_moves():
    arm = Prepared()
    config = FrankaConfig(give_way=0.6, contact_torque_nm=15.0, contact_force_n=40.0, load_kg=0.3)
    robot = _connected(config)
    robot._arm = arm
    robot._prepare()
    assert arm.told == {
        "lower_torque_threshold": 9.0, "upper_torque_threshold": 15.0,
        "lower_force_threshold": 24.0, "upper_force_threshold": 40.0,
        "load_kg": 0.3, "centre_m": [0.0, 0.0, 0.1034], "inertia": [0.0] * 9,
    }  # fmt: skip
    # Whatever of an FR3's own is lower: all of 10 rad/s2 but joint 2, and the last joint's speed.
    np.testing.assert_array_equal(arm.joint_velocity_limit.values, [2.175] * 4 + [2.61, 2.61, 5.26])
    np.testing.assert_array_equal(arm.joint_acceleration_limit.values, [10.0, 7.5, *[10.0] * 5])


def test_an_arm_that_a_person_has_stopped_is_left_alone():
    franky = pytest.importorskip("franky", reason="needs pip install -e '.[franka]'")
    robot = _connected(state=SimpleNamespace(robot_mode=franky.RobotMode.UserStopped))
    with pytest.raises(UserError, match="'127.0.0.9' is stopped by a person: release the stop"):
        robot._prepare()


def test_an_arm_that_does_not_recover_is_named_with_its_error(monkeypatch):
    franky = pytest.importorskip("franky", reason="needs pip install -e '.[franka]'")
    monkeypatch.setattr(franka_robot, "RECOVERY_S", 0.0)

    class Errors:
        def __repr__(self) -> str:
            return '["joint_reflex"]'

    robot = _connected(
        state=SimpleNamespace(robot_mode=franky.RobotMode.Reflex, current_errors=Errors()),
        recover_from_errors=lambda: False,
        has_errors=True,
    )
    with pytest.raises(UserError, match="does not recover from joint_reflex: look at it, clear the error"):
        robot._prepare()


def test_an_arm_that_is_held_up_on_its_way_to_the_start_is_given_up(monkeypatch):
    monkeypatch.setattr(franka_robot, "_POLL_S", 0.0)
    seconds = iter(np.arange(0.0, 10 * franka_robot.START_S, 1.0))

    class State:
        q = np.asarray(HOME_RAD) + 2 * franka_robot.AT_START_RAD

        @property
        def time(self):
            return SimpleNamespace(to_sec=lambda: next(seconds))

    robot = _connected(state=State(), poll_motion=lambda: None)
    with pytest.raises(UserError, match="is not at its start pose after .* s: see what holds it"):
        robot._wait_at_start(franka_robot.START_S)
    assert next(seconds) < franka_robot.START_S + 4


@pytest.mark.parametrize("led_rad", [0.0, 0.5])
def test_an_arm_that_is_led_aside_while_a_person_is_asked_moves_to_its_start(monkeypatch, led_rad):
    arm = SimpleNamespace(state=SimpleNamespace(q=np.asarray(HOME_RAD)))
    moved, asked = [], []

    def led(question: str) -> None:
        asked.append(question)
        arm.state.q = arm.state.q + led_rad

    robot = _connected()
    robot._arm, robot._confirm = arm, led
    monkeypatch.setattr(robot, "_home", lambda gripper: None)
    monkeypatch.setattr(robot, "_to", lambda q_rad, **how: q_rad)
    monkeypatch.setattr(robot, "_wait_at_start", moved.append)
    arm.move = lambda motion, asynchronous: moved.append(motion)
    robot._go_to_start(None)
    assert "(0.00 rad away)" in asked[0]
    if not led_rad:
        assert not moved
        return
    np.testing.assert_array_equal(moved[0], HOME_RAD)
    assert moved[1] > franka_robot.START_S + 0.5


@pytest.mark.parametrize(
    ("module", "start", "extra"),
    [
        (
            "pyrealsense2",
            lambda: RealSenseCamera(SimClock(), PROFILE).start(),
            "realsense",
        ),
        ("franky", lambda: FrankaRobot(FrankaConfig(host="127.0.0.1"), SimClock(), None).start(), "franka"),
    ],
)
def test_missing_driver_names_the_extra(monkeypatch, module, start, extra):
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(UserError, match=rf"pip install 'ddgrasp\[{extra}\]'") as error:
        start()
    assert "\n" not in str(error.value)


def test_drivers_that_never_started_can_be_stopped():
    RealSenseCamera(SimClock(), PROFILE).stop()
    FrankaRobot(FrankaConfig(host="127.0.0.1"), SimClock(), None).stop()
    with pytest.raises(UserError, match="franka.dynamics is 1.5"):
        FrankaConfig(dynamics=1.5)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (SessionOptions(robot="frank"), "Unknown robot 'frank'. Did you mean 'franka'"),
        (SessionOptions(camera="stero"), "Unknown camera 'stero'. Did you mean 'stereo'"),
        (SessionOptions(robot="franka", camera="stereo"), "use --camera realsense"),
        (SessionOptions(robot="franka", camera="replay", recording=Path("r")), "would move blindly"),
        (SessionOptions(camera="rig"), "camera 'rig' sees the FR3 rig, not robot 'sim'"),
        (SessionOptions(camera="replay"), "needs --recording"),
        (SessionOptions(recording=Path("r")), "--recording is r, which camera 'stereo' does not play: drop"),
        (SessionOptions("franka", "realsense", Path("r")), "--recording is r, which camera 'realsense' does"),
        (SessionOptions(host="10.0.0.7"), "--host is 10.0.0.7, and robot 'sim' has none: drop it, or choose"),
        (SessionOptions("sim", "replay", Path("r"), host="10.0.0.7"), "--host is 10.0.0.7, and robot 'sim'"),
        (SessionOptions(calibration=Path("c.json")), "--calibration is c.json, and robot 'sim' has none"),
        (SessionOptions(seconds=-1.0), "--seconds is -1: choose 0.1, a control step, to 1e"),
        (SessionOptions(seconds=1e308), "--seconds is 1e.308: choose 0.1, a control step, to 1e"),
        (SessionOptions(seconds=0.0), "--seconds is 0: choose 0.1"),
        (SessionOptions(seconds=0.04), "--seconds is 0.04: choose 0.1, a control step"),
        (SessionOptions(seconds=float("nan")), "--seconds is nan: choose 0.1"),
    ],
)
def test_wrong_combination_gets_one_line(options, message):
    with pytest.raises(UserError, match=message):
        deploy(get_preset("debug"), Path("absent.onnx"), options)


def test_a_drawing_that_cannot_be_made_is_told_before_the_loop(monkeypatch):
    there = session.find_spec
    monkeypatch.setattr(session, "find_spec", lambda name: None if name == "matplotlib" else there(name))
    with pytest.raises(UserError, match="--dry-run ends with a drawing of what was not sent: .*franka"):
        deploy(get_preset("debug"), Path("absent.onnx"), SessionOptions(dry_run=True))


def test_the_rig_s_camera_never_goes_with_the_configured_arm():
    config = get_preset("debug")
    arm = config.deploy.franka.host
    for camera, asked, host in (
        ("realsense", "", arm),
        ("realsense", "10.0.0.7", "10.0.0.7"),
        ("rig", "", "127.0.0.1"),
        ("rig-ideal", "", "127.0.0.1"),
        ("rig", "127.0.0.2", "127.0.0.2"),
    ):
        used = for_devices(config, SessionOptions("franka", camera, host=asked)).deploy
        assert used.franka.host == host and (used.clock == "robot") == camera.startswith("rig")


def test_a_file_that_is_absent_is_said_before_anything_else():
    said: list[str] = []
    with pytest.raises(UserError, match="absent.onnx"):
        deploy(get_preset("debug"), Path("absent.onnx"), SessionOptions("franka", "realsense"), said.append)
    assert said == []


def test_every_pair_is_refused_or_can_be_made(recording):
    preset = get_preset("debug")
    info = describe(profile=preset.world.profile)
    made, refused = {}, set()
    for robot in registry.ROBOTS:
        for camera in registry.CAMERAS:
            options = SessionOptions(robot, camera, recording, object_name=preset.world.objects[0])
            try:
                registry.check_devices(options)
            except UserError:
                refused.add((robot, camera))
                continue
            made[robot, camera] = registry.make_devices(Setup(preset, options, info, SimClock()))
    assert set(registry.ROBOTS) == set(ROBOTS) and set(registry.CAMERAS) == set(CAMERAS)
    assert refused == set(registry.REFUSED)
    assert refused == {("franka", "stereo"), ("franka", "replay"), ("sim", "rig"), ("sim", "rig-ideal")}
    names = {pair: tuple(type(device).__name__ for device in devices) for pair, devices in made.items()}
    assert names == {
        ("sim", "stereo"): ("SimRobot", "StereoCamera"),
        ("sim", "realsense"): ("SimRobot", "RealSenseCamera"),
        ("sim", "replay"): ("SimRobot", "ReplayCamera"),
        ("franka", "realsense"): ("FrankaRobot", "RealSenseCamera"),
        ("franka", "rig"): ("FrankaRobot", "Fr3Camera"),
        ("franka", "rig-ideal"): ("FrankaRobot", "Fr3Camera"),
    }
    robot, camera = made["sim", "stereo"]
    camera.start()
    profile = preset.world.profile
    assert camera.read().depth.shape == (profile.height_px, profile.width_px)
    assert robot.read_state().q_rad.shape == (7,)


@pytest.mark.parametrize(("camera", "why"), [("stereo", "sees the simulated rig"), ("replay", "blindly")])
def test_another_driver_s_arm_is_not_driven_by_the_past_or_the_rig_s_camera(camera, why, monkeypatch):
    monkeypatch.setitem(registry.ROBOTS, "mine", lambda setup: KinematicRobot(setup.clock))
    options = SessionOptions("mine", camera, Path("r") if camera == "replay" else None)  # type: ignore[arg-type]
    with pytest.raises(UserError, match=f"'{camera}' .*{why}.*use --camera realsense") as refused:
        registry.check_devices(options)
    assert "robot 'mine'" in str(refused.value)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ('motion aborted by reflex! ["joint_reflex"]', "joint_reflex (it met something: a joint"),
        ('not possible in the current mode ("Other")! Did you open the brakes?', "Did you open the brakes?"),
    ],
)
def test_an_arm_s_refusal_is_told_in_its_words(text, said):
    assert said in franka_faults.describe(RuntimeError(f"libfranka: Move command rejected: {text}"))


def test_sigterm_holds_and_stops_the_robot_as_ctrl_c_does(tmp_path, monkeypatch):
    devices = []

    class Terminated(ScriptedCamera):
        def read(self):
            if self._index == 2:
                threading.Timer(0.05, terminate_twice).start()
            return super().read()

    def kinematic(setup):
        devices.extend([KinematicRobot(setup.clock), Terminated(setup.clock, [depth_mm()])])
        return devices

    def terminate_twice():  # `timeout` and supervisors signal the process and its group
        for _ in range(2):
            os.kill(os.getpid(), signal.SIGTERM)

    monkeypatch.setattr("deploy.session.make_devices", kinematic)
    before, said = signal.getsignal(signal.SIGTERM), []
    path = write_policy(tmp_path / "p.onnx", describe(), bias=constant_bias(0.2))
    report = deploy(get_preset("debug"), path, SessionOptions(seconds=math.inf, out=tmp_path), said.append)
    robot, camera = devices
    assert report.interrupted and 2 < report.steps < 300
    assert robot.calls[-2:] == ["hold", "stop"] and camera.stopped
    assert said[-3].endswith("stop: interrupted; the robot holds position")
    assert said[-2] == f"report: {next(tmp_path.glob('*/report.json'))}"
    assert signal.getsignal(signal.SIGTERM) is before


def test_a_deployment_that_a_fault_ended_exits_with_1_and_one_that_kept_no_rate_says_so(monkeypatch, capsys):
    report = LoopReport(0.1, steps=10)
    monkeypatch.setattr(session, "deploy", lambda *_: report)
    command = parse("deploy", ["--policy", "policy.onnx"])
    command.run()
    assert "did not keep its rate" not in capsys.readouterr().out
    report.fault, report.timings.missed_deadlines = "lost connection", 9
    with pytest.raises(SystemExit) as stop:
        command.run()
    said = capsys.readouterr().out
    assert stop.value.code == 1
    assert "ended by: lost connection" in said and "did not keep its rate" in said


@pytest.mark.parametrize(("seconds", "steps"), [("12", 40), ("12", 0), ("inf", 0)])
def test_one_that_was_interrupted_is_not_taken_for_done(seconds, steps, monkeypatch, capsys):
    """`ddgrasp deploy --yes ... && next` is not to go on to the next trial."""
    report = LoopReport(0.1, steps=steps, interrupted=True)
    monkeypatch.setattr(session, "deploy", lambda *_: report)
    assert main(["deploy", "--policy", "policy.onnx", "--seconds", seconds]) == 130
    said = capsys.readouterr()
    assert said.err == "ddgrasp: Interrupted.\n" and f"{steps} steps, 0 missed" in said.out


def test_one_that_was_to_run_until_ctrl_c_is_done_then(monkeypatch):
    monkeypatch.setattr(session, "deploy", lambda *_: LoopReport(0.1, steps=40, interrupted=True))
    assert main(["deploy", "--policy", "policy.onnx", "--seconds", "inf"]) == 0


@pytest.mark.parametrize("robot", ["franka", "mine"])
def test_an_arm_is_not_asked_for_where_nobody_can_answer(robot, monkeypatch, tmp_path):
    monkeypatch.setattr(sys, "stdin", SimpleNamespace(isatty=lambda: False))
    monkeypatch.setitem(registry.ROBOTS, "mine", lambda setup: KinematicRobot(setup.clock))
    policy, said = write_policy(tmp_path / "policy.onnx", describe()), []
    options = SessionOptions(robot, "realsense", out=tmp_path)
    with pytest.raises(UserError, match=f"'{robot}' asks .*nobody can be asked here: give --yes"):
        deploy(get_preset("debug"), policy, options, said.append)
    assert said == []


class Follows(ScriptedSpring):
    def follow(self, q_target_rad, soft=False, heeds=True):
        self.told.append("follow")


def test_an_arm_that_is_held_again_stays_and_after_a_command_brakes_again():
    robot, spring = _connected(poll_motion=lambda: None, state=SimpleNamespace(q=HOME_RAD)), Follows()
    robot._following, robot._moved = spring, True
    robot._hand = SimpleNamespace(set=lambda close: None)  # type: ignore[assignment]
    for told in (robot.hold, robot.hold, lambda: robot.command(HOME_RAD, False), robot.hold):
        told()
    assert spring.told == ["stay", "follow", "stay"]


@pytest.mark.parametrize(("dynamics", "start", "share"), [(0.2, 0.05, 0.25), (0.02, 0.05, 1.0)])
def test_the_way_to_the_start_is_no_faster_than_the_arm_may_go(monkeypatch, dynamics, start, share):
    robot = _connected(FrankaConfig(dynamics=dynamics, start_dynamics=start))
    moved, asked = [], []
    robot._arm = SimpleNamespace(
        state=SimpleNamespace(q=np.asarray(HOME_RAD) + 0.5),
        move=lambda motion, asynchronous: moved.append(motion),
    )
    robot._confirm = asked.append
    for name, does in (
        ("_home", lambda _: None),
        ("_to", lambda q, **how: how),
        ("_wait_at_start", lambda s: None),
    ):
        monkeypatch.setattr(robot, name, does)
    robot._go_to_start(None)
    assert moved == [{"relative_dynamics_factor": pytest.approx(share)}]
    assert f"at {100 * min(dynamics, start):.2g} % of its speed" in asked[0]


@pytest.mark.parametrize(
    ("joint_2_rad", "low_m", "way"),
    [
        (0.1, -0.01, (False, True)),
        (0.01, -0.01, (False, False)),
        (-0.1, -0.01, (True, False)),
        (-0.1, 1.0, (True, False)),
    ],
)
def test_a_step_that_ends_low_may_land_and_one_that_goes_up_may_not(joint_2_rad, low_m, way):
    below_m = float(kinematics.grip_position(HOME_RAD)[2]) + low_m
    robot = _connected(FrankaConfig(approach_below_m=below_m), state=SimpleNamespace(q=HOME_RAD))
    assert robot._way(HOME_RAD + joint_2_rad * np.eye(7)[1]) == way


def test_the_hand_grasps_with_the_configured_force_whatever_the_width():
    told: list = []
    gripper = SimpleNamespace(
        width=0.08, grasp=lambda *how, **also: told.append((how, also)), stop=lambda: None
    )
    hand = FrankaHand(gripper, (KeyError,), 33.0)
    hand.set(True)
    until(lambda: told)
    hand.stop()
    (width_m, speed_m_s, force_n), also = told[0]
    assert (width_m, speed_m_s, force_n) == (0.0, contract.GRIPPER_SPEED_M_S, 33.0)
    assert also["epsilon_outer"] > contract.GRIPPER_MAX_WIDTH_M
