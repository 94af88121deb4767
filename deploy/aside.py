"""A hand with a finger on what it is to grasp steps aside by as much as it has room, and comes down again.

A camera that has the object two centimetres from where it is has it there again from above, and the finger
lands where it landed. But the arm has felt which finger it was.
"""

import numpy as np
from jaxtyping import Float, Float64

from deploy.kinematics import grip_jacobian, grip_pose, grip_position

PRESS_N = 4.0
"""Less than this along the hand is no contact. A soft arm that a policy has come down presses with 6 N."""
FINGER_M = 0.025
"""What presses on the hand farther than this from its axis, along the fingers' opening, presses on a finger:
open they are 40 to 55 mm from it. Nearer it is the palm's, or both fingers'."""
HALF_FINGER_M = 0.010
"""Of its width, across the opening: what presses on a finger there is the near part of what is farther."""
ASIDE_M = 0.014
"""A step aside: the room that an open hand has around something 66 mm wide, so that none is stepped over."""
TRIES = 3
"""Steps aside; one that goes back is half as long."""
RAISED_M = 0.025
"""By how much the hand is raised for it."""
DEEP_M = 0.040
"""How far below where the finger met it the hand goes to close."""
NEAR_M = 0.005
"""The hand is where it was to be."""
_DOWN = 2
"""After going up and aside."""
_STEPS = (5, 5, 14)
"""Control steps given to going up, aside and down. Down are 65 mm, of which 6 cm/s make 11."""


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
        """Whether a finger is on something after the last try as well."""
        self._tries_left, self._way_m = TRIES, ASIDE_M * float(np.sign(pressed_m[1]))
        self._plan(q_rad, pressed_m, came_to_m)

    def __call__(
        self, q_rad: Float[np.ndarray, "7"], met: bool, felt_nm: Float[np.ndarray, "7"] | None
    ) -> Float64[np.ndarray, "3"]:
        """(3,) way of the grip from the joints (7,), metres; `met`: the arm gave way to what it felt."""
        if met and self._phase == _DOWN:
            self._meet(q_rad, pressed_at(q_rad, felt_nm))
        grip_m = grip_position(q_rad)
        way_m = self._places_m[self._phase] - grip_m
        left_m = (way_m[2], float(np.linalg.norm(way_m[:2])), -way_m[2])[self._phase]
        self._steps += 1
        if left_m < NEAR_M or self._steps > _STEPS[self._phase]:
            self.ended = self.ended or self._phase == _DOWN
            self._phase, self._steps = min(self._phase + 1, _DOWN), 0
        return self._places_m[self._phase] - grip_m

    def _plan(
        self,
        q_rad: Float[np.ndarray, "7"],
        pressed_m: Float[np.ndarray, "2"],
        came_to_m: Float[np.ndarray, "3"],
    ) -> None:
        pose = grip_pose(q_rad)
        across_m = float(np.clip(pressed_m[0], -HALF_FINGER_M, HALF_FINGER_M))
        way_m = (across_m * pose[:3, 0] + self._way_m * pose[:3, 1]) * (1.0, 1.0, 0.0)
        up = np.append(came_to_m[:2], pose[2, 3] + RAISED_M)
        self._places_m = (up, up + way_m, up + way_m - (0.0, 0.0, RAISED_M + DEEP_M))
        self._phase, self._steps, self._tries_left = 0, 0, self._tries_left - 1

    def _meet(self, q_rad: Float[np.ndarray, "7"], pressed_m: Float[np.ndarray, "2"]) -> None:
        """On the way down the arm met something."""
        if abs(pressed_m[1]) < FINGER_M:
            self.ended = True
        elif not self._tries_left:
            self.failed = True
        else:
            back = pressed_m[1] * self._way_m < 0.0
            self._way_m *= -0.5 if back else 1.0
            self._plan(q_rad, pressed_m, self._places_m[_DOWN])
