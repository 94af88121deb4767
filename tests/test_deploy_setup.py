"""What a user configures is what the filter and the loop keep to."""

import io
import os
from dataclasses import replace

import numpy as np
import pytest

from ddgrasp import contract
from ddgrasp.config import DeployConfig, FrankaConfig
from ddgrasp.errors import UserError
from deploy.clock import RealClock, RobotClock, SimClock
from deploy.devices.options import SessionOptions
from deploy.loop import LoopSettings
from deploy.session import ask_person, keep_time_of
from deploy.setup import check_start, loop_settings, safety_filter, space_notice, speed_notice
from deploy_support import KinematicRobot, describe

DEPLOY, FR3 = DeployConfig(), contract.ARMS["fr3"]


@pytest.mark.parametrize("robot", ["sim", "franka"])
@pytest.mark.parametrize(
    ("field", "corner"),
    [
        ("workspace_lower_m", (0.3, -0.2, 0.05)),
        ("workspace_upper_m", (0.7, 0.2, 0.5)),
        ("arm_lower_m", (-0.4, -0.6, 0.01)),
        ("arm_upper_m", (0.9, 0.5, 1.0)),
    ],
)
def test_the_filter_keeps_to_the_configured_boxes(robot, field, corner):
    config = replace(DEPLOY, **{field: corner})
    assert getattr(safety_filter(config, describe(), robot).limits, field) == corner


@pytest.mark.parametrize(("robot", "arm"), [("sim", contract.PANDA), ("franka", FR3)])
def test_the_filter_accelerates_as_the_configured_share_of_the_arm_says(robot, arm):
    limits = safety_filter(replace(DEPLOY, acceleration_scale=0.5), describe(), robot).limits
    np.testing.assert_allclose(limits.acceleration_rad_s2, 0.5 * np.array(arm.joint_acceleration_rad_s2))


def test_the_filter_goes_no_faster_than_the_driver_lets_the_arm():
    slow = replace(DEPLOY, franka=FrankaConfig(dynamics=0.1))
    limits = safety_filter(slow, describe(), "franka").limits
    assert limits.velocity_rad_s == slow.franka.speed_rad_s
    assert max(limits.velocity_rad_s) < min(safety_filter(slow, describe(), "sim").limits.velocity_rad_s)


@pytest.mark.parametrize(
    ("box", "there"),
    [("arm", {"arm_upper_m": (0.95, 0.8, 0.6)}), ("workspace", {"workspace_upper_m": (0.8, 0.45, 0.2)})],
)
def test_a_start_pose_outside_of_the_boxes_is_refused(box, there):
    check_start(safety_filter(DEPLOY, describe(), "franka"))
    with pytest.raises(UserError, match=rf"mm outside of deploy\.{box}_lower_m to {box}_upper_m: "):
        check_start(safety_filter(replace(DEPLOY, **there), describe(), "franka"))


def test_the_boxes_are_said_with_their_options():
    said = space_notice(replace(DEPLOY, arm_lower_m=(-0.3, -0.8, 0.0)))
    assert "arm and hand x -0.3 to 0.95, y -0.8 to 0.8, z 0 to 1.3 (deploy.arm_lower_m, ..._upper_m)" in said


def test_of_arm_and_policy_the_narrower_limit_counts():
    info = describe()
    own = replace(
        info,
        joint_lower_rad=(-0.3, *info.joint_lower_rad[1:]),
        joint_upper_rad=(9.0, *info.joint_upper_rad[1:]),
    )
    limits = safety_filter(DEPLOY, own, "sim").limits
    assert limits.lower_rad[0] == -0.3 and limits.upper_rad[0] == contract.PANDA.joint_upper_rad[0]


def test_a_real_arm_keeps_off_the_ends_of_its_range():
    wide = replace(describe(), joint_lower_rad=(-9.0,) * 7, joint_upper_rad=(9.0,) * 7)
    limits = safety_filter(DEPLOY, wide, "franka").limits
    np.testing.assert_allclose(np.subtract(limits.lower_rad, FR3.joint_lower_rad), 0.02)
    np.testing.assert_allclose(np.subtract(FR3.joint_upper_rad, limits.upper_rad), 0.02)


def test_another_driver_s_arm_has_the_configured_arm_s_limits():
    """`deploy/devices/mine.py`: another way to the same arm is no simulation."""
    limits = safety_filter(DEPLOY, describe(), "mine").limits
    assert limits == safety_filter(DEPLOY, describe(), "franka").limits
    assert max(limits.velocity_rad_s) < 0.6 and limits.approach_below_m > 0 and limits.braking_rad_s2


def test_the_loop_has_the_policy_s_rate_and_the_configured_patience():
    info = replace(describe(), control_hz=20)
    for stale, retry in ((2.5, True), (1.5, False)):
        config = replace(DEPLOY, stale_periods=stale, retry=retry)
        assert loop_settings(config, info) == LoopSettings(0.05, stale, retry)
    assert safety_filter(DEPLOY, info).limits.period_s == 0.05


def test_a_clock_that_follows_a_robot_needs_one_that_tells_the_time():
    class Timed(KinematicRobot):
        def time_s(self):
            return 7.5

    clock = RobotClock()
    keep_time_of(Timed(SimClock()), clock, SessionOptions())
    assert clock.now() == 7.5
    with pytest.raises(UserError, match="robot 'sim' has no clock of its own: set deploy.clock machine"):
        keep_time_of(KinematicRobot(SimClock()), clock, SessionOptions("sim"))
    keep_time_of(KinematicRobot(SimClock()), RealClock(), SessionOptions("sim"))


@pytest.mark.parametrize("model", contract.ARMS)
def test_a_real_arm_brakes_before_its_limits_as_its_maker_says(model):
    config, arm = replace(DEPLOY, franka=FrankaConfig(model=model)), contract.ARMS[model]
    limits = safety_filter(config, describe(), "franka").limits
    assert limits.braking_rad_s2 == arm.braking_rad_s2
    assert limits.braking_reserve_rad_s == arm.braking_reserve_rad_s and min(arm.braking_reserve_rad_s) > 0
    assert safety_filter(config, describe(), "sim").limits.braking_rad_s2 is None


def test_a_hand_that_is_not_moved_does_not_try_again():
    config = DeployConfig(retry=True)
    assert (
        loop_settings(config, describe()).retry and not loop_settings(config, describe(), moves=False).retry
    )


def test_speed_the_policy_may_ask_for_is_said_when_dynamics_gives_less():
    info, config = describe(), DeployConfig()
    assert "may ask for 1.00 rad/s, deploy.franka.dynamics 0.2 gives 0.43" in speed_notice(config, info)
    assert safety_filter(config, info, "franka").limits.velocity_rad_s == config.franka.speed_rad_s
    assert speed_notice(replace(config, franka=replace(config.franka, dynamics=0.5)), info) == ""


def test_nobody_to_ask_is_refused(monkeypatch):
    monkeypatch.setattr("sys.stdin", open(os.devnull))
    with pytest.raises(UserError, match="give --yes"):
        ask_person("Is its way clear?")
    terminal = io.StringIO()  # Ctrl-D
    terminal.isatty = lambda: True
    monkeypatch.setattr("sys.stdin", terminal)
    with pytest.raises(UserError, match="not confirmed: the arm stays where it is"):
        ask_person("Is its way clear?")
