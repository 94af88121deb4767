"""A hand with a finger on what it is to grasp: which finger, where it goes, and when it gives up."""

import numpy as np
import pytest

from ddgrasp import contract
from ddgrasp.layout import ACTION, closes
from deploy.aside import (
    ASIDE_M,
    DEEP_M,
    DOWN_M,
    FARTHEST_M,
    FELT_STEPS,
    FINGER_M,
    FLOOR_M,
    HALF_FINGER_M,
    LOWEST_M,
    NEAR_M,
    PRESS_N,
    TRIES,
    Aside,
    Landing,
    pressed_at,
)
from deploy.kinematics import grip_jacobian, grip_pose, grip_position
from deploy.retry import ASIDES, CLOSING_STEPS, FREE_STEPS, LOW_M, STILL_STEPS, Retry

LOW = np.array(contract.HOME_RAD) + np.array([0.5, 0.35, 0, 0.1, 0, 0.3, 0.4])
"""At an object, turned in every way that a hand is."""
HIGH = np.array(contract.HOME_RAD)
RIM_M = 0.045
"""Where a finger's tip is."""
AT_RIM, AT_PALM, NOWHERE = np.array((0.0, RIM_M)), np.array((0.0, 0.9 * FINGER_M)), np.zeros(2)
OPEN, HOLDING = 0.08, 0.066
PARTS = 20
"""Of a control step, after each of which it may meet something."""
ROOM_M = (OPEN - HOLDING) / 2
STEPS_ASIDE = "a finger of the open hand is on something; steps aside"
AGAIN = "a finger is on something again; steps aside"
GIVES_UP = "the hand comes down on something wherever it does"
LIFTED = "what was grasped is lifted; stays there"


def pressed(q_rad: np.ndarray, at_m: tuple[float, float, float], force_n: float = 16.0) -> np.ndarray:
    """(7,) torques on the joints by something under the hand at (3,) `at_m` of the grip's frame."""
    pose = grip_pose(q_rad)
    force = pose[:3, :3] @ (0.0, 0.0, -force_n)
    turn = np.cross(pose[:3, :3] @ at_m, force)
    return grip_jacobian(q_rad).T @ np.concatenate([force, turn])


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_the_arm_feels_which_finger_it_is(side):
    felt_nm = pressed(LOW, (0.008, side * RIM_M, 0.01))
    np.testing.assert_allclose(pressed_at(LOW, felt_nm), (0.008, side * RIM_M), atol=1e-6)


@pytest.mark.parametrize(
    "felt_nm",
    [
        None,
        np.zeros(7),
        pressed(LOW, (0.0, RIM_M, 0.0), 0.9 * PRESS_N),
        pressed(LOW, (0.0, RIM_M, 0.0), -16.0),
    ],
    ids=["an arm that does not say", "nothing", "too little to tell", "something that pulls"],
)
def test_what_does_not_press_on_the_hand_is_nowhere(felt_nm):
    assert not pressed_at(LOW, felt_nm).any()


class Hand:
    """An arm that makes its steps, above something 66 mm wide of which it feels what its fingers feel."""

    def __init__(self, beside_m: float, gives_way: bool = True) -> None:
        """`beside_m`: where its middle is from the hand's axis, along the grip's y; `gives_way`: the arm says
        that it met something, else it only feels it."""
        self.q_rad, self.width_m, self.gives_way = LOW.copy(), OPEN, gives_way
        self.met_nm: np.ndarray | None = None
        self.opening = grip_pose(LOW)[:3, 1] * (1.0, 1.0, 0.0)
        self.opening /= np.linalg.norm(self.opening)
        self.top_m = grip_position(LOW)[2]
        self.middle_m = grip_position(LOW) + beside_m * self.opening
        self.closed_at_m: list[float] = []
        """Below its top, in every step that was told to close."""

    def beside_m(self) -> float:
        return float((self.middle_m - grip_position(self.q_rad)) @ self.opening)

    def felt_nm(self) -> np.ndarray:
        """(7,) of a hand that stands on it."""
        if self.met_nm is not None:
            return self.met_nm
        beside_m = self.beside_m()
        if abs(beside_m) <= ROOM_M or grip_position(self.q_rad)[2] > self.top_m + 0.001:
            return np.zeros(7)
        return pressed(self.q_rad, (0.0, np.sign(beside_m) * RIM_M, 0.0))

    def make(self, action: np.ndarray) -> bool:
        """Whether it met something on its way, and gave way."""
        self.met_nm = None
        if closes(action):
            self.closed_at_m.append(self.top_m - grip_position(self.q_rad)[2])
            self.width_m = max(HOLDING, self.width_m - 0.005)
        for _ in range(PARTS):
            before_rad = self.q_rad
            self.q_rad = before_rad + contract.ACTION_SCALE_RAD * action[ACTION.arm] / PARTS
            felt_nm = self.felt_nm()
            if felt_nm.any():
                self.q_rad, self.met_nm = before_rad, felt_nm
                return self.gives_way
        return False


def ran(hand: Hand, retry: Retry) -> list[str]:
    """What it said until it has it, or looks again; the hand stands on something to begin with."""
    said, met = [], False
    for _ in range(FELT_STEPS - 1):
        assert retry(np.append(hand.q_rad, hand.width_m), False, hand.felt_nm()) is None
    for _ in range(200):
        action = retry(np.append(hand.q_rad, hand.width_m), met, hand.felt_nm())
        said += [retry.begun] if retry.begun else []
        if action is None or retry.done or "goes up" in retry.begun:
            return said
        met = hand.make(action)
    raise AssertionError(f"it never ended: {said}")


@pytest.mark.parametrize("gives_way", [True, False], ids=["gives way", "only feels"])
@pytest.mark.parametrize("beside_m", [-0.030, -0.019, -0.009, 0.012, 0.021, 0.033])
def test_it_comes_down_around_what_a_finger_was_on_and_lifts_it(beside_m, gives_way):
    hand, retry = Hand(beside_m, gives_way), Retry()
    said = ran(hand, retry)
    assert said[0] == STEPS_ASIDE and said[-2:] == ["it holds something; lifts it", LIFTED]
    assert said[1:-2] == [AGAIN] * (len(said) - 3)
    assert hand.closed_at_m[0] > DEEP_M - 2 * NEAR_M, "deep enough around it"
    assert hand.width_m == HOLDING and grip_position(hand.q_rad)[2] > 0.3, "and lifted"


@pytest.mark.parametrize("gives_way", [True, False], ids=["gives way", "only feels"])
def test_it_gives_up_beside_what_a_finger_is_on_wherever_it_comes_down(gives_way):
    hand = Hand(-0.2, gives_way)
    said = ran(hand, Retry())
    assert said[:-1] == [STEPS_ASIDE] + (TRIES - 1) * [AGAIN] and said[-1].startswith(GIVES_UP)
    gone_m = (grip_position(hand.q_rad) - grip_position(LOW)) @ hand.opening
    assert gone_m == pytest.approx(-TRIES * ASIDE_M, abs=2 * NEAR_M)
    assert not hand.closed_at_m


def flown(aside: Aside, q_rad: np.ndarray, until) -> np.ndarray:
    """(7,) joints of a hand that feels nothing where `until(its grip)` holds, or the end."""
    for _ in range(60):
        way_m = aside(q_rad, False, False, NOWHERE)
        if aside.ended or aside.failed or until(grip_position(q_rad)):
            return q_rad
        q_rad = q_rad + np.linalg.pinv(grip_jacobian(q_rad)) @ np.append(0.8 * way_m, np.zeros(3))
    raise AssertionError("it never came there")


def test_it_goes_across_to_what_it_has_at_the_edge_of_a_finger_from_where_it_came_to():
    slid_m = np.array((0.012, -0.004, 0.0))
    aside = Aside(LOW, np.array((0.03, -RIM_M)), grip_position(LOW) - slid_m)
    end_rad = flown(aside, LOW, lambda grip_m: False)
    assert aside.ended
    gone_m = grip_position(end_rad) - (grip_position(LOW) - slid_m)
    across_m, along_m = (grip_pose(LOW)[:3, :2].T @ (gone_m * (1.0, 1.0, 0.0))).tolist()
    assert (across_m, along_m) == pytest.approx((HALF_FINGER_M, -ASIDE_M), abs=NEAR_M)
    assert -gone_m[2] == pytest.approx(DEEP_M, abs=NEAR_M)


def test_down_is_slow_wherever_the_safety_filter_begins():
    aside, q_rad, ways_m = Aside(LOW, AT_RIM, grip_position(LOW)), LOW, []
    while not aside.ended:
        ways_m.append(aside(q_rad, False, False, NOWHERE))
        q_rad = q_rad + np.linalg.pinv(grip_jacobian(q_rad)) @ np.append(ways_m[-1], np.zeros(3))
    assert min(way_m[2] for way_m in ways_m) == -DOWN_M


def test_it_goes_no_lower_than_a_hand_may_that_cannot_see_the_table():
    low_rad = flown(Aside(LOW, AT_RIM, grip_position(LOW)), LOW, lambda grip_m: False)
    while grip_position(low_rad)[2] > LOWEST_M:
        low_rad = low_rad + np.linalg.pinv(grip_jacobian(low_rad)) @ (0, 0, -0.005, 0, 0, 0)
    aside = Aside(low_rad, AT_RIM, grip_position(low_rad))
    end_m = grip_position(flown(aside, low_rad, lambda grip_m: False))
    assert aside.ended and FLOOR_M <= end_m[2] < FLOOR_M + 2 * NEAR_M


def under_way(aside: Aside, below_m: float) -> np.ndarray:
    """(7,) joints of a hand that has gone up, and has come down to `below_m` under where it was."""
    risen = []

    def there(grip_m):
        risen.append(grip_m[2] > grip_position(LOW)[2] + 0.015)
        return any(risen) and grip_m[2] < grip_position(LOW)[2] - below_m

    return flown(aside, LOW, there)


def test_what_meets_the_palm_on_the_way_down_is_closed_on():
    aside = Aside(LOW, AT_RIM, grip_position(LOW))
    aside(under_way(aside, 0.01), True, False, AT_PALM)
    assert aside.ended and not aside.failed


def test_a_contact_that_does_not_press_along_the_hand_is_none():
    aside = Aside(LOW, AT_RIM, grip_position(LOW))
    q_rad = under_way(aside, 0.01)
    way_m = aside(q_rad, True, False, NOWHERE)
    assert not (aside.ended or aside.failed) and way_m[2] < 0.0


def test_what_presses_beside_the_hand_on_the_way_down_is_not_what_it_came_for():
    aside = Aside(LOW, AT_RIM, grip_position(LOW))
    aside(under_way(aside, 0.01), True, False, np.array((0.0, 1.1 * FARTHEST_M)))
    assert not (aside.ended or aside.failed) and aside.tries == 1


def test_near_the_table_a_finger_on_something_is_closed_with():
    low_rad = lower(LOW, LOWEST_M + 0.005)
    aside = Aside(low_rad, AT_RIM, grip_position(low_rad))
    q_rad = flown(aside, low_rad, lambda grip_m: grip_m[2] < LOWEST_M)  # after it went up
    aside(q_rad, False, True, AT_RIM)
    assert aside.ended and aside.tries == 1


def test_a_hand_that_creeps_down_is_not_stuck():
    aside, q_rad = Aside(LOW, AT_RIM, grip_position(LOW)), LOW
    for _ in range(80):
        way_m = aside(q_rad, False, False, NOWHERE)
        if aside.ended or aside.failed:
            break
        way_m[2] = max(way_m[2], -0.0015)
        q_rad = q_rad + np.linalg.pinv(grip_jacobian(q_rad)) @ np.append(way_m, np.zeros(3))
    assert aside.ended and grip_position(LOW)[2] - grip_position(q_rad)[2] > DEEP_M - 2 * NEAR_M


def test_a_reset_leaves_what_the_arm_feels_in_free_air():
    retry, wrong_nm = Retry(), pressed(LOW, (0.0, RIM_M, 0.0), 8.0)
    retry(np.append(HIGH, OPEN), False, wrong_nm)
    retry.reset()
    for _ in range(2 * FELT_STEPS):
        assert retry(np.append(LOW, OPEN), False, wrong_nm) is None


@pytest.mark.parametrize(("below_m", "closes_there"), [(0.02, True), (-0.01, False)])
def test_a_hand_that_comes_no_lower_closes_if_it_is_around_something(below_m, closes_there):
    aside = Aside(LOW, AT_RIM, grip_position(LOW))
    q_rad = under_way(aside, below_m)
    for _ in range(2 * FELT_STEPS):
        if not (aside.ended or aside.failed):
            aside(q_rad, False, False, NOWHERE)
    assert (aside.ended, aside.failed) == (closes_there, not closes_there)


@pytest.mark.parametrize(
    ("heights_m", "at_m"),
    [
        ((0.11, 0.105, 0.100), (RIM_M, RIM_M, RIM_M)),
        ((0.11, 0.12, 0.14), (RIM_M, RIM_M, RIM_M)),
        ((0.11, 0.11, 0.11), (RIM_M, -RIM_M, RIM_M)),
        ((0.11, 0.11, 0.11), (RIM_M, 0.9 * FINGER_M, RIM_M)),
        ((0.11, 0.11, 0.11), (RIM_M, 1.1 * FARTHEST_M, RIM_M)),
        ((0.11, 0.11), (RIM_M, RIM_M)),
    ],
    ids=["comes down", "goes up", "both in turn", "the palm", "beside the hand", "not long enough"],
)
def test_what_is_no_landing(heights_m, at_m):
    landing = Landing(0.006)
    assert not any(landing(z, np.array((0.0, y))) for z, y in zip(heights_m, at_m, strict=True))


def test_a_landing_is_forgotten():
    landing = Landing(0.006)
    assert [landing(0.11, AT_RIM) for _ in range(FELT_STEPS)] == [False] * (FELT_STEPS - 1) + [True]
    landing.forget()
    assert not landing(0.11, AT_RIM)


def lower(q_rad: np.ndarray, height_m: float) -> np.ndarray:
    """(7,) joints with the grip at `height_m`."""
    for _ in range(50):
        way_m = (0, 0, 0.5 * (height_m - grip_position(q_rad)[2]), 0, 0, 0)
        q_rad = q_rad + np.linalg.pinv(grip_jacobian(q_rad)) @ way_m
    return q_rad


@pytest.mark.parametrize(
    ("q_rad", "width_m", "steps_aside"),
    [
        (LOW, OPEN, True),
        (LOW, HOLDING, False),
        (lower(LOW, LOW_M + 0.01), OPEN, False),
        (lower(LOW, LOWEST_M - 0.01), OPEN, False),
    ],
    ids=["low and open", "holds something", "high", "at the table"],
)
def test_a_hand_steps_aside_where_a_finger_can_be_on_something(q_rad, width_m, steps_aside):
    retry, felt_nm = Retry(), pressed(q_rad, (0.0, RIM_M, 0.0))
    retry(np.append(HIGH, OPEN), False, np.zeros(7))
    for _ in range(FELT_STEPS):
        retry(np.append(q_rad, width_m), False, felt_nm)
    assert (retry.begun == STEPS_ASIDE) == steps_aside


def test_what_an_arm_feels_that_touches_nothing_does_not_count():
    retry, wrong_nm = Retry(), pressed(LOW, (0.0, RIM_M, 0.0), 8.0)
    for _ in range(FREE_STEPS):
        retry(np.append(HIGH, OPEN), False, wrong_nm)
    for _ in range(2 * FELT_STEPS):
        assert retry(np.append(LOW, OPEN), False, wrong_nm) is None
    for _ in range(FELT_STEPS):
        retry(np.append(LOW, OPEN), False, wrong_nm + pressed(LOW, (0.0, -RIM_M, 0.0), 8.0))
    assert retry.begun == STEPS_ASIDE


def test_what_a_hand_carries_is_not_what_an_empty_one_feels():
    retry = Retry()
    for _ in range(FREE_STEPS):
        retry(np.append(HIGH, HOLDING), False, pressed(HIGH, (0.0, 0.0, 0.0), -30.0))
    for _ in range(2 * FELT_STEPS):
        retry(np.append(LOW, OPEN), False, pressed(LOW, (0.0, RIM_M, 0.0), 0.9 * PRESS_N))
    assert retry.begun != STEPS_ASIDE
    for _ in range(FELT_STEPS):
        retry(np.append(LOW, OPEN), False, pressed(LOW, (0.0, RIM_M, 0.0)))
    assert retry.begun == STEPS_ASIDE


def test_an_arm_whose_finger_is_always_on_something_steps_aside_so_often_and_no_more():
    retry, begun = Retry(), []
    for step in range(1000):
        retry(np.append(LOW, OPEN), False, pressed(LOW, (0.0, RIM_M, 0.0)))
        begun.append(retry.begun)
        if step % 50 == 49:  # a camera that is late now and then gives no new steps
            retry.held()
    assert begun.count(STEPS_ASIDE) == ASIDES


def test_fingers_that_begin_late_are_let_close():
    """A Franka Hand's width is a fifth of a second old."""
    hand, retry = Hand(0.012), Retry()
    make, told = hand.make, []

    def late(action):
        told.append(bool(closes(action)))
        width_m, met = hand.width_m, make(action)
        hand.width_m = width_m - 0.0005 if sum(told) <= 4 else hand.width_m
        return met

    hand.make, hand.width_m = late, 0.0779
    said = ran(hand, retry)
    assert said[-2:] == ["it holds something; lifts it", LIFTED] and hand.width_m == HOLDING


def test_a_hand_that_stands_with_its_palm_on_something_closes():
    retry, felt_nm = Retry(), pressed(LOW, (0.0, 0.9 * FINGER_M, -0.05))
    state = np.append(LOW, OPEN)
    assert [retry(state, True, felt_nm) for _ in range(STILL_STEPS)] == [None] * STILL_STEPS
    actions = [retry(state, True, felt_nm) for _ in range(CLOSING_STEPS)]
    assert all(action is not None and closes(action) for action in actions)


def test_who_has_lifted_something_may_step_aside_at_the_next():
    retry, felt_nm, begun = Retry(), pressed(LOW, (0.0, RIM_M, 0.0)), []
    lifted = HIGH + np.array([0, 0.09, 0, 0.53, 0, -0.58, 0])
    for q_rad, width_m, steps in ((LOW, OPEN, 500), (lifted, HOLDING, 100), (LOW, OPEN, 500)):
        for _ in range(steps):
            retry(np.append(q_rad, width_m), False, felt_nm if width_m == OPEN else None)
            begun.append(retry.begun)
    assert begun.count(LIFTED) == 1 and begun.count(STEPS_ASIDE) == 2 * ASIDES


def test_an_arm_that_does_not_move_does_not_try_for_ever():
    aside = Aside(LOW, AT_RIM, grip_position(LOW))
    for _ in range(30):
        if not (aside.ended or aside.failed):
            aside(LOW, False, False, NOWHERE)
    assert aside.failed


def test_a_soft_arm_that_slid_away_steps_aside_from_where_it_was_to_be():
    aside, along = Aside(LOW, AT_RIM, grip_position(LOW)), grip_pose(LOW)[:3, 1]
    slid_m = np.append(0.012 * along, np.zeros(3))
    slid_rad = under_way(aside, 0.01)
    slid_rad = slid_rad + np.linalg.pinv(grip_jacobian(slid_rad)) @ slid_m
    aside(slid_rad, True, False, AT_RIM)
    gone_m = grip_position(flown(aside, slid_rad, lambda grip_m: False)) - grip_position(LOW)
    assert aside.tries == 2 and gone_m @ along == pytest.approx(2 * ASIDE_M, abs=NEAR_M)
