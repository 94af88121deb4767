"""What a hand that stands still or closes on nothing does: it closes, lifts what it has, or looks again.

A policy sees three frames, 0.2 s. Nothing tells it that it has stood for a second around something taller
than it believes, waiting to get lower, or that it closes beside the object again and again, where its own
hand hides what it looks for. Nor does it know that it has done what it was trained for, in episodes of 6 s:
it goes on, its elbow drifts, and after a minute it is where no training was. Time, the fingers' opening
and what the arm feels tell all of that without a camera.
"""

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from ddgrasp import contract
from ddgrasp.gripper import CLOSE
from ddgrasp.layout import ACTION, STATE
from deploy.aside import FELT_STEPS, LOWEST_M, Aside, Landing, pressed_at
from deploy.kinematics import grip_jacobian, grip_position
from deploy.safety import SafetyLimits

EMPTY_WIDTH_M = 0.006
"""A closed hand narrower than this holds nothing."""
EMPTY_STEPS = 2
"""Control steps in a row for which it is to be so."""
VAIN_CLOSINGS, VAIN_WIDTH_M = 2, 0.050
"""A hand that has been closed so often, to less than this, and was opened again before its fingers stood on
something, has found nothing: a policy may open again before they meet, so that they are never as close as
`EMPTY_WIDTH_M`. In between they are farther apart than this."""
STILL_STEPS, STILL_M = 10, 0.030
"""A hand stands still that has moved by less within so many control steps. One that has a finger on what it
is to grasp pushes it away by 10 to 25 mm in them; coming down slowly is 60 mm."""
_SECONDS = STILL_STEPS * contract.CONTROL_DT_S
STILL_SHARE, REACH_M = 0.5, 0.4
"""The same of an arm that may not go faster: share of the way that it may make, and how far a hand is at
least from the joint that moves it."""
OPEN_WIDTH_M = 0.07
"""Fingers are open that are farther apart, those that were told to close `WIDEST_HELD_M`: an apple may be as
wide as this."""
LOW_M = 0.20
"""Only below this height of the grip does standing still mean that it is at something."""
CLOSING_STEPS = 10
"""Control steps given to fingers to close: a Franka Hand's from open to shut, and two."""
ASIDES = 3
"""How often at most a hand steps aside (each time `aside.TRIES` steps) until it has lifted something: what an
arm feels may be wrong."""
FREE_STEPS = 10
"""Control steps of an open hand above `LOW_M`, the last ones: their mean is what an arm feels that touches
and carries nothing."""
STAND_STEPS = 3
"""Fingers that have not moved in them, and did before, have something between them."""
CLEAR_M = 0.16
"""Below this height of the grip a hand goes straight up: sideways it takes with it what it stands at."""
UP_M = 0.03
"""By how much in a control step, as a policy lifts."""
ABOVE_M = 0.22
"""Where a hand that went up is high enough to look again, height of the grip."""
RETREAT_STEPS = 25
"""Control steps after which it looks again in any case; a slow arm has more, `patience`."""
WIDEST_HELD_M = contract.GRIPPER_MAX_WIDTH_M - 0.002
"""Fingers that are closer than this, and not `EMPTY_WIDTH_M`, hold something."""
LIFTING_STEPS = 60
"""Control steps given to a lift: from anywhere to where objects are lifted to takes 25, being there 20. A
slow arm has more, `patience`."""
BRISK_M_S = 0.17
"""A hand that can go so fast, as by default a Franka's, gets there in these steps."""
SAME_WIDTH_M = 0.002
"""Fingers that have moved by less stand on what is between them."""
DONE_STEPS = 20
"""Control steps in a row that a hand has held something where objects are lifted to: it is done."""
HELD_AT_M = (contract.LIFT_TARGET_M[0], contract.LIFT_TARGET_M[1], contract.LIFT_TARGET_M[2] + 0.020)
"""Where the grip takes what it holds, so that it is where objects are lifted to: what is not held by its
middle hangs lower, a can that is held by its end by 4 cm."""
ARRIVED_M = 0.010
"""A grip is there that is closer."""
OPEN = -1.0
"""The gripper's command while it goes up."""


def still_for(limits: SafetyLimits) -> float:
    """Metres in `STILL_STEPS` by which a hand within `limits` moves unless it stands still."""
    approach_m_s = limits.approach_m_s if limits.approach_below_m else np.inf
    fastest_m_s = min(approach_m_s, _free_m_s(limits))
    return min(STILL_M, STILL_SHARE * fastest_m_s * STILL_STEPS * limits.period_s)


def patience(limits: SafetyLimits) -> float:
    """How many times as long as a brisk arm one within `limits` takes for a way in free air, at least 1."""
    return max(1.0, BRISK_M_S / _free_m_s(limits))


def _free_m_s(limits: SafetyLimits) -> float:
    return REACH_M * min(limits.velocity_rad_s)


@dataclass(frozen=True)
class _Now:
    """What a control step knows of the arm; `state` and `met` as given to `Retry.__call__`."""

    state: Float[np.ndarray, "8"]
    q_rad: Float[np.ndarray, "7"]
    """The state's joints, in double precision."""
    grip_m: Float[np.ndarray, "3"]
    """Where the grip is, by them."""
    met: bool
    closed: bool
    """What the fingers were told last."""
    pressed_m: Float[np.ndarray, "2"]
    """`aside.pressed_at`."""
    landed: bool
    """A finger stands on something (`aside.Landing`)."""


class Retry:
    """Acts instead of the policy for a while; call it with the robot's state in every control step.

    A hand that is empty, or has closed and opened again and again, goes up with open fingers, then towards
    the start pose. One that is low and open and stands still closes once; if it comes to stand still again it
    goes up. One that has a finger on what it is to grasp steps aside (`deploy.aside`) and closes. One that
    has closed on something, or stays low with something in it, lifts it, straight up, then to where objects
    are lifted to. One that has lifted something stays there for as long as it has it.

    Each of these but the last is a generator that yields an action (8,) for every control step, `self._now`;
    `self._doing` is the one that acts. The one that ends says so before its last action (`_end`), and what
    comes next. Staying goes before all of them: what the hand was doing goes on if it loses what it has.
    """

    def __init__(self, still_m: float = STILL_M, patience: float = 1.0) -> None:
        """See `still_for` and `patience`."""
        self._still_m = still_m
        self._lifting_steps, self._retreat_steps = (
            round(steps * patience) for steps in (LIFTING_STEPS, RETREAT_STEPS)
        )
        self._landing = Landing(still_m * (FELT_STEPS - 1) / STILL_STEPS)
        self._asides_left = ASIDES
        self._free_nm: deque[np.ndarray] = deque(maxlen=FREE_STEPS)
        self.reset()

    def reset(self) -> None:
        """Start of an episode: what was before does not count."""
        self._doing = self._lifting = None
        self.held()
        self._lifted_steps = 0
        self._stay_rad: np.ndarray | None = None

    def held(self) -> None:
        """The arm was held: what was before does not count, except that something is lifted, or being it."""
        self.begun = ""
        """Why it took over in the last call, empty if it did not."""
        self.done = False
        """Whether that was because nothing is left to do."""
        self._end(then=self._lifting if self._doing is self._lifting else None)
        self._closed_once = False

    def __call__(
        self,
        state: Float[np.ndarray, "8"],
        met: bool = False,
        felt_nm: Float[np.ndarray, "7"] | None = None,
        closed: bool = False,
    ) -> Float[np.ndarray, "8"] | None:
        """(8,) action for the state (8,), None where the policy is to act.

        `met`: the arm gave way; `felt_nm`: (7,) what pressed on it, see `RobotState`; `closed`: what the
        fingers were told last.
        """
        self.begun, self.done = "", False
        self._now = self._observed(state, met, felt_nm, closed)
        if (stay := self._stay()) is not None:
            return stay
        if self._doing is None:
            self._doing = self._look()
        return None if self._doing is None else next(self._doing)

    def _observed(
        self, state: Float[np.ndarray, "8"], met: bool, felt_nm: Float[np.ndarray, "7"] | None, closed: bool
    ) -> _Now:
        q_rad = state[STATE.arm].astype(np.float64)
        grip_m = grip_position(q_rad)
        self._places.append(grip_m)
        self._widths.append(float(state[STATE.width][0]))
        self._count_closings(float(grip_m[2]), closed)
        pressed_m = pressed_at(q_rad, self._tared(grip_m, felt_nm, closed))
        landed = self._landing(float(grip_m[2]), pressed_m)
        return _Now(state, q_rad, grip_m, met, closed, pressed_m, landed)

    def _count_closings(self, height_m: float, closed: bool) -> None:
        """Closings of a low hand that were taken back with nothing between the fingers."""
        if height_m > LOW_M:
            self._vain_closings = 0
        if self._widths[-1] > VAIN_WIDTH_M:
            self._was_wide = True
        elif self._was_wide and self._was_closed and not closed and not self._stood():
            self._vain_closings, self._was_wide = self._vain_closings + 1, False
        self._was_closed = closed

    def _tared(
        self, grip_m: Float[np.ndarray, "3"], felt_nm: Float[np.ndarray, "7"] | None, closed: bool
    ) -> Float[np.ndarray, "7"] | None:
        """(7,) `felt_nm` without what the arm felt where it touches nothing."""
        if felt_nm is None:
            return None
        if grip_m[2] > LOW_M and self._widths[-1] > _open_m(closed):
            self._free_nm.append(felt_nm)
        return felt_nm - np.mean(self._free_nm, axis=0) if self._free_nm else felt_nm

    def _stay(self) -> Float[np.ndarray, "8"] | None:
        """(8,) action of a hand that has held something at the lift's place for long enough; else None.

        It goes to `HELD_AT_M`, and stays.
        """
        state = self._now.state
        away_m = float(np.linalg.norm(self._now.grip_m - contract.LIFT_TARGET_M))
        there = self._lifted_steps >= DONE_STEPS or away_m < contract.LIFT_TOLERANCE_M
        if not (there and self._holds()):
            self._lifted_steps, self._stay_rad = 0, None
            return None
        self._lifted_steps += 1
        if self._lifted_steps < DONE_STEPS:
            return None
        if self._lifted_steps == DONE_STEPS:
            self.begun, self.done = "what was grasped is lifted; stays there", True
            self._asides_left = ASIDES
        if self._stay_rad is None:
            way_m = HELD_AT_M - self._now.grip_m
            late = self._lifted_steps > DONE_STEPS + self._retreat_steps
            if not late and np.linalg.norm(way_m) > ARRIVED_M:
                return _moved(state, way_m, CLOSE)
            self._stay_rad = np.array(state[STATE.arm])
        return _towards(self._stay_rad, state, CLOSE)

    def _look(self) -> Iterator[np.ndarray] | None:
        """What to do instead of the policy, None to let it act."""
        if self._now.landed and self._may_step_aside():
            return self._step_aside()
        widths = [*self._widths]
        if len(widths) >= EMPTY_STEPS and max(widths[-EMPTY_STEPS:]) < EMPTY_WIDTH_M:
            return self._go_up(f"the hand closed to {1e3 * widths[-1]:.1f} mm, on nothing")
        if self._vain_closings >= VAIN_CLOSINGS:
            return self._go_up(f"the hand has closed and opened again {VAIN_CLOSINGS} times")
        if len(widths) <= STILL_STEPS:
            return None
        if self._keeps():
            self.begun = f"it has held something for {_SECONDS:.0f} s; lifts it"
            return self._begin_lift()
        if not self._stands():
            return None
        reason = f"the open hand has stood still for {_SECONDS:.0f} s"
        if self._closed_once:
            return self._go_up(f"{reason} again")
        self.begun, self._closed_once = f"{reason}; closes", True
        return self._close()

    def _step_aside(self) -> Iterator[np.ndarray]:
        now = self._now
        self.begun = "a finger of the open hand is on something; steps aside"
        self._asides_left -= 1
        aside = Aside(now.q_rad, now.pressed_m, self._places[-FELT_STEPS])
        while True:
            now, tries = self._now, aside.tries
            way_m = aside(now.q_rad, now.met, now.landed, now.pressed_m)
            if aside.failed:
                yield from self._go_up("the hand comes down on something wherever it does")
                return
            if aside.ended:
                yield from self._close()
                return
            if aside.tries > tries:
                self.begun = "a finger is on something again; steps aside"
            yield _moved(now.state, way_m, OPEN)

    def _close(self) -> Iterator[np.ndarray]:
        for left in reversed(range(CLOSING_STEPS)):
            if self._grips():
                self.begun, self._closed_once = "it holds something; lifts it", False
                self._end(then=self._begin_lift())
            elif not left:
                self._end()
            yield _still(CLOSE)

    def _begin_lift(self) -> Iterator[np.ndarray]:
        self._lifting = self._lift()
        return self._lifting

    def _lift(self) -> Iterator[np.ndarray]:
        """Straight up, then to where objects are lifted to."""
        for left in reversed(range(self._lifting_steps)):
            if not (left and self._holds()):
                self._end()
            way_m = HELD_AT_M - self._now.grip_m
            if self._now.grip_m[2] < ABOVE_M:
                way_m[:2] = 0.0
            yield _moved(self._now.state, way_m, CLOSE)

    def _go_up(self, reason: str) -> Iterator[np.ndarray]:
        """Straight up with open fingers, then towards the start pose, until it can look again."""
        self.begun, self._closed_once = f"{reason}; goes up to look again", False
        for left in reversed(range(self._retreat_steps)):
            height_m = self._now.grip_m[2]
            if not left or (height_m > ABOVE_M and self._widths[-1] > OPEN_WIDTH_M):
                self._end()
            if height_m < CLEAR_M:
                yield _moved(self._now.state, np.array((0.0, 0.0, UP_M)), OPEN)
            else:
                yield _towards(np.array(contract.HOME_RAD), self._now.state, OPEN)

    def _end(self, then: Iterator[np.ndarray] | None = None) -> None:
        """What was until now does not count; `then` acts from the next control step on."""
        self._places: deque[np.ndarray] = deque(maxlen=STILL_STEPS + 1)
        self._widths: deque[float] = deque(maxlen=STILL_STEPS + 1)
        self._vain_closings, self._was_closed, self._was_wide = 0, False, True
        self._landing.forget()
        self._doing = then

    def _may_step_aside(self) -> bool:
        low = LOWEST_M < self._now.grip_m[2] < LOW_M
        return bool(low and self._asides_left and self._widths[-1] > _open_m(self._now.closed))

    def _stands(self) -> bool:
        """Whether the open hand stands still."""
        moved_m = float(np.linalg.norm(self._places[0] - self._now.grip_m))
        still = moved_m < self._still_m and self._now.grip_m[2] < LOW_M
        return bool(still and min(self._widths) > _open_m(self._now.closed))

    def _keeps(self) -> bool:
        """Whether the fingers stand on something, and the hand stays low with it."""
        height_m = float(self._now.grip_m[2])
        same = max(self._widths) - min(self._widths) < SAME_WIDTH_M
        stays = height_m - float(self._places[0][2]) < self._still_m and height_m < LOW_M
        return stays and same and EMPTY_WIDTH_M < self._widths[-1] < _open_m(self._now.closed)

    def _stood(self) -> bool:
        """Whether the fingers had not moved before this step, and were not shut."""
        widths_m = [*self._widths][-STAND_STEPS - 1 : -1]
        stood = len(widths_m) == STAND_STEPS and max(widths_m) - min(widths_m) < SAME_WIDTH_M
        return stood and widths_m[-1] > EMPTY_WIDTH_M

    def _holds(self) -> bool:
        return EMPTY_WIDTH_M < self._widths[-1] < WIDEST_HELD_M

    def _grips(self) -> bool:
        """Whether fingers that close have come to stand on something."""
        widths_m = [*self._widths]
        came = max(widths_m) - widths_m[-1] > SAME_WIDTH_M
        stand = max(widths_m[-STAND_STEPS:]) - min(widths_m[-STAND_STEPS:]) < SAME_WIDTH_M
        return came and stand and self._holds()


def _open_m(closed: bool) -> float:
    """Width above which the hand is open, and holds nothing that it could lift; `closed`: as it was told."""
    return WIDEST_HELD_M if closed else OPEN_WIDTH_M


def _still(gripper: float) -> Float[np.ndarray, "8"]:
    action = np.zeros(contract.ACTION_SIZE)
    action[ACTION.gripper] = gripper
    return action


def _moved(state: Float[np.ndarray, "8"], way_m: Float[np.ndarray, "3"], gripper: float) -> np.ndarray:
    """(8,) action that moves the grip by (3,) `way_m`, `UP_M` at most, without turning it (pseudo-inverse of
    its Jacobian)."""
    action = _still(gripper)
    way_m = way_m * min(1.0, UP_M / max(float(np.linalg.norm(way_m)), 1e-9))
    jacobian = grip_jacobian(state[STATE.arm].astype(np.float64))
    way = np.linalg.pinv(jacobian) @ np.append(way_m, np.zeros(3)) / contract.ACTION_SCALE_RAD
    action[ACTION.arm] = way / max(1.0, float(np.abs(way).max()))
    return action


def _towards(q_rad: Float[np.ndarray, "7"], state: Float[np.ndarray, "8"], gripper: float) -> np.ndarray:
    action = _still(gripper)
    way_rad = np.asarray(q_rad) - state[STATE.arm]
    action[ACTION.arm] = np.clip(way_rad / contract.ACTION_SCALE_RAD, -1.0, 1.0)
    return action
