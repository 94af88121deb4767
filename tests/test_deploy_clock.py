"""A clock that keeps a robot's time notices a robot whose time stands still."""

import time

import pytest

from deploy.clock import RobotClock
from deploy.interfaces import RobotError
from deploy_support import KinematicRobot


class StandingStill(KinematicRobot):
    """A robot whose clock has stopped, and which does not know why."""

    def time_s(self):
        return 3.0


def test_a_long_wait_on_a_robot_that_stands_still_ends_early():
    clock = RobotClock(stalled_after_s=0.1)
    clock.follow(StandingStill(clock))
    begun = time.monotonic()
    with pytest.raises(RobotError, match="stood still for 0.1 s"):
        clock.sleep_until(33.0)
    assert time.monotonic() - begun < 10.0
