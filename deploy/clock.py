"""The two clocks a loop can run on."""

import time

_SPIN_S = 0.0005
"""The last half millisecond is waited for awake: the scheduler wakes sleepers tens of microseconds late."""


class RealClock:
    """The machine's monotonic clock."""

    def now(self) -> float:
        """Seconds since some fixed moment."""
        return time.monotonic()

    def sleep_until(self, deadline_s: float) -> None:
        """Returns when `now` reaches the deadline, at once if it has passed."""
        remaining = deadline_s - time.monotonic()
        if remaining > _SPIN_S:
            time.sleep(remaining - _SPIN_S)
        while time.monotonic() < deadline_s:
            pass


class SimClock:
    """A clock that moves only when somebody sleeps on it: the same loop, as fast as it computes."""

    def __init__(self) -> None:
        self._now_s = 0.0

    def now(self) -> float:
        """Seconds slept so far."""
        return self._now_s

    def sleep_until(self, deadline_s: float) -> None:
        """Moves the clock to the deadline, never back."""
        self._now_s = max(self._now_s, deadline_s)
