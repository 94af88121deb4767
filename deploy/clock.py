"""The clocks a loop can run on."""

import time

from deploy.interfaces import RobotError, TimedRobot

_SPIN_S = 0.0005
"""The last half millisecond is waited for awake: the scheduler wakes sleepers tens of microseconds late."""
_LOOK_S = 0.5
"""A robot's time is looked at so often on a long wait, so that one that stands still is not waited for."""


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


class RobotClock:
    """A robot's own time: an arm that is slower than real (a simulated one) still sees 10 Hz.

    `follow` first; until then, and while the robot does not answer, no time passes.
    """

    def __init__(self, stalled_after_s: float = 5.0):
        """`stalled_after_s` of the machine's time without any of the robot's is an error."""
        self._stalled_after_s = stalled_after_s
        self._robot: TimedRobot | None = None
        self._robot_s = 0.0

    def follow(self, robot: TimedRobot) -> None:
        """Keep the time that `robot` tells."""
        self._robot = robot

    def now(self) -> float:
        """Seconds since the robot began to answer. Raises RobotError."""
        seconds = self._read_s()
        if seconds is not None:
            self._robot_s = seconds
        return self._robot_s

    def sleep_until(self, deadline_s: float) -> None:
        """Returns when `now` has reached the deadline.

        Raises RobotError if the robot's time stands still: with the robot's own reason where it has one.
        """
        now_s, moved_at = self.now(), time.monotonic()
        while now_s < deadline_s:
            # Robots are not faster than the machine.
            time.sleep(min(max(deadline_s - now_s - _SPIN_S, _SPIN_S), _LOOK_S))
            before_s, now_s = now_s, self.now()
            if now_s > before_s:
                moved_at = time.monotonic()
            elif time.monotonic() - moved_at > self._stalled_after_s:
                self._ask_why()
                raise RobotError(f"the robot's clock has stood still for {self._stalled_after_s:g} s")

    def _read_s(self) -> float | None:
        return None if self._robot is None else self._robot.time_s()

    def _ask_why(self) -> None:
        """Raises the RobotError of whatever stopped the robot, if it knows.

        A driver tells the last time that it heard of; that nothing more came, it says when it is asked for
        the joints.
        """
        if self._robot is not None and self._read_s() is not None:
            self._robot.read_state()


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
