"""A hand with a finger on what it is to grasp: which finger, where it goes, and when it gives up."""

import numpy as np
import pytest

from ddgrasp import contract
from ddgrasp.layout import ACTION, closes
from deploy.aside import ASIDE_M, DEEP_M, FINGER_M, HALF_FINGER_M, NEAR_M, PRESS_N, TRIES, Aside, pressed_at
from deploy.kinematics import grip_jacobian, grip_pose, grip_position
from deploy.retry import CLOSING_STEPS, FELT_STEPS, STILL_STEPS, Retry

LOW = np.array(contract.HOME_RAD) + np.array([0.5, 0.35, 0, 0.1, 0, 0.3, 0.4])
"""At an object, turned in every way that a hand is."""
RIM_M = 0.045
"""Where a finger's tip is."""
OPEN, HOLDING = 0.08, 0.066
PARTS = 20
"""Of a control step, after each of which it may meet something."""
ROOM_M = (OPEN - HOLDING) / 2


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

    def __init__(self, beside_m: float) -> None:
        """`beside_m`: where its middle is from the hand's axis, along the grip's y."""
        self.q_rad, self.width_m = LOW.copy(), OPEN
        self.met_nm: np.ndarray | None = None
        self.opening = grip_pose(LOW)[:3, 1] * (1.0, 1.0, 0.0)
        self.opening /= np.linalg.norm(self.opening)
        self.top_m = grip_position(LOW)[2]
        self.middle_m = grip_position(LOW) + beside_m * self.opening

    def beside_m(self) -> float:
        return float((self.middle_m - grip_position(self.q_rad)) @ self.opening)

    def felt_nm(self) -> np.ndarray | None:
        """(7,) of a hand that stands on it."""
        beside_m = self.beside_m()
        if abs(beside_m) <= ROOM_M or grip_position(self.q_rad)[2] > self.top_m + 0.001:
            return None
        return pressed(self.q_rad, (0.0, np.sign(beside_m) * RIM_M, 0.0))

    def make(self, action: np.ndarray) -> bool:
        """Whether it met something on its way."""
        if closes(action):
            self.width_m = max(HOLDING, self.width_m - 0.016)
        for _ in range(PARTS):
            before_rad = self.q_rad
            self.q_rad = before_rad + contract.ACTION_SCALE_RAD * action[ACTION.arm] / PARTS
            self.met_nm = self.felt_nm()
            if self.met_nm is not None:
                self.q_rad = before_rad
                return True
        return False


def ran(hand: Hand, retry: Retry) -> list[str]:
    """What it said until it has it, or looks again; the hand stands on something to begin with."""
    said, met = [], False
    for _ in range(FELT_STEPS - 1):
        assert retry(np.append(hand.q_rad, hand.width_m), False, hand.felt_nm()) is None
    for _ in range(200):
        action = retry(np.append(hand.q_rad, hand.width_m), met, hand.felt_nm() if not met else hand.met_nm)
        said += [retry.begun] if retry.begun else []
        if action is None or retry.done or "goes up" in retry.begun:
            return said
        met = hand.make(action)
    raise AssertionError(f"it never ended: {said}")


@pytest.mark.parametrize("beside_m", [-0.030, -0.019, -0.009, 0.012, 0.021, 0.033])
def test_it_comes_down_around_what_a_finger_was_on_and_lifts_it(beside_m):
    hand, retry = Hand(beside_m), Retry()
    depths = []
    make = hand.make

    def seen(action):
        if closes(action):
            depths.append(hand.top_m - grip_position(hand.q_rad)[2])
        return make(action)

    hand.make = seen
    said = ran(hand, retry)
    assert said[0] == "a finger of the open hand is on something; steps aside"
    assert depths[0] > DEEP_M - 2 * NEAR_M, "deep enough around it"
    assert hand.width_m == HOLDING and grip_position(hand.q_rad)[2] > 0.3, "and lifted"


def test_it_gives_up_beside_what_a_finger_is_on_wherever_it_comes_down():
    hand, retry = Hand(-0.2), Retry()
    said = ran(hand, retry)
    assert said[-1] == "a finger is on something wherever the hand comes down; goes up to look again"
    gone_m = (grip_position(hand.q_rad) - grip_position(LOW)) @ hand.opening
    assert gone_m == pytest.approx(-TRIES * ASIDE_M, abs=2 * NEAR_M)


def test_it_goes_across_to_what_it_has_at_the_edge_of_a_finger():
    hand = Hand(-0.02)
    aside = Aside(LOW, np.array((0.03, -RIM_M)), grip_position(LOW))
    for _ in range(30):
        q_rad = hand.q_rad
        if aside.ended:
            break
        way = np.append(aside(q_rad, False, None) / 2, np.zeros(3))
        hand.q_rad = q_rad + np.linalg.pinv(grip_jacobian(q_rad)) @ way
    gone_m = grip_pose(LOW)[:3, :3].T @ ((grip_position(hand.q_rad) - grip_position(LOW)) * (1.0, 1.0, 0.0))
    np.testing.assert_allclose(gone_m[:2], (HALF_FINGER_M, -ASIDE_M), atol=NEAR_M)


def test_what_meets_the_palm_on_the_way_down_is_closed_on():
    aside = Aside(LOW, np.array((0.0, RIM_M)), grip_position(LOW))
    aside._phase = 2
    aside(LOW, True, pressed(LOW, (0.0, 0.9 * FINGER_M, -0.05)))
    assert aside.ended and not aside.failed


def test_a_hand_that_stands_with_its_palm_on_something_closes():
    retry, felt_nm = Retry(), pressed(LOW, (0.0, 0.9 * FINGER_M, -0.05))
    state = np.append(LOW, OPEN)
    assert [retry(state, True, felt_nm) for _ in range(STILL_STEPS)] == [None] * STILL_STEPS
    actions = [retry(state, True, felt_nm) for _ in range(CLOSING_STEPS)]
    assert all(action is not None and closes(action) for action in actions)
