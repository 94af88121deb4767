"""A hand with a finger on what it is to grasp steps aside by as much as it has room, and comes down again.

A camera that has the object two centimetres from where it is has it there again from above, and the finger
lands where it landed. But the arm has felt which finger it was.
"""

from collections import deque

import numpy as np
from jaxtyping import Float, Float64

from deploy.kinematics import grip_jacobian, grip_pose, grip_position

PRESS_N = 4.0
"""Less than this along the hand is no contact. A soft arm that a policy has come down presses with 6 N."""
FINGER_M, FARTHEST_M = 0.025, 0.08
"""What presses on the hand between so far and so far from its axis, along the fingers' opening, presses on a
finger: open they are 40 to 55 mm from it. Nearer it is the palm's, or both fingers'; farther it is not the
hand that is pressed on."""
FELT_STEPS = 3
"""Control steps in a row in which the same finger has been on something: it has landed."""
HALF_FINGER_M = 0.010
"""Half of its width, across the opening: what presses on its edge is the near part of what is farther."""
ASIDE_M = 0.014
"""A step aside: the room that an open hand has around something 66 mm wide, so that none is stepped over."""
TRIES = 3
"""Steps aside; one that goes back is half as long."""
RAISED_M = 0.025
"""By how much the hand is raised for it."""
DEEP_M, FLOOR_M = 0.040, 0.020
"""How far below where the finger met it the hand goes to close, and how low at most, height of the grip."""
LOWEST_M = 0.04
"""Below this height of the grip what a finger stands on may be the table."""
DOWN_M = 0.006
"""Down in a control step: 6 cm/s, also where the safety filter would let it go faster."""
NEAR_M = 0.005
"""The hand is where it was to be."""
_UP, _ASIDE, _DOWN = range(3)
_STEPS = (5, 5, 60)
"""Control steps given to each. Down are 65 mm: 11 by 6 cm/s, 33 by 2."""


def pressed_at(
    q_rad: Float[np.ndarray, "7"], felt_nm: Float[np.ndarray, "7"] | None
) -> Float64[np.ndarray, "2"]:
    """(2,) where something presses on the hand along it: x and y of the grip's frame, metres from its axis.

    Zeros for less than `PRESS_N`, or where the arm does not say what it feels. The wrench at the grip is the
    one whose joint torques (its Jacobian's transpose) are nearest to the (7,) that the arm feels; what
    presses along the hand by F turns it by y F about x, and by -x F about y.
    """
    if felt_nm is None:
        return np.zeros(2)
    wrench = np.linalg.pinv(grip_jacobian(q_rad).T) @ felt_nm
    axes = grip_pose(q_rad)[:3, :3]
    force_n, turn_nm = float(axes[:, 2] @ wrench[:3]), axes.T @ wrench[3:]
    if force_n > -PRESS_N:
        return np.zeros(2)
    return np.array((-turn_nm[1], turn_nm[0])) / force_n


def on_a_finger(pressed_m: Float[np.ndarray, "2"]) -> bool:
    """Whether what presses on the hand at (2,) `pressed_at` presses on a finger."""
    return FINGER_M < abs(float(pressed_m[1])) < FARTHEST_M


class Landing:
    """Notices that a finger stands on something. Call it in every control step."""

    def __init__(self, stopped_m: float) -> None:
        """`stopped_m`: a hand that comes down moves by more in `FELT_STEPS`."""
        self._stopped_m = stopped_m
        self.forget()

    def forget(self) -> None:
        """What was felt until now does not count."""
        self._felt: deque[tuple[float, float]] = deque(maxlen=FELT_STEPS)

    def __call__(self, height_m: float, pressed_m: Float[np.ndarray, "2"]) -> bool:
        """Whether it does; the grip's height, and (2,) `pressed_at`."""
        self._felt.append((height_m, float(pressed_m[1]) if on_a_finger(pressed_m) else 0.0))
        heights_m, at_m = zip(*self._felt, strict=True)
        stopped = max(heights_m) - min(heights_m) < self._stopped_m
        return len(at_m) == FELT_STEPS and stopped and (min(at_m) > 0.0 or max(at_m) < 0.0)


class Aside:
    """Up, aside and down; again where it comes down on a finger again."""

    def __init__(
        self,
        q_rad: Float[np.ndarray, "7"],
        pressed_m: Float[np.ndarray, "2"],
        came_to_m: Float[np.ndarray, "3"],
    ) -> None:
        """A finger of the hand at (7,) `q_rad` is on something, which presses on it at (2,) `pressed_at`.

        `came_to_m`: (3,) the grip when it came there; a soft arm that presses on slides away.
        """
        self.ended = False
        """Whether the hand is where it is to close."""
        self.failed = False
        """Whether it cannot get there: a finger is on something after the last try as well."""
        self.tries = 0
        self._way_m = ASIDE_M * float(np.sign(pressed_m[1]))
        self._plan(q_rad, pressed_m, came_to_m)

    def __call__(
        self, q_rad: Float[np.ndarray, "7"], met: bool, landed: bool, pressed_m: Float[np.ndarray, "2"]
    ) -> Float64[np.ndarray, "3"]:
        """(3,) way of the grip from the joints (7,), metres.

        `met`: the arm gave way to what presses at (2,) `pressed_m`; `landed`: a finger stands on it.
        """
        if self._phase == _DOWN and (landed or (met and pressed_m.any())):
            self._meet(q_rad, pressed_m)
        grip_m = grip_position(q_rad)
        if not (self.ended or self.failed):
            self._go_on(grip_m)
        way_m = self._places_m[self._phase] - grip_m
        if self._phase == _DOWN:
            way_m[2] = max(way_m[2], -DOWN_M)
        return way_m

    def _go_on(self, grip_m: Float[np.ndarray, "3"]) -> None:
        """To the next place, or the end, if the hand is there or comes no nearer."""
        way_m = self._places_m[self._phase] - grip_m
        left_m = (way_m[2], float(np.linalg.norm(way_m[:2])), -way_m[2])[self._phase]
        self._steps += 1
        if left_m > self._left_m - NEAR_M / FELT_STEPS:
            self._stands += 1
        else:
            self._left_m, self._stands = left_m, 0
        stuck = self._phase == _DOWN and self._stands > FELT_STEPS
        if left_m >= NEAR_M and self._steps <= _STEPS[self._phase] and not stuck:
            return
        if self._phase == _DOWN:
            self.ended = left_m < NEAR_M or float(grip_m[2]) < self._met_m - NEAR_M
            self.failed = not self.ended
        self._begin(min(self._phase + 1, _DOWN))

    def _plan(
        self,
        q_rad: Float[np.ndarray, "7"],
        pressed_m: Float[np.ndarray, "2"],
        came_to_m: Float[np.ndarray, "3"],
    ) -> None:
        pose = grip_pose(q_rad)
        across_m = float(np.clip(pressed_m[0], -HALF_FINGER_M, HALF_FINGER_M))
        way_m = (across_m * pose[:3, 0] + self._way_m * pose[:3, 1]) * (1.0, 1.0, 0.0)
        self._met_m = float(pose[2, 3])
        up = np.append(came_to_m[:2], self._met_m + RAISED_M)
        deep = np.append((up + way_m)[:2], max(self._met_m - DEEP_M, FLOOR_M))
        self._places_m = (up, up + way_m, deep)
        self.tries += 1
        self._begin(_UP)

    def _begin(self, phase: int) -> None:
        self._phase, self._steps, self._stands, self._left_m = phase, 0, 0, np.inf

    def _meet(self, q_rad: Float[np.ndarray, "7"], pressed_m: Float[np.ndarray, "2"]) -> None:
        """On the way down the arm met something."""
        low = float(grip_position(q_rad)[2]) < LOWEST_M
        if low or abs(float(pressed_m[1])) <= FINGER_M:
            self.ended = True
        elif not on_a_finger(pressed_m):
            return
        elif self.tries == TRIES:
            self.failed = True
        else:
            back = pressed_m[1] * self._way_m < 0.0
            self._way_m *= -0.5 if back else 1.0
            self._plan(q_rad, pressed_m, self._places_m[_DOWN])
