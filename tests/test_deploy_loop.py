"""The control loop on a simulated and on the real clock, with frames that go wrong."""

import os
import signal
import threading
import time
from dataclasses import replace

import numpy as np
import pytest

from ddgrasp.errors import UserError
from deploy.clock import RealClock, SimClock
from deploy.dry_run import DryRun
from deploy.interfaces import CameraError, RobotError
from deploy.kinematics import grip_position
from deploy.loop import ControlLoop, LoopSettings
from deploy.loop_report import KEPT_EVENTS
from deploy.policy import OnnxPolicy
from deploy.safety import SafetyFilter, SafetyLimits
from deploy_support import (
    HOME_RAD,
    SHAPE,
    KinematicRobot,
    ScriptedCamera,
    constant_bias,
    depth_mm,
    describe,
    write_policy,
)

LIMITS = SafetyLimits(acceleration_rad_s2=(1e6,) * 7)


def make_loop(tmp_path, script, clock=None, info=None, settings=None, say=lambda text: None, **policy):
    """(loop, robot, camera) around a policy that turns joint 1 by 0.02 rad per step."""
    clock = clock or SimClock()
    info = info or describe()
    policy.setdefault("bias", constant_bias(0.2))
    robot, camera = KinematicRobot(clock), ScriptedCamera(clock, script)
    loop = ControlLoop(
        camera,
        robot,
        OnnxPolicy(write_policy(tmp_path / "p.onnx", info, **policy)),
        SafetyFilter(LIMITS, info.action_scale_rad),
        clock,
        settings or LoopSettings(period_s=0.1),
        say,
    )
    return loop, robot, camera


def test_good_frames_move_the_robot_one_step_per_period(tmp_path):
    clock = SimClock()
    loop, robot, camera = make_loop(tmp_path, [depth_mm()], clock)
    report = loop.run(max_steps=5)
    assert robot.q_rad[0] - HOME_RAD[0] == pytest.approx(5 * 0.02)
    assert robot.calls == ["start"] + ["command"] * 5 + ["stop"] and camera.stopped
    assert (report.steps, report.holds, report.timings.missed_deadlines, report.events) == (5, 0, 0, [])
    np.testing.assert_allclose(report.timings.period_s, [0.1] * 4, atol=1e-12)
    assert clock.now() == pytest.approx(0.5), "the last command had its whole period"
    assert report.clock_s == pytest.approx(0.4) and 0 < report.machine_s < 60
    assert len(report.timings.infer_s) == len(report.timings.latency_s) == 5


BAD = {
    "stale": (depth_mm(), 0.25),
    "time of day": (depth_mm(), -1.7e9),
    "repeated": "repeat",
    "unplugged": "unplugged",
    "shape": depth_mm()[1:],
    "dtype": depth_mm().astype(np.float64),
    "void": np.zeros(SHAPE, np.uint16),
}


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("stale", "stale frame: 250 ms old"),
        ("time of day", "frame of the future: 1700000000000 ms ahead, its time is not of the loop's clock"),
        ("repeated", "stale frame: the same one again"),
        ("unplugged", "no frame: unplugged"),
        ("shape", "wrong depth: size (8, 16)"),
        ("dtype", "wrong depth: type float64"),
        ("void", "all-invalid depth"),
    ],
)
def test_bad_frame_holds_says_so_and_recovers(tmp_path, name, reason):
    said = []
    script = [depth_mm(), BAD[name], BAD[name], depth_mm(), depth_mm()]
    loop, robot, _ = make_loop(tmp_path, script, say=said.append)
    report = loop.run(max_steps=5)
    assert robot.calls == ["start", "command", "hold", "hold", "command", "command", "stop"]
    assert report.holds == 2
    assert [(event.step, event.kind) for event in report.events] == [(1, "hold"), (3, "recover")]
    assert report.events[0].reason.startswith(reason)
    assert said == [str(event) for event in report.events]


def test_frame_older_than_the_one_before_holds(tmp_path):
    loop, robot, _ = make_loop(tmp_path, [depth_mm(), (depth_mm(), 0.15), depth_mm()])
    report = loop.run(max_steps=3)
    assert robot.calls == ["start", "command", "hold", "command", "stop"]
    assert report.events[0].reason == "stale frame: older than the one before (150 ms old)"


def test_non_finite_depth_in_metres_holds(tmp_path):
    good = np.full(SHAPE, 0.7, np.float32)
    bad = good.copy()
    bad[0, 0] = np.nan
    loop, robot, _ = make_loop(tmp_path, [good, bad, good], info=describe("float32_m"))
    report = loop.run(max_steps=3)
    assert robot.calls == ["start", "command", "hold", "command", "stop"]
    assert report.events[0].reason == "non-finite depth: 1 pixels"


def test_after_a_hold_the_buffer_starts_anew(tmp_path):
    # Joint 1 moves by the oldest frame's metres: 0.02 rad at 200 mm, 0.04 rad at 400 mm.
    gain = np.zeros((3, 4, 8))
    gain[0, 0, 0] = 1e-3
    script = [depth_mm(200), BAD["void"], depth_mm(400)]
    loop, robot, _ = make_loop(tmp_path, script, depth_gain=gain, bias=np.zeros((4, 8)))
    loop.run(max_steps=3)
    assert robot.q_rad[0] == pytest.approx(0.02 + 0.04)


def test_non_finite_action_holds_every_step(tmp_path):
    loop, robot, _ = make_loop(tmp_path, [depth_mm()], bias=np.full((4, 8), np.nan))
    report = loop.run(max_steps=3)
    assert robot.calls == ["start", "hold", "hold", "hold", "stop"]
    assert report.holds == 3 and report.events[0].reason.startswith("non-finite action")
    np.testing.assert_array_equal(robot.q_rad, HOME_RAD)


def test_non_finite_joints_hold(tmp_path):
    loop, robot, _ = make_loop(tmp_path, [depth_mm()])
    robot.q_rad[3] = np.nan
    report = loop.run(max_steps=1)
    assert robot.calls == ["start", "hold", "stop"] and "joint state" in report.events[0].reason


@pytest.mark.parametrize("bad", ["shape", "dtype"])
def test_camera_that_never_fits_is_refused_before_anything_moves(tmp_path, bad):
    loop, robot, camera = make_loop(tmp_path, [BAD[bad]])
    with pytest.raises(UserError, match="wrong depth.*take a policy for it"):
        loop.run(max_steps=3)
    assert robot.calls == ["start", "stop"] and camera.stopped


def test_wrong_unit_is_refused_before_anything_moves(tmp_path):
    loop, robot, _ = make_loop(tmp_path, [depth_mm(1)])
    with pytest.raises(UserError, match="median 1 cannot be mm"):
        loop.run(max_steps=3)
    assert "command" not in robot.calls


def test_the_unit_is_looked_at_in_the_first_frame_that_shows_something(tmp_path):
    loop, robot, _ = make_loop(tmp_path, ["unplugged", BAD["void"], depth_mm(1)])
    with pytest.raises(UserError, match="median 1 cannot be mm"):
        loop.run(max_steps=4)
    assert "command" not in robot.calls


def test_a_dry_run_says_where_the_grip_is_not_where_the_filter_lets_it_go():
    """A hand that stands 4 mm lower than its floor: the table is higher than it is said to be."""
    said: list[str] = []
    robot = KinematicRobot(SimClock(), np.array([0.0, 0.9, 0.0, -1.9, 0.0, 2.8, 0.785]))
    dry = DryRun(robot, said.append)
    dry.read_state()
    dry.command(HOME_RAD, close=False)
    here, there = (" ".join(f"{x:.3f}" for x in grip_position(q)) for q in (robot.q_rad, HOME_RAD))
    assert said[0].startswith(f"grip at {here} m, would send ") and said[0].endswith(f"to {there} m, open")


def test_slow_steps_skip_deadlines_and_never_burst(tmp_path):
    clock = SimClock()
    loop, robot, _ = make_loop(tmp_path, [depth_mm()], clock)
    robot.read_takes_s = 0.25
    starts = []
    report = loop.run(max_steps=4, on_step=lambda step: starts.append(clock.now() - 0.25))
    # A step of 0.25 s started at 0 misses 0.1 and 0.2; the next one starts at 0.3, on the grid.
    np.testing.assert_allclose(starts, [0.0, 0.3, 0.6, 0.9], atol=1e-9)
    assert report.timings.missed_deadlines == 4 * 2
    jitter = report.timings.summary(0.1)["jitter_ms"]
    assert jitter["max"] == pytest.approx(200.0) and jitter["p50"] == pytest.approx(200.0)


@pytest.mark.parametrize(("by_time", "steps"), [(True, 2), (False, 5)])
def test_an_arm_moves_no_longer_for_slow_steps(tmp_path, by_time, steps):
    """Of half a second at 10 Hz steps of 0.25 s take three periods each."""
    settings = LoopSettings(0.1, by_time=by_time)
    loop, robot, _ = make_loop(tmp_path, [depth_mm()], SimClock(), settings=settings)
    robot.read_takes_s = 0.25
    assert loop.run(max_steps=5).steps == steps


def test_one_slow_step_leaves_the_grid_unchanged(tmp_path):
    clock = SimClock()
    loop, robot, _ = make_loop(tmp_path, [depth_mm()], clock)
    starts = []

    def on_step(step):
        starts.append(round(clock.now() - robot.read_takes_s, 6))
        robot.read_takes_s = 0.13 if step.index == 1 else 0.0

    report = loop.run(max_steps=6, on_step=on_step)
    # Step 2 starts at 0.2 and lasts 0.13 s: 0.3 is missed, 0.4 kept, no step is made up for.
    assert starts == [0.0, 0.1, 0.2, 0.4, 0.5, 0.6]
    assert report.timings.missed_deadlines == 1
    assert [event.kind for event in report.events] == ["missed"]


def test_real_clock_keeps_absolute_deadlines(tmp_path):
    clock = RealClock()
    loop, _, _ = make_loop(tmp_path, [depth_mm()], clock, settings=LoopSettings(period_s=0.02))
    starts = []

    def on_step(step):
        starts.append(clock.now())
        time.sleep(0.008)  # work that a drifting loop would add to every period

    report = loop.run(max_steps=30, on_step=on_step)
    elapsed, missed = starts[-1] - starts[0], report.timings.missed_deadlines
    # 29 periods, and at most one more for each that was missed: 8 ms a step would have added 0.23 s.
    assert 29 * 0.02 - 0.05 < elapsed < (29 + missed) * 0.02 + 0.05
    if not missed:  # a busy machine misses some, and says so
        assert np.median(report.timings.period_s) == pytest.approx(0.02, abs=0.004)


def test_chunk_playback_runs_the_network_only_when_due(tmp_path):
    loop, robot, _ = make_loop(tmp_path, [depth_mm()], info=describe(execute_steps=4))
    report = loop.run(max_steps=8)
    assert len(report.timings.infer_s) == len(report.timings.latency_s) == 2
    assert len(report.timings.act_s) == 8 and robot.calls.count("command") == 8


def test_ctrl_c_holds_and_stops_the_robot(tmp_path, ctrl_c):
    clock = RealClock()
    loop, robot, camera = make_loop(tmp_path, [depth_mm()], clock, settings=LoopSettings(period_s=0.02))

    def on_step(step):
        if step.index == 3:  # while the loop waits for the next
            threading.Timer(0.005, os.kill, (os.getpid(), signal.SIGINT)).start()

    report = loop.run(max_steps=500, on_step=on_step)
    assert report.interrupted and 3 < report.steps < 500
    assert robot.calls[-2:] == ["hold", "stop"] and camera.stopped
    assert report.events[-1].kind == "stop"


def test_robot_is_stopped_when_a_device_fails(tmp_path):
    loop, robot, camera = make_loop(tmp_path, [depth_mm()])

    def broken():
        raise OSError("joint controller lost")

    robot.read_state = broken
    with pytest.raises(OSError, match="joint controller lost"):
        loop.run(max_steps=3)
    assert robot.calls[-1] == "stop" and camera.stopped


def test_what_the_arm_gave_way_to_is_an_event_once_for_as_long_as_it_does(tmp_path):
    loop, robot, _ = make_loop(tmp_path, [depth_mm()], SimClock())
    read, met = robot.read_state, iter(["", "16 N", "17 N", "", "18 N", ""])
    robot.read_state = lambda: replace(read(), met=next(met))
    report = loop.run(max_steps=6)
    assert [(event.step, event.kind) for event in report.events] == [(1, "touch"), (4, "touch")]
    assert report.events[0].reason == "the arm met something and gave way (16 N)"
    assert report.holds == 0 and robot.calls.count("command") == 6


def test_an_arm_that_does_not_know_what_it_feels_is_held(tmp_path):
    loop, robot, _ = make_loop(tmp_path, [depth_mm()], SimClock())
    read, felt = robot.read_state, iter([np.zeros(7), np.full(7, np.nan), None])
    robot.read_state = lambda: replace(read(), felt_nm=next(felt))
    report = loop.run(max_steps=3)
    assert report.holds == 1 and report.events[0].reason.startswith("bad external torques: [nan")


def test_an_arm_that_does_not_know_how_far_its_hand_is_open_is_held_and_the_opening_named(tmp_path):
    loop, robot, _ = make_loop(tmp_path, [depth_mm()], SimClock())
    read, widths = robot.read_state, iter([0.08, float("nan"), 0.08])
    robot.read_state = lambda: replace(read(), q_rad=np.zeros(7), width_m=next(widths))
    report = loop.run(max_steps=3)
    assert report.holds == 1
    assert report.events[0].reason == "bad joint state: [0. 0. 0. 0. 0. 0. 0.] rad, gripper nan m"


def test_after_a_contact_the_rest_of_the_chunk_is_not_played(tmp_path):
    loop, robot, _ = make_loop(tmp_path, [depth_mm()], SimClock(), info=describe(execute_steps=4))
    read, met = robot.read_state, iter(["", "", "", "16 N", *[""] * 4])
    robot.read_state = lambda: replace(read(), met=next(met))
    assert len(loop.run(max_steps=8).timings.infer_s) == 3, "in steps 0, 3 and 7"


def test_on_step_can_end_the_run(tmp_path):
    loop, robot, _ = make_loop(tmp_path, [depth_mm()])
    assert loop.run(on_step=lambda step: step.index == 2).steps == 3


def test_report_is_plain_json(tmp_path):
    import json

    loop, _, _ = make_loop(tmp_path, [depth_mm(), BAD["void"]])
    values = json.loads(json.dumps(loop.run(max_steps=3).as_dict()))
    assert values["steps"] == 3 and values["holds"] == 2
    assert set(values["latency_ms"]) == {"p50", "p99"} and values["latency_ms"]["p50"] > 0
    assert values["safety"]["commands"] == 1


@pytest.mark.parametrize(
    ("fails_at", "script", "calls"),
    [
        ("read_state", [depth_mm()], ["start", "command", "stop"]),
        ("command", [depth_mm()], ["start", "command", "stop"]),
        ("hold", [depth_mm(), "unplugged"], ["start", "command", "stop"]),
        ("stop", [depth_mm()], ["start", *["command"] * 5]),
    ],
)
def test_a_robot_that_fails_ends_the_run_with_its_words_and_nothing_more_is_told_to_it(
    tmp_path, monkeypatch, fails_at, script, calls
):
    loop, robot, camera = make_loop(tmp_path, script)
    sound, count = getattr(robot, fails_at), []

    def failing(*args):
        count.append(fails_at)
        if fails_at in ("read_state", "command") and len(count) == 1:
            return sound(*args)
        raise RobotError(f"{fails_at}: the arm stopped itself")

    monkeypatch.setattr(robot, fails_at, failing)
    report = loop.run(max_steps=5)
    assert report.fault == f"{fails_at}: the arm stopped itself"
    assert robot.calls == calls and camera.stopped
    assert report.events[-1].kind == "fault" and not report.interrupted


def test_a_camera_that_does_not_start_ends_the_run_with_its_words(tmp_path, monkeypatch):
    loop, robot, camera = make_loop(tmp_path, [depth_mm()])

    def failing():
        raise CameraError("no device is connected")

    monkeypatch.setattr(camera, "start", failing)
    report = loop.run(max_steps=5)
    assert report.fault == "no device is connected" and report.steps == 0
    assert robot.calls == ["stop"] and camera.stopped


def test_of_two_failures_the_first_is_the_fault(tmp_path, monkeypatch):
    loop, robot, camera = make_loop(tmp_path, [depth_mm()])

    def fail(name):
        def failing(*args):
            raise RobotError(name)

        monkeypatch.setattr(robot, name, failing)

    fail("command")
    fail("stop")
    report = loop.run(max_steps=5)
    assert report.fault == "command" and camera.stopped
    assert [event.reason for event in report.events] == ["command", "stop"]


def test_an_arm_that_does_not_hold_after_ctrl_c_is_said_and_stopped(tmp_path, monkeypatch):
    loop, robot, camera = make_loop(tmp_path, [depth_mm()])

    def held():
        raise RobotError("no answer")

    def interrupt(step):
        raise KeyboardInterrupt

    monkeypatch.setattr(robot, "hold", held)
    report = loop.run(max_steps=5, on_step=interrupt)
    assert report.interrupted and report.fault == "no answer"
    assert [event.reason for event in report.events[-2:]] == ["no answer", "interrupted; holding failed"]
    assert robot.calls == ["start", "command", "stop"] and camera.stopped


def test_events_beyond_those_kept_are_counted(tmp_path):
    script = [depth_mm(), "unplugged"] * (KEPT_EVENTS + 5)
    loop, *_ = make_loop(tmp_path, script)
    report = loop.run(max_steps=len(script))
    assert len(report.events) == KEPT_EVENTS and report.events_dropped > 5


def test_a_frame_without_a_time_holds(tmp_path):
    loop, robot, _ = make_loop(tmp_path, [depth_mm(), (depth_mm(), np.nan), depth_mm()])
    assert loop.run(max_steps=3).events[0].reason == "stale frame: nan ms old"
    assert robot.calls == ["start", "command", "hold", "command", "stop"]
