"""A slow arm makes an action in several control steps, and the policy waits for it.

A policy knows an arm that makes its steps. Shown one that makes a third of each, its frames show a hand that
hardly moves, and it is longest where its own hand hides what it looks for. Shown a frame whenever an action
has been made, it sees what it saw in training, in slow motion.
"""

import numpy as np
from jaxtyping import Float

from ddgrasp import contract
from ddgrasp.layout import ACTION

NEARER_RAD = 0.001
"""An arm that comes no nearer than this in a control step has made what it can of its action."""
LONGEST_STEPS = 8
"""Control steps given to an action: the largest, 0.1 rad of every joint, takes some six at 6 cm/s."""


class Pace:
    """What is left of the policy's action that an arm is making."""

    def __init__(self, action_scale_rad: float) -> None:
        self._scale_rad = action_scale_rad
        self.forget()

    def forget(self) -> None:
        """The action counts as made."""
        self._target_rad: np.ndarray | None = None
        self._action = np.zeros(contract.ACTION_SIZE)
        self._away_rad, self._steps = np.inf, 0

    def rest(self, q_rad: Float[np.ndarray, "7"]) -> Float[np.ndarray, "8"] | None:
        """(8,) action that makes what is left with the joints at (7,) `q_rad`; None if nothing is."""
        if self._target_rad is None:
            return None
        way_rad, before_rad = self._target_rad - q_rad, self._away_rad
        self._away_rad = float(np.abs(way_rad).max())
        if self._away_rad > before_rad - NEARER_RAD:
            self._steps = LONGEST_STEPS
        rest = self._action.copy()
        rest[ACTION.arm] = way_rad / self._scale_rad
        return rest

    def made(self, q_rad: Float[np.ndarray, "7"], action: Float[np.ndarray, "8"], cut: bool) -> bool:
        """Whether the policy's (8,) `action`, or `rest` of it, ends with this control step: the arm at (7,)
        `q_rad` was not given a part of it alone (`cut`), or comes no nearer."""
        self._steps += 1
        if not cut or self._steps >= LONGEST_STEPS:
            self.forget()
            return True
        if self._target_rad is None:
            self._action = np.array(action, float)
            step_rad = self._scale_rad * np.clip(self._action[ACTION.arm], -1.0, 1.0)
            self._target_rad, self._away_rad = q_rad + step_rad, float(np.abs(step_rad).max())
        return False
