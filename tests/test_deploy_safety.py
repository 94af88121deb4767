"""Every limit of the safety filter, and that each change is counted."""

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ddgrasp import contract, policy_metadata
from ddgrasp.contract import HOME_RAD
from ddgrasp.presets import get_preset
from deploy import kinematics
from deploy.calibration.poses import reach
from deploy.safety import NonFiniteAction, SafetyFilter, SafetyLimits
from deploy.setup import safety_filter

HOME = np.array(HOME_RAD)
FREE = SafetyLimits(
    acceleration_rad_s2=(1e6,) * 7,
    workspace_lower_m=(-9.0, -9.0, -9.0),
    workspace_upper_m=(9.0, 9.0, 9.0),
    arm_lower_m=(-9.0, -9.0, -9.0),
    arm_upper_m=(9.0, 9.0, 9.0),
)
"""Position and velocity limits of the robot, nothing else."""


def action(*joints: float, gripper: float = 0.0) -> np.ndarray:
    return np.array([*joints, *[0.0] * (7 - len(joints)), gripper], np.float32)


def test_harmless_action_passes_unchanged():
    filter_ = SafetyFilter(FREE, action_scale_rad=0.1)
    target, close, causes = filter_.target(HOME, action(0.5, -0.25, gripper=0.1))
    np.testing.assert_allclose(target - HOME, [0.05, -0.025, 0, 0, 0, 0, 0], atol=1e-9)
    assert close and causes == []
    assert filter_.counts.as_dict() == {
        "commands": 1, "action": 0, "joint_position": 0, "joint_velocity": 0, "joint_acceleration": 0,
        "approach": 0, "workspace": 0, "arm": 0,
    }  # fmt: skip


@pytest.mark.parametrize(("gripper", "close"), [(-1.0, False), (0.0, False), (1e-3, True)])
def test_gripper_closes_above_zero(gripper, close):
    assert SafetyFilter(FREE, 0.1).target(HOME, action(gripper=gripper))[1] is close


def test_action_beyond_one_is_clipped():
    target, _, causes = SafetyFilter(FREE, 0.1).target(HOME, action(3.0))
    assert target[0] - HOME[0] == pytest.approx(0.1)
    assert causes == ["action"]


def test_velocity_limit_per_period():
    # 0.5 rad in 0.1 s is 5 rad/s; joint 1 may do 2.175, joint 5 2.61, and the hand keeps its direction.
    target, _, causes = SafetyFilter(FREE, 0.5).target(HOME, action(1.0, 0, 0, 0, -1.0))
    assert target[0] - HOME[0] == pytest.approx(0.2175)
    assert target[4] - HOME[4] == pytest.approx(-0.2175)
    assert causes == ["joint_velocity"]


def test_acceleration_limit_from_rest_and_on_reversal():
    limits = SafetyLimits(
        acceleration_rad_s2=(5.0,) * 7,
        workspace_lower_m=FREE.workspace_lower_m,
        workspace_upper_m=FREE.workspace_upper_m,
    )
    filter_ = SafetyFilter(limits, 0.1)
    # 5 rad/s^2 over 0.1 s twice: the step may change by 0.05 rad.
    steps = [filter_.target(HOME, action(a))[0][0] - HOME[0] for a in (1.0, 1.0, -1.0, -1.0)]
    np.testing.assert_allclose(steps, [0.05, 0.1, 0.05, 0.0], atol=1e-12)
    filter_.stopped()
    assert filter_.target(HOME, action(-1.0))[0][0] - HOME[0] == pytest.approx(-0.05)
    assert filter_.counts.by_cause["joint_acceleration"] == 4


def _moved_m(q_rad: np.ndarray, target_rad: np.ndarray) -> np.ndarray:
    return kinematics.grip_position(target_rad) - kinematics.grip_position(q_rad)


def test_a_low_hand_comes_down_slowly_and_goes_up_as_it_likes():
    height_m = kinematics.grip_position(HOME)[2]
    down = action(0.0, 0.8, 0.0, -0.4)
    low = replace(FREE, approach_m_s=0.06, approach_below_m=height_m + 0.01)
    filter_ = SafetyFilter(low, 0.1)
    target, _, causes = filter_.target(HOME, down)
    assert _moved_m(HOME, target)[2] == pytest.approx(-0.006, rel=0.05)  # 6 cm/s for 0.1 s; the way is bent
    assert causes == ["approach"] and filter_.counts.as_dict()["approach"] == 1
    step = target - HOME
    np.testing.assert_allclose(step / step[1], [0, 1, 0, -0.5, 0, 0, 0], atol=1e-6)  # all joints alike
    for free, given in ((filter_, -down), (SafetyFilter(FREE, 0.1), down)):
        target, _, causes = free.target(HOME, given)
        assert causes == [] and abs(_moved_m(HOME, target)[2]) > 0.03


def test_a_hand_that_would_end_low_is_slowed_before_it_is():
    height_m = kinematics.grip_position(HOME)[2]
    down = action(0.0, 0.8, 0.0, -0.4)
    for below_m, expected in ((height_m - 0.02, ["approach"]), (height_m - 0.2, [])):
        limits = replace(FREE, approach_m_s=0.06, approach_below_m=below_m)
        assert SafetyFilter(limits, 0.1).target(HOME, down)[2] == expected


def test_a_real_arm_comes_down_slowly_and_the_development_rig_s_as_before():
    config = get_preset("debug")
    info = policy_metadata.describe(config.student, config.export, config.world.profile)
    franka, simulated = (safety_filter(config.deploy, info, robot).limits for robot in ("franka", "sim"))
    assert (franka.approach_m_s, franka.approach_below_m) == (0.06, 0.16)
    low, down = HOME.copy(), action(0.0, 1.0)
    while kinematics.grip_position(low)[2] > 0.018:
        low[1] += 0.01
    assert "approach" in SafetyFilter(franka, 0.1).target(low, down)[2]
    for limits in (simulated, replace(franka, approach_below_m=0.0)):  # below the table the workspace ends
        causes = SafetyFilter(limits, 0.1).target(low, down)[2]
        assert "workspace" in causes and "approach" not in causes


def test_position_limit_and_way_back_from_outside():
    q = HOME.copy()
    q[0] = contract.JOINT_UPPER_RAD[0] - 0.03
    target, _, causes = SafetyFilter(FREE, 0.1).target(q, action(1.0))
    assert target[0] == pytest.approx(contract.JOINT_UPPER_RAD[0])
    assert causes == ["joint_position"]
    q[0] = contract.JOINT_UPPER_RAD[0] + 1.0
    target, _, _ = SafetyFilter(FREE, 0.1).target(q, action(1.0))
    assert target[0] - q[0] == pytest.approx(-0.2175), "comes back, but not faster than the joint may move"


def test_hand_slides_along_the_floor_of_the_workspace():
    z0 = kinematics.grip_position(HOME)[2]
    limits = SafetyLimits(acceleration_rad_s2=(1e6,) * 7, workspace_lower_m=(0.15, -0.45, z0 - 0.005))
    filter_ = SafetyFilter(limits, 0.1)
    # Joints 1 and 4 together: sideways and down.
    wanted = action(1.0, 0.0, 0.0, -1.0)
    free = kinematics.grip_position(HOME + 0.1 * wanted[:7])
    assert free[2] < z0 - 0.02
    target, _, causes = filter_.target(HOME, wanted)
    slid = kinematics.grip_position(target)
    assert slid[2] == pytest.approx(z0 - 0.005, abs=1e-4)
    assert slid[1] == pytest.approx(free[1], abs=0.005)
    assert causes == ["workspace"]


def test_hand_outside_the_workspace_may_only_return():
    z0 = kinematics.grip_position(HOME)[2]
    limits = SafetyLimits(acceleration_rad_s2=(1e6,) * 7, workspace_upper_m=(0.8, 0.45, z0 - 0.05))
    up, _, causes = SafetyFilter(limits, 0.1).target(HOME, action(0, 0, 0, 1.0))
    assert kinematics.grip_position(up)[2] <= z0 + 1e-4 and causes == ["workspace"]
    down = action(0, 0, 0, -0.3)
    target, _, causes = SafetyFilter(limits, 0.1).target(HOME, down)
    np.testing.assert_allclose(target - HOME, 0.1 * down[:7], atol=1e-9)
    assert causes == []


def test_no_action_leads_out_of_the_workspace():
    filter_ = SafetyFilter(SafetyLimits(), 0.1)
    rng = np.random.default_rng(0)
    lower, upper = np.array(filter_.limits.workspace_lower_m), np.array(filter_.limits.workspace_upper_m)
    q = HOME
    drift = rng.uniform(-1, 1, 8)
    for step in range(300):
        if step % 10 == 0:
            drift = rng.uniform(-1.5, 1.5, 8)
        target, _, _ = filter_.target(q, drift.astype(np.float32))
        assert np.all(np.abs(target - q) <= np.array(contract.JOINT_VELOCITY_LIMIT_RAD_S) * 0.1 + 1e-9)
        q = target
        position = kinematics.grip_position(q)
        assert np.all(position >= lower - 2e-4) and np.all(position <= upper + 2e-4)
        assert np.all(q >= contract.JOINT_LOWER_RAD) and np.all(q <= contract.JOINT_UPPER_RAD)
    assert filter_.counts.by_cause["workspace"] > 0, "the walk never met a wall: the test says nothing"


@pytest.mark.parametrize("arm", [False, True], ids=["grip", "arm"])
def test_who_is_outside_of_one_wall_does_not_go_through_the_table_instead(arm):
    """Pushed aside by a person, 8 cm beyond a wall and low: back and down at once is less far outside."""
    free = {"acceleration_rad_s2": (1e6,) * 7}
    if arm:
        free |= {"workspace_lower_m": (0.15, -0.45, -0.3), "arm_upper_m": (0.95, 0.34, 1.3)}
    else:
        free |= {"workspace_upper_m": (0.8, 0.3, 0.8), "arm_lower_m": (-0.55, -0.8, -0.3)}
    there = kinematics.grip_pose(HOME).copy()
    there[:3, 3] = 0.45, 0.38, 0.03
    q = reach(there, HOME, SafetyLimits(acceleration_rad_s2=(1e6,) * 7))
    assert q is not None
    filter_ = SafetyFilter(SafetyLimits(**free), 0.1)
    causes: list[str] = []
    for _ in range(20):
        way = np.linalg.pinv(kinematics.grip_jacobian(q)) @ (0.0, -0.02, -0.01, 0.0, 0.0, 0.0)
        q, _, why = filter_.target(q, action(*(way / 0.1)))
        causes += why
        lowest = (kinematics.part_centers(q)[:, 2] - kinematics.PART_RADII_M).min()
        assert lowest >= -1e-6 if arm else kinematics.grip_position(q)[2] >= 0.012 - 2e-4
    assert ("arm" if arm else "workspace") in causes


def test_the_hand_s_side_stays_off_the_table_though_the_grip_point_may_go_there():
    low = HOME + np.array([0, 0.45, 0, 0, 0, 0.45, 0])
    limits = SafetyLimits(acceleration_rad_s2=(1e6,) * 7, workspace_lower_m=(0.15, -0.45, -0.3))
    filter_, q = SafetyFilter(limits, 0.1), low
    causes: list[str] = []
    for _ in range(60):  # down, and the wrist turned so that a side of the hand comes lowest
        q, _, why = filter_.target(q, action(0.0, 0.3, 0.0, 0.0, 0.8, 0.1, 0.0))
        causes += why
        lowest = kinematics.part_centers(q)[:, 2] - kinematics.PART_RADII_M
        assert lowest.min() >= -1e-9
    assert "arm" in causes and np.argmin(lowest) >= kinematics.LINKS.stop, (
        "no part of the hand met the table: this says nothing"
    )


@pytest.mark.parametrize("tilt_deg", [20.0, 30.0])
def test_a_tilted_hand_s_fingertips_stay_off_the_table(tilt_deg):
    """Where the grip point alone is kept at 12 mm they end 14 and 18 mm below it."""
    limits = SafetyLimits(acceleration_rad_s2=(1e6,) * 7)
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_euler("x", tilt_deg, degrees=True).as_matrix()
    q = reach(kinematics.grip_pose(HOME) @ turn, HOME, limits)
    assert q is not None
    filter_ = SafetyFilter(limits, 0.1)
    for _ in range(60):  # straight down, the hand turned as it is
        down = np.linalg.pinv(kinematics.grip_jacobian(q)) @ (0.0, 0.0, -0.02, 0.0, 0.0, 0.0)
        q = filter_.target(q, action(*(down / 0.1)))[0]
    tips = [(kinematics.grip_pose(q) @ (0.0, y, 0.012, 1.0))[2] for y in (-0.05, 0.05)]
    assert -0.006 < min(tips) < 0.005


def test_the_elbow_stays_off_a_wall():
    limits = SafetyLimits(acceleration_rad_s2=(1e6,) * 7, arm_lower_m=(-0.55, -0.25, 0.0))
    filter_, q, causes = SafetyFilter(limits, 0.1), HOME, []
    for _ in range(40):
        q, _, why = filter_.target(q, action(-0.3, 0.0, -0.5))
        causes += why
    reach = kinematics.part_centers(q)[:, 1] - kinematics.PART_RADII_M
    assert reach.min() == pytest.approx(-0.25, abs=0.02) and reach.min() >= -0.25 and "arm" in causes


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("place", [0, 7])
def test_non_finite_action_is_refused(bad, place):
    values = np.zeros(8, np.float32)
    values[place] = bad
    filter_ = SafetyFilter(FREE, 0.1)
    with pytest.raises(NonFiniteAction):
        filter_.target(HOME, values)
    assert filter_.counts.commands == 0


def test_from_any_pose_a_step_keeps_the_curve_of_braking_and_the_slow_way_down():
    """Those of an FR3 at all of its speed, sliding along the workspace's borders included."""
    config = get_preset("debug")
    info = policy_metadata.describe(config.student, config.export, config.world.profile)
    fast = replace(config.deploy, franka=replace(config.deploy.franka, dynamics=1.0))
    limits = safety_filter(fast, info, "franka").limits
    rng, lower, upper = np.random.default_rng(0), np.array(limits.lower_rad), np.array(limits.upper_rad)
    change = np.array(limits.acceleration_rad_s2) * limits.period_s**2
    causes, low = Counter(), 0
    for _ in range(500):
        filter_, q = SafetyFilter(limits, 0.1), np.clip(HOME + rng.normal(0, 0.5, 7), lower, upper)
        target, _, changed = filter_.target(q, rng.choice([-1.0, 1.0], 8))
        step = target - q
        room = np.where(step > 0, upper - q, q - lower)
        can_stop = np.sqrt(2 * np.array(limits.braking_rad_s2) * np.maximum(room - np.abs(step), 0))
        speed = np.abs(step) / limits.period_s
        assert (speed <= np.maximum(can_stop - np.array(limits.braking_reserve_rad_s), 0) + 1e-9).all()
        assert (np.abs(step) <= change + 1e-9).all()
        here_m, there_m = (kinematics.grip_position(x)[2] for x in (q, target))
        if there_m < limits.approach_below_m:
            low += 1
            assert here_m - there_m <= limits.approach_m_s * limits.period_s + 1e-9
        causes.update(changed)
    assert min(causes["workspace"], causes["joint_position"], low) > 20


def test_a_joint_comes_to_its_limit_no_faster_than_it_can_brake():
    """At full speed from 0.5 rad away, an arm that does as it is told keeps the FR3's curve in every step."""
    limits = replace(
        FREE,
        upper_rad=contract.FR3.joint_upper_rad,
        braking_rad_s2=contract.FR3.braking_rad_s2,
        braking_reserve_rad_s=contract.FR3.braking_reserve_rad_s,
    )
    filter_, q = SafetyFilter(limits, 0.1), HOME.copy()
    q[0] = contract.FR3.joint_upper_rad[0] - 0.5
    for _ in range(20):
        before, (q, _, _) = q[0], filter_.target(q, action(1.0))
        room = contract.FR3.joint_upper_rad[0] - q[0]
        assert (q[0] - before) / 0.1 <= max(-0.30 + np.sqrt(12.0 * room), 0.0) + 1e-9
    assert 0.005 < room < 0.02
    assert filter_.target(q, action(-1.0))[0][0] == pytest.approx(q[0] - 0.1), "away from it at once"


def test_the_elbow_stays_off_a_wall_to_its_left():
    limits = SafetyLimits(acceleration_rad_s2=(1e6,) * 7, arm_upper_m=(0.95, 0.25, 1.3))
    filter_, q, causes = SafetyFilter(limits, 0.1), HOME, []
    for _ in range(40):
        q, _, why = filter_.target(q, action(0.3, 0.0, 0.5))
        causes += why
    reach = kinematics.part_centers(q)[:, 1] + kinematics.PART_RADII_M
    assert reach.max() <= 0.25 and "arm" in causes


def test_a_joint_that_brakes_comes_back_from_outside_of_its_range():
    arm, q = contract.FR3, HOME.copy()
    limits = replace(
        FREE, upper_rad=arm.joint_upper_rad, braking_rad_s2=arm.braking_rad_s2,
        braking_reserve_rad_s=arm.braking_reserve_rad_s,
    )  # fmt: skip
    q[0] = arm.joint_upper_rad[0] + 0.03
    assert SafetyFilter(limits, 0.1).target(q, action(1.0))[0][0] == pytest.approx(arm.joint_upper_rad[0])
