"""What a policy without memory needs before a slow hand: closings that last, and how its opening changes.

The fingers of a Franka Hand take 0.8 s from open to shut. The state that a student sees is their distance,
which does not say whether they are closing or opening, so a student that closes a little early opens again,
and so on: fingers that never shut. Nor does it say whether they are on their way or stopped by what they
hold. The teacher sees their speed. NumPy alone: the robot side uses it too.
"""

import numpy as np
from jaxtyping import Float

from ddgrasp.layout import ACTION, STATE, closes

CLOSE = 1.0
"""The gripper's command while a closing goes on."""


class ClosingLatch:
    """Lets a closing last, once begun; call it with every action that is about to be executed.

    Args:
      steps: actions that a closing lasts at least, one for a control step unless a slow arm takes several;
        0 lets every action pass as it is.
    """

    def __init__(self, steps: int):
        self._steps = steps
        self.reset()

    def reset(self) -> None:
        """Start of an episode: the hand is open."""
        self._since: np.ndarray | None = None

    def __call__(self, action: Float[np.ndarray, "*batch 8"]) -> Float[np.ndarray, "*batch 8"]:
        """`action` (..., 8), closing where a closing began less than `steps` calls ago."""
        since = np.zeros(action.shape[:-1], int) if self._since is None else self._since
        closing = closes(action) | ((0 < since) & (since < self._steps))
        self._since = np.where(closing, since + 1, 0)
        latched = np.array(action)
        latched[..., ACTION.gripper] = np.where(
            (closing & ~closes(action))[..., None], CLOSE, latched[..., ACTION.gripper]
        )
        return latched


class WidthChange:
    """Adds the change of the opening in a control period; call it with the state of every control step."""

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Start of an episode: the next state has no change."""
        self._before: np.ndarray | None = None

    def __call__(
        self, state: Float[np.ndarray, "*batch 8"], periods: int = 1
    ) -> Float[np.ndarray, "*batch 9"]:
        """`state` (..., 8) with the change (m) behind it: `layout.POLICY_STATE`. `periods` have passed since
        the call before: more than one where a loop was late."""
        width = state[..., STATE.width]
        change = np.zeros_like(width) if self._before is None else (width - self._before) / periods
        self._before = np.array(width)
        return np.concatenate([state, change], axis=-1)
