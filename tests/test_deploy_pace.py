"""A slow arm makes the policy's actions in several steps, and the policy waits."""

from dataclasses import replace

import numpy as np
import pytest

from ddgrasp import contract
from deploy import kinematics
from deploy.clock import SimClock
from deploy.loop import ControlLoop, LoopSettings
from deploy.pace import LONGEST_STEPS, Pace
from deploy.policy import OnnxPolicy
from deploy.safety import SafetyFilter, SafetyLimits
from deploy_support import HOME_RAD, KinematicRobot, ScriptedCamera, depth_mm, describe, write_policy

SCALE_RAD = 0.1
DOWN = np.array([[0.0, 0.3, 0.0, -0.15, 0.0, 0.0, 0.0, 1.0]] * 4, np.float32)
"""(chunk, 8) every action of the policy: 1.9 cm down, and close."""


class Robot(KinematicRobot):
    """Remembers where its hand was and whether its fingers were told to close."""

    def __init__(self, clock):
        super().__init__(clock)
        self.heights_m, self.closes = [], []

    def read_state(self):
        return replace(super().read_state(), width_m=0.08 - 0.01 * len(self.closes))

    def command(self, q_target_rad, close):
        super().command(q_target_rad, close)
        self.heights_m.append(kinematics.grip_position(q_target_rad)[2])
        self.closes.append(close)


def run(tmp_path, steps: int, approach_m_s: float, met_at: int | None = None):
    """(robot, what the policy was told of its state whenever it was asked) after so many control steps."""
    clock, info = SimClock(), describe()
    robot = Robot(clock)
    policy = OnnxPolicy(write_policy(tmp_path / "p.onnx", info, bias=DOWN))
    asked = []
    policy.watch = lambda depth, state: asked.append(state)
    limits = SafetyLimits(
        acceleration_rad_s2=(1e6,) * 7, approach_m_s=approach_m_s, approach_below_m=1.0,
    )  # fmt: skip
    if met_at is not None:
        read = robot.read_state
        robot.read_state = lambda: replace(read(), met="16 N" if len(robot.closes) == met_at else "")
    safety = SafetyFilter(limits, info.action_scale_rad)
    camera = ScriptedCamera(clock, [depth_mm()])
    ControlLoop(camera, robot, policy, safety, clock, LoopSettings(0.1)).run(steps)
    return robot, np.array(asked)


def test_a_slow_hand_makes_every_action_whole_and_the_policy_waits_for_it(tmp_path):
    fast, asked = run(tmp_path, 2, np.inf)
    assert len(asked) == 2 and fast.closes == [True, True]
    slow, asked = run(tmp_path, 6, 0.08)
    np.testing.assert_allclose(
        asked[:, -1], [0.0, -0.01], atol=1e-6, err_msg="the last step's change of width"
    )
    np.testing.assert_allclose(slow.heights_m[2::3], fast.heights_m, atol=1e-4)
    np.testing.assert_allclose(slow.q_rad, fast.q_rad, atol=1e-6)
    assert np.diff(slow.heights_m).min() > -0.0085
    assert slow.closes == [False, False, True, True, True, True], "when the hand is where it was to close"


def test_a_hand_that_met_something_asks_the_policy_at_once_and_closes_when_it_says_so(tmp_path):
    assert len(run(tmp_path, 6, 0.08)[1]) == 2
    robot, asked = run(tmp_path, 3, 0.08, met_at=1)
    assert len(asked) == 3 and robot.closes[:2] == [False, True]


def test_an_arm_that_comes_no_nearer_has_made_what_it_can():
    pace, q_rad, action = Pace(SCALE_RAD), np.array(HOME_RAD), np.append(np.full(7, 0.5), -1.0)
    assert pace.rest(q_rad) is None and not pace.made(q_rad, action, cut=True)
    nearer, rest = q_rad + 0.02, np.append(np.full(7, 0.3), -1.0)
    np.testing.assert_allclose(pace.rest(nearer), rest)
    assert not pace.made(nearer, rest, cut=True)
    np.testing.assert_allclose(pace.rest(nearer), rest)
    assert pace.made(nearer, rest, cut=True) and pace.rest(nearer) is None


@pytest.mark.parametrize("beyond", [1.0, 3.0])
def test_what_is_left_is_of_what_a_policy_may_ask_for(beyond):
    pace, q_rad = Pace(SCALE_RAD), np.zeros(7)
    action = np.full(contract.ACTION_SIZE, beyond)
    pace.made(q_rad, action, cut=True)
    np.testing.assert_allclose(pace.rest(q_rad + 0.04)[:7], 0.6)
    assert pace.made(q_rad + 0.04, action, cut=False) and pace.rest(q_rad) is None


def test_an_action_has_so_many_steps_and_no_more():
    pace, action, made = Pace(SCALE_RAD), np.full(contract.ACTION_SIZE, 1.0), []
    for step in range(LONGEST_STEPS):
        q_rad = np.array(HOME_RAD) + 0.002 * step
        pace.rest(q_rad)
        made.append(pace.made(q_rad, action, cut=True))
    assert made == [False] * (LONGEST_STEPS - 1) + [True]
