"""A clock that keeps a robot's time, and notices a robot whose time stands still."""

import time

import pytest

from deploy.clock import RobotClock
from deploy.interfaces import RobotError
from deploy_support import KinematicRobot


class StandingStill(KinematicRobot):
    """A robot whose clock has stopped, and which does not know why."""

    def time_s(self):
        return 3.0


class Silent(KinematicRobot):
    """A robot that does not answer at first, nor for a while later on."""

    def __init__(self, clock, *answers):
        super().__init__(clock)
        self.answers = iter(answers)

    def time_s(self):
        return next(self.answers)


def test_no_time_passes_while_a_robot_does_not_answer():
    clock = RobotClock()
    assert clock.now() == 0.0
    clock.follow(Silent(clock, None, 7.5, None, 7.6))
    assert [clock.now() for _ in range(4)] == [0.0, 7.5, 7.5, 7.6]


def test_a_long_wait_on_a_robot_that_stands_still_ends_early():
    clock = RobotClock(stalled_after_s=0.1)
    clock.follow(StandingStill(clock))
    begun = time.monotonic()
    with pytest.raises(RobotError, match="stood still for 0.1 s"):
        clock.sleep_until(33.0)
    assert time.monotonic() - begun < 10.0
