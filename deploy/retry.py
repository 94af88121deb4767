"""What a hand that stands still or has closed on nothing does: it closes, or looks again from above.

A policy sees three frames, 0.3 s. Nothing tells it that it has stood for a second around something taller
than it believes, waiting to get lower, or that it closes beside the object again and again, where its own
hand hides what it looks for. Nor does it know that it has done what it was trained for, in episodes of 6 s:
it goes on, its elbow drifts, and after a minute it is where no training was. Time and the fingers' opening
tell all of that without a camera.
"""

from collections import deque

import numpy as np
from jaxtyping import Float

from ddgrasp import contract
from ddgrasp.gripper import CLOSE
from ddgrasp.layout import ACTION, STATE
from deploy.kinematics import grip_jacobian, grip_position

EMPTY_WIDTH_M = 0.006
"""A closed hand narrower than this holds nothing."""
EMPTY_STEPS = 2
"""Control steps in a row for which it is to be so."""
STILL_STEPS, STILL_M = 10, 0.030
"""A hand stands still that has moved by less within so many control steps. One that has a finger on what it
is to grasp pushes it away by 10 to 25 mm in them; coming down slowly is 55 mm."""
OPEN_WIDTH_M = 0.07
"""Fingers are open that are farther apart."""
LOW_M = 0.20
"""Only below this height of the grip does standing still mean that it is at something."""
CLOSING_STEPS = 10
"""Control steps given to fingers to close: a Franka Hand's from open to shut, and two."""
CLEAR_M = 0.16
"""Below this height of the grip a hand goes straight up: sideways it takes with it what it stands at."""
UP_M = 0.03
"""By how much in a control step, as a policy lifts."""
ABOVE_M = 0.22
"""Where a hand that went up is high enough to look again, height of the grip."""
RETREAT_STEPS = 25
"""Control steps after which it looks again in any case."""
WIDEST_HELD_M = contract.GRIPPER_MAX_WIDTH_M - 0.002
"""Fingers that are closer than this, and not `EMPTY_WIDTH_M`, hold something."""
DONE_STEPS = 20
"""Control steps in a row that a hand has held something where objects are lifted to: it is done."""
OPEN = -1.0
"""The gripper's command while it goes up."""


class Retry:
    """Acts instead of the policy for a while; call it with the robot's state in every control step.

    A hand that is empty goes up with open fingers, then towards the start pose. One that stands still, low
    and open, closes once; if it comes to stand still again, or has met something, it goes up: then a finger
    is on what it is to grasp. One that has lifted something stays there for as long as it has it.
    """

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Start of an episode, or the arm was held: what was before does not count."""
        self.begun = ""
        """Why it took over in the last call, empty if it did not."""
        self.done = False
        """Whether that was because nothing is left to do."""
        self._forget()
        self._closed_once = False
        self._lifted_steps = 0
        self._stay_rad: np.ndarray | None = None

    def __call__(self, state: Float[np.ndarray, "8"], met: bool = False) -> Float[np.ndarray, "8"] | None:
        """(8,) action for the state (8,), None where the policy is to act; `met`: the arm gave way."""
        self.begun, self.done = "", False
        grip_m = grip_position(state[STATE.arm].astype(np.float64))
        self._places.append(grip_m)
        self._widths.append(float(state[STATE.width][0]))
        self._met.append(met)
        if (stay := self._stay(state, grip_m)) is not None:
            return stay
        if not (self._closing or self._retreat):
            self._look(grip_m)
        if self._closing:
            self._closing -= 1
            if not self._closing:
                self._forget()
            return _still(CLOSE)
        if self._retreat:
            self._retreat -= 1
            if not self._retreat or (grip_m[2] > ABOVE_M and self._widths[-1] > OPEN_WIDTH_M):
                self._forget()
            if grip_m[2] < CLEAR_M:
                return _straight_up(state)
            return _towards(np.array(contract.HOME_RAD), state, OPEN)
        return None

    def _stay(self, state: Float[np.ndarray, "8"], grip_m: Float[np.ndarray, "3"]) -> np.ndarray | None:
        """(8,) action of a hand that has held something at the lift's place for long enough; else None."""
        away_m = float(np.linalg.norm(grip_m - contract.LIFT_TARGET_M))
        there = self._stay_rad is not None or away_m < contract.LIFT_TOLERANCE_M
        if not (there and EMPTY_WIDTH_M < self._widths[-1] < WIDEST_HELD_M):
            self._lifted_steps, self._stay_rad = 0, None
            return None
        self._lifted_steps += 1
        if self._lifted_steps == DONE_STEPS:
            self._stay_rad = np.array(state[STATE.arm])
            self.begun, self.done = "what was grasped is lifted; stays there", True
        return None if self._stay_rad is None else _towards(self._stay_rad, state, CLOSE)

    def _look(self, grip_m: Float[np.ndarray, "3"]) -> None:
        """Whether to take over, and how."""
        widths = [*self._widths]
        if len(widths) >= EMPTY_STEPS and max(widths[-EMPTY_STEPS:]) < EMPTY_WIDTH_M:
            self._go_up(f"the hand closed to {1e3 * widths[-1]:.1f} mm, on nothing")
        elif len(widths) > STILL_STEPS and self._stands(grip_m):
            reason = f"the open hand has stood still for {STILL_STEPS * contract.CONTROL_DT_S:.0f} s"
            if self._closed_once or any(self._met):
                self._go_up(f"{reason} again" if self._closed_once else f"{reason} on something")
            else:
                self.begun, self._closing, self._closed_once = f"{reason}; closes", CLOSING_STEPS, True

    def _stands(self, grip_m: Float[np.ndarray, "3"]) -> bool:
        moved_m = float(np.linalg.norm(self._places[0] - grip_m))
        return moved_m < STILL_M and min(self._widths) > OPEN_WIDTH_M and float(grip_m[2]) < LOW_M

    def _go_up(self, reason: str) -> None:
        self.begun = f"{reason}; goes up to look again"
        self._retreat, self._closed_once = RETREAT_STEPS, False

    def _forget(self) -> None:
        self._places: deque[np.ndarray] = deque(maxlen=STILL_STEPS + 1)
        self._widths: deque[float] = deque(maxlen=STILL_STEPS + 1)
        self._met: deque[bool] = deque(maxlen=STILL_STEPS + 1)
        self._closing = self._retreat = 0


def _still(gripper: float) -> Float[np.ndarray, "8"]:
    action = np.zeros(contract.ACTION_SIZE)
    action[ACTION.gripper] = gripper
    return action


def _straight_up(state: Float[np.ndarray, "8"]) -> np.ndarray:
    """(8,) action of an open hand that rises without turning (pseudo-inverse of the grip's Jacobian)."""
    action = _still(OPEN)
    rise = np.array([0.0, 0.0, UP_M, 0.0, 0.0, 0.0])
    way_rad = np.linalg.pinv(grip_jacobian(state[STATE.arm].astype(np.float64))) @ rise
    way = way_rad / contract.ACTION_SCALE_RAD
    action[ACTION.arm] = way / max(1.0, float(np.abs(way).max()))
    return action


def _towards(q_rad: Float[np.ndarray, "7"], state: Float[np.ndarray, "8"], gripper: float) -> np.ndarray:
    action = _still(gripper)
    way_rad = np.asarray(q_rad) - state[STATE.arm]
    action[ACTION.arm] = np.clip(way_rad / contract.ACTION_SCALE_RAD, -1.0, 1.0)
    return action
