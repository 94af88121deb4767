"""After the arm was held, or another acted for the policy: nothing of before goes on."""

from dataclasses import replace

import numpy as np
import pytest

from ddgrasp import contract
from ddgrasp.layout import ACTION
from deploy import loop as loop_module
from deploy.clock import SimClock
from deploy.loop import ControlLoop, LoopSettings
from deploy.policy import OnnxPolicy
from deploy.retry import STILL_STEPS
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

VOID = np.zeros(SHAPE, np.uint16)
QUICK = SafetyLimits(acceleration_rad_s2=(1e6,) * 7)
DOWN = np.array([[0.0, 0.3, 0.0, -0.15, 0.0, 0.0, 0.0, -1.0]] * 4)
"""(chunk, 8): 1.9 cm down in every step."""
SLOWLY = SafetyLimits(acceleration_rad_s2=(1e6,) * 7, approach_m_s=0.08, approach_below_m=1.0)
"""Within these, `DOWN` takes three control steps."""


class Robot(KinematicRobot):
    """Remembers the steps that it was told to make, (n, 7) rad."""

    def __init__(self, clock, q_rad=HOME_RAD):
        super().__init__(clock, q_rad)
        self.steps_rad = []

    def command(self, q_target_rad, close):
        self.steps_rad.append(q_target_rad - self.q_rad)
        super().command(q_target_rad, close)


class Run:
    """A loop that has run: its robot, its report, and in which calls the policy was asked."""

    def __init__(self, tmp_path, script, limits, bias, steps, q_rad=HOME_RAD, retry=False, **info):
        clock, described = SimClock(), describe(**info)
        self.robot = Robot(clock, q_rad)
        policy = OnnxPolicy(write_policy(tmp_path / "p.onnx", described, bias=bias))
        safety = SafetyFilter(limits, described.action_scale_rad)
        camera = ScriptedCamera(clock, script)
        loop = ControlLoop(camera, self.robot, policy, safety, clock, LoopSettings(0.1, retry=retry))
        self.inferred = []
        infer = policy._infer

        def counted(state):
            self.inferred.append(loop.report.steps)
            return infer(state)

        policy._infer = counted
        self.report = loop.run(steps)


def test_the_arm_starts_from_rest(tmp_path):
    limits = SafetyLimits(acceleration_rad_s2=(1.0,) * 7)
    run = Run(tmp_path, [*[depth_mm()] * 3, VOID, depth_mm()], limits, constant_bias(0.5), 6)
    first = [step[0] for step in run.robot.steps_rad]
    np.testing.assert_allclose(first, [0.01, 0.02, 0.03, 0.01, 0.02], atol=1e-9)


@pytest.mark.parametrize(("bad", "asked"), [(depth_mm(), [0, 3]), (VOID, [0, 2, 5])])
def test_what_was_left_of_an_action_is_not_made(tmp_path, bad, asked):
    script = [depth_mm(), bad, depth_mm()]
    assert Run(tmp_path, script, SLOWLY, DOWN, 6).inferred == asked


@pytest.mark.parametrize(("bad", "asked"), [(depth_mm(), [0, 4]), (VOID, [0, 2, 6])])
def test_what_was_left_of_a_chunk_is_not_played(tmp_path, bad, asked):
    script = [depth_mm(), bad, depth_mm()]
    assert Run(tmp_path, script, QUICK, constant_bias(0.1), 8, execute_steps=4).inferred == asked


class Closing(KinematicRobot):
    """Its fingers come 10 mm nearer in every control period, whatever the arm does; the command of step 2
    takes as long as `late_s` says, or, below 0, a joint is missing in it."""

    late_s = 0.0

    def read_state(self):
        state = super().read_state()
        if self.late_s < 0 and self.calls.count("command") == 2 and "hold" not in self.calls:
            state = replace(state, q_rad=state.q_rad[:6])
        return replace(state, width_m=0.08 - 0.1 * state.timestamp_s)

    def command(self, q_target_rad, close):
        super().command(q_target_rad, close)
        if self.calls.count("command") == 3 and self.late_s > 0:
            self._clock.sleep_until(self._clock.now() + self.late_s)


@pytest.mark.parametrize(
    ("script", "late_s", "told"),
    [
        ([depth_mm()] * 6, 0.0, [0.0, -0.01, -0.01, -0.01, -0.01]),
        ([*[depth_mm()] * 2, VOID, VOID, depth_mm()], 0.0, [0.0, -0.01, -0.01]),
        ([depth_mm()] * 6, 0.25, [0.0, -0.01, -0.01, -0.01, -0.01]),
        ([depth_mm()] * 6, -1.0, [0.0, -0.01, 0.0, -0.01]),
    ],
    ids=["in time", "held", "late", "no joints"],
)
def test_the_network_is_told_how_fast_the_fingers_go_through_holds_and_late_steps(
    tmp_path, script, late_s, told
):
    """Still fingers are to it what has closed on something, and three periods' way no way that it knows."""
    clock, described = SimClock(), describe()
    robot, heard = Closing(clock), []
    robot.late_s = late_s
    policy = OnnxPolicy(write_policy(tmp_path / "p.onnx", described, bias=constant_bias(0.0)))
    policy.watch = lambda depth, state: heard.append(float(state[-1]))
    safety = SafetyFilter(QUICK, described.action_scale_rad)
    camera = ScriptedCamera(clock, script)
    report = ControlLoop(camera, robot, policy, safety, clock, LoopSettings(0.1)).run(5)
    np.testing.assert_allclose(heard, told, atol=1e-6)
    assert report.timings.missed_deadlines == (2 if late_s > 0 else 0)


@pytest.mark.parametrize(("bad", "closes_at"), [(depth_mm(), STILL_STEPS), (VOID, STILL_STEPS + 5)])
def test_a_hand_stands_still_from_the_hold_on(tmp_path, bad, closes_at):
    low_rad = HOME_RAD + np.array([0, 0.2, 0, 0, 0, 0, 0])
    script = [*[depth_mm()] * 4, bad, depth_mm()]
    run = Run(tmp_path, script, QUICK, constant_bias(0.0), closes_at + 2, low_rad, retry=True)
    assert [event.step for event in run.report.events if event.kind == "retry"] == [closes_at]


class Once:
    """Acts once instead of the policy, in control step 1: straight up and open."""

    UP = np.append(np.zeros(contract.ACTION_SIZE - 1), -1.0)
    begun, done = "", False

    def __init__(self, still_m, patience):
        self._calls = 0

    def held(self):
        raise AssertionError("nothing was held")

    def __call__(self, state, met, felt_nm, closed):
        self._calls += 1
        return self.UP if self._calls == 2 else None


@pytest.mark.parametrize(
    ("limits", "bias", "info"),
    [(QUICK, constant_bias(0.1), {"execute_steps": 4}), (SLOWLY, DOWN, {})],
    ids=["chunk", "slow action"],
)
def test_a_policy_that_another_acted_for_begins_anew(tmp_path, monkeypatch, limits, bias, info):
    monkeypatch.setattr(loop_module, "Retry", Once)
    run = Run(tmp_path, [depth_mm()], limits, bias, 4, retry=True, **info)
    assert not run.robot.steps_rad[1].any(), "the other's"
    assert run.inferred[:2] == [0, 2]
    again = run.robot.steps_rad[2]
    np.testing.assert_allclose(again, run.robot.steps_rad[0], atol=2e-4)
    assert np.abs(again[ACTION.arm]).max() > 0.005
