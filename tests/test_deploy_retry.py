"""A hand that stands still or has closed on nothing: what it does instead of the policy, and when not."""

from dataclasses import replace

import numpy as np
import pytest

from ddgrasp import contract
from ddgrasp.layout import ACTION, STATE, closes
from ddgrasp.presets import get_preset
from deploy.clock import SimClock
from deploy.interfaces import RobotState
from deploy.kinematics import grip_jacobian, grip_pose, grip_position
from deploy.loop import ControlLoop, LoopSettings
from deploy.policy import OnnxPolicy
from deploy.retry import (
    ABOVE_M,
    ARRIVED_M,
    CLEAR_M,
    CLOSING_STEPS,
    DONE_STEPS,
    EMPTY_STEPS,
    FELT_STEPS,
    HELD_AT_M,
    LIFTING_STEPS,
    LOW_M,
    RETREAT_STEPS,
    STAND_STEPS,
    STILL_M,
    STILL_STEPS,
    Retry,
    patience,
    still_for,
)
from deploy.safety import SafetyFilter, SafetyLimits
from deploy.setup import safety_filter
from deploy_support import KinematicRobot, ScriptedCamera, constant_bias, depth_mm, describe, write_policy

HOME = np.array(contract.HOME_RAD)
LOW = HOME + np.array([0, 0.2, 0, 0, 0, 0, 0])
"""At an object: the grip is lower than `LOW_M`."""
OPEN, HOLDING, SHUT = 0.08, 0.05, 0.0


def state(q_rad: np.ndarray, width_m: float) -> np.ndarray:
    return np.append(q_rad, width_m)


def told(retry: Retry, q_rad: np.ndarray, width_m: float, steps: int) -> list[np.ndarray | None]:
    return [retry(state(q_rad, width_m)) for _ in range(steps)]


def test_the_poses_are_where_they_are_said_to_be():
    assert grip_position(LOW)[2] < LOW_M < ABOVE_M < grip_position(HOME)[2]


def test_a_low_open_hand_that_stands_still_closes_once_then_goes_up_to_the_start_pose():
    retry = Retry()
    assert told(retry, LOW, OPEN, STILL_STEPS) == [None] * STILL_STEPS
    action = retry(state(LOW, OPEN))
    assert action is not None and closes(action) and not action[ACTION.arm].any()
    assert retry.begun == "the open hand has stood still for 1 s; closes" and not retry.done
    assert all(closes(a) for a in told(retry, LOW, OPEN, CLOSING_STEPS - 1)), "on what is too wide"
    assert not retry.begun, "said once"
    assert told(retry, LOW, OPEN, STILL_STEPS) == [None] * STILL_STEPS, "the policy has it again"
    action = retry(state(LOW, OPEN))
    assert action is not None and not closes(action) and "goes up" in retry.begun
    np.testing.assert_allclose(
        LOW + contract.ACTION_SCALE_RAD * action[ACTION.arm], HOME - [0, -0.1, *[0] * 5]
    )
    assert retry(state(HOME, OPEN)) is not None
    assert retry(state(HOME, OPEN)) is None, "it is high and open: the policy looks"


def test_what_it_closes_on_it_lifts():
    retry = Retry()
    told(retry, LOW, OPEN, STILL_STEPS + 1)
    assert (
        all(closes(a) for a in told(retry, LOW, HOLDING, 3)) and retry.begun == "it holds something; lifts it"
    )
    action = retry(state(LOW, HOLDING))
    assert (
        closes(action)
        and grip_position(LOW + contract.ACTION_SCALE_RAD * action[ACTION.arm])[2]
        > grip_position(LOW)[2] + 0.02
    )


def test_a_hand_that_closed_on_nothing_opens_and_goes_up_for_a_while_at_most():
    retry = Retry()
    assert told(retry, LOW, SHUT, EMPTY_STEPS - 1) == [None] * (EMPTY_STEPS - 1)
    way_up = told(retry, LOW, SHUT, RETREAT_STEPS)
    assert all(a is not None and not closes(a) and a[ACTION.arm].any() for a in way_up)
    assert told(retry, LOW, OPEN, 1) == [None], "an arm that cannot get up does not try for ever"


def close_and_open(
    retry: Retry, q_rad: np.ndarray, narrowest_m: float, stands: int = 0
) -> list[np.ndarray | None]:
    """A closing that the policy takes back, from open to open, a step each 10 mm; at its narrowest the hand
    `stands` for so many steps more."""
    way_m, there = np.arange(OPEN, narrowest_m, -0.01), [narrowest_m] * (1 + stands)
    widths = [*way_m, *there, *np.arange(narrowest_m, OPEN, 0.01), OPEN]
    told_closed = [0 < i < len(way_m) + len(there) for i in range(len(widths))]
    pushed = q_rad + np.array([0.06, *[0] * 6])  # it moves: it does not stand still
    return [
        retry(state(pushed if i % 2 else q_rad, width), closed=closed)
        for i, (width, closed) in enumerate(zip(widths, told_closed, strict=True))
    ]


def test_a_hand_that_closes_and_opens_again_in_one_place_goes_up_the_second_time():
    retry = Retry()
    assert not any(action is not None for action in close_and_open(retry, LOW, 0.015))
    begun = [action is not None for action in close_and_open(retry, LOW, 0.015)]
    assert begun.index(True) == 1 + len(np.arange(OPEN, 0.015, -0.01)), "as it opens"
    way_up = told(retry, LOW, OPEN, 3)
    assert all(a is not None and not closes(a) and a[ACTION.arm].any() for a in way_up)


@pytest.mark.parametrize("held_m", [0.025, 0.055, 0.065])
def test_a_hand_that_lets_go_of_something_has_not_closed_on_nothing(held_m):
    retry = Retry()
    for _ in range(4):
        assert not any(
            action is not None for action in close_and_open(retry, LOW, held_m, stands=STAND_STEPS)
        )


def test_a_command_that_flickers_does_not_let_go_of_what_is_held():
    retry = Retry()
    for step, width in enumerate([0.08, 0.06, 0.04, 0.04, 0.045, 0.04, 0.045, 0.04, 0.045]):
        pushed = LOW + np.array([0.06 * (step % 2), *[0] * 6])
        assert retry(state(pushed, width), closed=step in (1, 2, 3, 5, 7)) is None


@pytest.mark.parametrize("forget", ["held", "reset"])
def test_closings_before_the_arm_was_held_do_not_count(forget):
    retry = Retry()
    for _ in range(4):
        assert not any(action is not None for action in close_and_open(retry, LOW, 0.015))
        getattr(retry, forget)()


def test_a_closing_of_the_loop_s_own_is_the_first():
    retry = Retry()
    told(retry, LOW, OPEN, STILL_STEPS + CLOSING_STEPS)
    assert retry(state(LOW, 0.02), closed=True) is None, "the policy's again"
    assert retry(state(LOW, 0.03), closed=False) is None
    assert any(action is not None for action in close_and_open(retry, LOW, 0.015))


def test_closings_before_the_hand_went_up_do_not_count():
    retry = Retry()
    for _ in range(4):
        assert not any(action is not None for action in close_and_open(retry, LOW, 0.015))
        told(retry, HOME, OPEN, 1)


def test_a_hand_that_has_held_something_for_a_while_lifts_it_and_keeps_it():
    aside = LOW + np.array([0.4, 0.25, 0, 0, 0, 0, 0])
    retry, q_rad = Retry(), aside.copy()
    assert told(retry, q_rad, HOLDING, STILL_STEPS) == [None] * STILL_STEPS
    begun, ways_m = [], [grip_position(q_rad)]
    while not retry.done and len(begun) < LIFTING_STEPS:
        action = retry(state(q_rad, HOLDING))
        assert action is not None and closes(action) and np.abs(action[ACTION.arm]).max() <= 1.0
        begun.append(retry.begun)
        q_rad = q_rad + contract.ACTION_SCALE_RAD * action[ACTION.arm]
        ways_m.append(grip_position(q_rad))
    assert begun[0] == "it has held something for 1 s; lifts it" and not any(begun[1:-1]) and retry.done
    low = np.array([way for way in ways_m if way[2] < ABOVE_M])
    assert len(low) > 2 and np.abs(low[:, :2] - low[0, :2]).max() < 0.01, "straight up first"
    assert np.linalg.norm(ways_m[-1] - HELD_AT_M) < ARRIVED_M


def test_a_hand_that_drags_what_it_holds_along_the_table_lifts_it_too():
    retry, drag_rad = Retry(), np.array([0.04, *[0] * 6])
    answers = [retry(state(LOW + drag_rad * step, HOLDING)) for step in range(STILL_STEPS + 1)]
    assert answers[:-1] == [None] * STILL_STEPS and answers[-1] is not None and closes(answers[-1])


def test_a_hand_that_is_on_its_way_up_with_something_is_left_alone():
    retry, up_rad = Retry(), np.array([0, -0.012, *[0] * 5])
    lowest = LOW - 10 * up_rad
    assert grip_position(lowest + STILL_STEPS * up_rad)[2] < LOW_M
    assert all(retry(state(lowest + up_rad * step, HOLDING)) is None for step in range(STILL_STEPS + 1))


def test_fingers_that_close_are_let_close():
    retry = Retry()
    for step in range(2 * STILL_STEPS):
        assert retry(state(LOW, 0.065 - 0.001 * step)) is None


def test_a_hand_that_loses_what_it_lifts_is_the_policy_s():
    retry = Retry()
    told(retry, LOW, HOLDING, STILL_STEPS + 1)
    assert retry(state(LOW, SHUT)) is not None and retry(state(LOW, OPEN)) is None


@pytest.mark.parametrize(
    ("q_rad", "width_m", "drift_rad"),
    [(HOME, OPEN, 0.0), (LOW, OPEN, 0.009)],
    ids=["it waits above", "it moves, slowly"],
)
def test_it_leaves_alone(q_rad, width_m, drift_rad):
    retry = Retry()
    for step in range(4 * STILL_STEPS):
        assert retry(state(q_rad - [drift_rad * step, *[0] * 6], width_m)) is None
    assert STATE.size == 8


def test_a_hand_that_pushes_something_away_from_above_stands_still_too():
    retry, pushed_rad = Retry(), 0.004  # 2 mm in a step at joint 1's radius
    answers = [retry(state(LOW - [pushed_rad * step, *[0] * 6], OPEN)) for step in range(STILL_STEPS + 1)]
    assert answers[:-1] == [None] * STILL_STEPS and closes(answers[-1])


def test_an_arm_that_may_only_creep_does_not_stand_still():
    slow = replace(SafetyLimits(), approach_m_s=0.03, approach_below_m=0.16)
    assert still_for(SafetyLimits()) == STILL_M
    assert still_for(slow) <= 0.03 * STILL_STEPS * contract.CONTROL_DT_S / 2
    crawling = tuple(0.03 * limit for limit in contract.JOINT_VELOCITY_LIMIT_RAD_S)
    assert still_for(replace(SafetyLimits(), velocity_rad_s=crawling)) < still_for(slow)


@pytest.mark.parametrize(("dynamics", "longer"), [(1.0, 1.0), (0.2, 1.0), (0.1, 1.95), (0.05, 3.91)])
def test_a_slow_arm_is_given_the_steps_that_it_takes(dynamics, longer):
    config = get_preset("demo").deploy
    config = replace(config, franka=replace(config.franka, dynamics=dynamics))
    limits = safety_filter(config, describe(), "franka").limits
    assert patience(limits) == pytest.approx(longer, abs=0.05)
    retry = Retry(still_for(limits), patience(limits))
    told(retry, LOW, SHUT, EMPTY_STEPS - 1)
    acts = told(retry, LOW, SHUT, round(longer * RETREAT_STEPS) + 2)
    assert sum(a is not None for a in acts) == pytest.approx(longer * RETREAT_STEPS, abs=2)
    lifting = Retry(still_for(limits), patience(limits))
    told(lifting, LOW, HOLDING, STILL_STEPS)
    acts = told(lifting, LOW, HOLDING, round(longer * LIFTING_STEPS) + 5)
    assert sum(a is not None for a in acts) == pytest.approx(longer * LIFTING_STEPS, abs=2)


def test_a_hand_at_an_object_goes_straight_up_before_it_turns_to_the_start_pose():
    beside = HOME + np.array([0.5, 0.45, 0, 0.2, 0, 0, 0])
    assert grip_position(beside)[2] < CLEAR_M
    retry, q_rad, way_m = Retry(), beside, []
    told(retry, q_rad, SHUT, EMPTY_STEPS - 1)
    while (action := retry(state(q_rad, SHUT))) is not None and grip_position(q_rad)[2] < CLEAR_M:
        before_m, q_rad = grip_position(q_rad), q_rad + contract.ACTION_SCALE_RAD * action[ACTION.arm]
        assert not closes(action) and np.abs(action[ACTION.arm]).max() <= 1.0
        way_m.append(grip_position(q_rad) - before_m)
    assert len(way_m) > 1 and np.abs(np.array(way_m)[:, :2]).max() < 0.003
    assert (np.array(way_m)[:, 2] > 0.02).all()
    action = retry(state(q_rad, SHUT))
    assert action is not None and action[ACTION.arm][0] < -0.9, "now towards the start pose, too"


def test_a_hand_that_has_lifted_something_stays_there_until_it_has_lost_it():
    lifted = HOME + np.array([0, 0.09, 0, 0.53, 0, -0.58, 0])
    assert np.linalg.norm(grip_position(lifted) - contract.LIFT_TARGET_M) < contract.LIFT_TOLERANCE_M
    retry = Retry()
    assert told(retry, lifted, HOLDING, DONE_STEPS - 1) == [None] * (DONE_STEPS - 1)
    action = retry(state(lifted, HOLDING))
    assert action is not None and closes(action) and not action[ACTION.arm].any()
    assert retry.begun == "what was grasped is lifted; stays there" and retry.done
    drifted = lifted + 0.02
    action = retry(state(drifted, HOLDING))
    assert action is not None and not retry.begun
    np.testing.assert_allclose(drifted + contract.ACTION_SCALE_RAD * action[ACTION.arm], lifted)
    assert retry(state(lifted, OPEN)) is None, "it has dropped it: the policy's turn"


def test_what_hangs_lower_than_the_fingers_is_brought_to_its_place():
    """An object held by its end, 4 cm below and 2 cm beside the grip, does not count as lifted."""
    retry, q_rad = Retry(), HOME + np.array([0.05, 0.17, 0, 0.57, 0, -0.58, 0])
    start_m, hangs_m = grip_position(q_rad), np.array([-0.020, 0.010, -0.040])
    assert np.linalg.norm(start_m - contract.LIFT_TARGET_M) < contract.LIFT_TOLERANCE_M
    assert np.linalg.norm(start_m + hangs_m - contract.LIFT_TARGET_M) > contract.LIFT_TOLERANCE_M
    told(retry, q_rad, HOLDING, DONE_STEPS - 1)
    for _ in range(10):
        action = retry(state(q_rad, HOLDING))
        assert action is not None and closes(action)
        q_rad = q_rad + contract.ACTION_SCALE_RAD * action[ACTION.arm]
    assert (
        np.linalg.norm(grip_position(q_rad) + hangs_m - contract.LIFT_TARGET_M)
        < 0.9 * contract.LIFT_TOLERANCE_M
    )
    assert not told(retry, q_rad, HOLDING, 1)[0][ACTION.arm].any(), "and stays there"


def test_an_arm_that_does_not_get_there_stays_where_it_is():
    retry, q_rad = Retry(), HOME + np.array([0.05, 0.17, 0, 0.57, 0, -0.58, 0])
    told(retry, q_rad, HOLDING, DONE_STEPS)
    assert all(action[ACTION.arm].any() for action in told(retry, q_rad, HOLDING, RETREAT_STEPS))
    assert not any(action[ACTION.arm].any() for action in told(retry, q_rad, HOLDING, 5))


def test_a_step_without_a_frame_gives_nothing_that_is_lifted_back_to_the_policy():
    lifted, retry = HOME + np.array([0, 0.09, 0, 0.53, 0, -0.58, 0]), Retry()
    told(retry, lifted, HOLDING, DONE_STEPS)
    retry.held()
    action = retry(state(lifted, HOLDING))
    assert action is not None and closes(action) and not retry.begun
    assert retry(state(lifted, OPEN)) is None


def test_a_step_without_a_frame_does_not_end_a_lift():
    retry = Retry()
    told(retry, LOW, HOLDING, STILL_STEPS + 2)
    retry.held()
    action = retry(state(LOW, HOLDING))
    assert action is not None and closes(action) and not retry.begun
    assert retry(state(LOW, SHUT)) is not None, "the last step of a lift whose object is lost"
    assert told(retry, LOW, OPEN, 1) == [None], "and then the policy's"
    retry.reset()
    assert retry(state(LOW, HOLDING)) is None


def test_what_is_nearly_as_wide_as_the_open_hand_is_held_and_not_let_go():
    wide = 0.072
    retry = Retry()
    steps = [retry(state(LOW, wide), closed=True) for _ in range(STILL_STEPS + 1)]
    assert steps[:-1] == [None] * STILL_STEPS and steps[-1] is not None and closes(steps[-1])
    assert retry.begun == "it has held something for 1 s; lifts it"
    retry = Retry()
    told(retry, LOW, wide, STILL_STEPS)
    assert retry(state(LOW, wide)) is not None and "open hand" in retry.begun, "so wide and told to open"
    retry = Retry()
    steps = [retry(state(LOW, OPEN), closed=True) for _ in range(STILL_STEPS + 1)]
    assert steps[-1] is not None and "open hand" in retry.begun, "fingers that cannot close hold nothing"


def test_what_was_before_a_reset_does_not_count():
    retry = Retry()
    told(retry, LOW, OPEN, STILL_STEPS)
    retry.reset()
    assert retry(state(LOW, OPEN)) is None


def test_the_loop_says_so_and_lets_the_policy_begin_anew(tmp_path):
    def run(retry: bool):
        clock = SimClock()
        policy = OnnxPolicy(
            write_policy(tmp_path / "p.onnx", describe(), bias=constant_bias(0.0, gripper=1.0))
        )
        robot = KinematicRobot(clock)
        limits = SafetyLimits(acceleration_rad_s2=(1e6,) * 7)
        loop = ControlLoop(
            ScriptedCamera(clock, [depth_mm()]), robot, policy, SafetyFilter(limits, 0.1), clock,
            LoopSettings(0.1, retry=retry),
        )  # fmt: skip
        told = []
        report = loop.run(7, lambda step: told.append((bool(closes(step.action)), step.by)))
        closed, by = map(list, zip(*told, strict=True))
        events = [(event.step, event.kind) for event in report.events if event.kind == "retry"]
        return closed, events, by, report

    closed, events, by, report = run(retry=True)
    # Shut from step 1 on, seen twice, open in steps 2 and 3 (the start pose is high), then the policy again.
    assert closed == [True, True, False, False, True, True, False] and events == [(2, "retry"), (6, "retry")]
    assert by == ["policy", "policy", "retry", "retry", "policy", "policy", "retry"]
    assert len(report.timings.infer_s) == 7, "the policy goes on being asked, so that time is measured"
    assert run(retry=False)[:3] == ([True] * 7, [], ["policy"] * 7)


def test_the_loop_says_what_the_arm_feels(tmp_path):
    """A finger of a robot that stands low is on something."""
    force = np.array([0.0, 0.0, 10.0])
    turn = np.cross(0.05 * grip_pose(LOW)[:3, 1], force)
    felt_nm = grip_jacobian(LOW).T @ np.concatenate([force, turn])
    clock = SimClock()
    robot = KinematicRobot(clock)
    robot.read_state = lambda: RobotState(LOW, OPEN, clock.now(), felt_nm=felt_nm)
    policy = OnnxPolicy(write_policy(tmp_path / "p.onnx", describe(), bias=constant_bias(0.0)))
    camera = ScriptedCamera(clock, [depth_mm()])
    safety, settings = SafetyFilter(SafetyLimits(), 0.1), LoopSettings(0.1, retry=True)
    loop = ControlLoop(camera, robot, policy, safety, clock, settings)
    events = loop.run(4).events
    assert [(event.step, event.kind) for event in events] == [(FELT_STEPS - 1, "retry")]
    assert events[0].reason == "a finger of the open hand is on something; steps aside"


@pytest.mark.parametrize(("width_m", "empty"), [(0.004, True), (0.008, False)])
def test_a_shut_hand_does_not_say_quite_zero_and_something_thin_is_held(width_m, empty):
    retry = Retry()
    told(retry, LOW, width_m, EMPTY_STEPS)
    assert ("on nothing" in retry.begun) == empty


def test_fingers_that_meet_hold_nothing():
    retry = Retry()
    told(retry, LOW, OPEN, STILL_STEPS + 1)
    for width_m in (0.05, 0.02, *[SHUT] * 4):
        assert retry(state(LOW, width_m)) is not None and not retry.begun


def test_the_loop_says_what_the_fingers_were_told(tmp_path):
    """Something nearly as wide as the open hand is held, not stood at."""
    clock, info = SimClock(), describe()
    robot = KinematicRobot(clock)
    robot.read_state = lambda: RobotState(LOW, 0.072, clock.now())
    policy = OnnxPolicy(write_policy(tmp_path / "p.onnx", info, bias=constant_bias(0.0, gripper=1.0)))
    camera, safety = ScriptedCamera(clock, [depth_mm()]), SafetyFilter(SafetyLimits(), 0.1)
    loop = ControlLoop(camera, robot, policy, safety, clock, LoopSettings(0.1, retry=True))
    assert loop.run(STILL_STEPS + 2).events[0].reason == "it has held something for 1 s; lifts it"
