"""Drives an arm from pose to pose through its driver and the safety filter, slowly."""

import numpy as np
from jaxtyping import Float, Float64

from ddgrasp import contract
from deploy.interfaces import Clock, Robot
from deploy.safety import SafetyFilter

ARRIVED_RAD = 0.02
"""No joint further than this: where the arm stands is measured, so it need not be where it was sent."""
STALLED_S, STALLED_RAD = 3.0, 0.005
"""No joint nearer by this for so long: something is in the way."""
GRIP_S = 2.0
"""How long fingers take, amply."""
_STILL_RAD = 2e-4
_STILL_S, _PATIENCE_S = 0.3, 4.0


class Driver:
    """One command per control period; whatever it sends has passed the safety filter."""

    def __init__(self, robot: Robot, safety: SafetyFilter, clock: Clock, speed_rad_s: float):
        """`speed_rad_s` is the fastest joint's."""
        self._robot, self._safety, self._clock = robot, safety, clock
        self._step_rad = speed_rad_s * contract.CONTROL_DT_S
        self._close = False

    def go(self, q_target_rad: Float[np.ndarray, "7"], heed: bool = True) -> bool:
        """All joints at once to (7,) `q_target_rad`; whether the arm got there, and met nothing on the way
        (with `heed`; a way back begins at what it met). Raises RobotError.
        """
        best_rad, best_s = np.inf, self._clock.now()
        due_s = best_s
        while True:
            state = self._robot.read_state()
            q = state.q_rad
            if state.met and heed:
                return False
            left_rad = float(np.abs(q_target_rad - q).max())
            if left_rad < ARRIVED_RAD:
                return True
            if left_rad < best_rad - STALLED_RAD:
                best_rad, best_s = left_rad, self._clock.now()
            elif self._clock.now() - best_s > STALLED_S:
                return False
            self._send(q, (q_target_rad - q) * min(1.0, self._step_rad / left_rad))
            due_s = max(due_s + contract.CONTROL_DT_S, self._clock.now())
            self._clock.sleep_until(due_s)

    def grip(self, close: bool) -> None:
        """Close or open the hand, the arm where it is. Raises RobotError."""
        self._close = close
        self._send(self._robot.read_state().q_rad, np.zeros(7))
        self._clock.sleep_until(self._clock.now() + GRIP_S)
        self.rest()

    def rest(self) -> Float64[np.ndarray, "7"]:
        """Brake; (7,) joints once the arm stands. Raises RobotError."""
        self._robot.hold()
        self._safety.stopped()
        end_s = self._clock.now() + _PATIENCE_S
        q = self.joints()
        while True:
            self._clock.sleep_until(self._clock.now() + _STILL_S)
            before, q = q, self.joints()
            if np.abs(q - before).max() < _STILL_RAD or self._clock.now() > end_s:
                return q

    def joints(self) -> Float64[np.ndarray, "7"]:
        """(7,) as measured now. Raises RobotError."""
        return np.asarray(self._robot.read_state().q_rad, float)

    def _send(self, q_rad: np.ndarray, step_rad: np.ndarray) -> None:
        action = np.append(step_rad / self._safety.action_scale_rad, 1.0 if self._close else -1.0)
        q_next, close, _ = self._safety.target(q_rad, action)
        self._robot.command(q_next, close)
