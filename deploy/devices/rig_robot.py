"""The Franka of the development rig as a robot driver: MuJoCo's C engine, advanced by the loop's clock."""

import math
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from ddgrasp import contract
from deploy.devices.options import Setup
from deploy.interfaces import Clock, RobotState

if TYPE_CHECKING:
    import rig.world

_EARLY_S = 1e-6
"""Clock readings this much before a period's end count as its end (rounding)."""


def make(setup: Setup) -> "SimRobot":
    """Before a fresh world with the chosen object; UserError for an unknown one."""
    from mjx_envs.objects import get_object
    from rig.world import make_world

    config = setup.config
    name = get_object(setup.options.object_name or config.world.objects[0]).name
    world = make_world(config.world, (name,))
    world.reset(config.seed, name)
    return SimRobot(world, setup.clock, 1.0 / setup.info.control_hz)


class SimRobot:
    """Drives a `RigWorld`. The world lives in whole control periods: whoever looks at it first in a
    period (camera or joints) moves it to that period's start, so one period passes between two
    looks on the simulated clock, and as many as really passed on the real one.
    """

    def __init__(self, world: "rig.world.RigWorld", clock: Clock, period_s: float = contract.CONTROL_DT_S):
        self.world = world
        self._clock, self._period_s = clock, period_s
        self._start_s: float | None = None
        self._periods = 0
        self._close, self._holding = False, False

    def start(self) -> None:
        """World time starts to follow the clock (at the first look, if that comes before)."""
        if self._start_s is None:
            self._start_s = self._clock.now()

    def read_state(self) -> RobotState:
        """The world's joints and gripper at the start of the current period."""
        now_s = self.catch_up()
        q, width_m = self.world.state()
        return RobotState(np.asarray(q, float), float(width_m), now_s)

    def command(self, q_target_rad: Float[np.ndarray, "7"], close: bool) -> None:
        """Set the (7,) joint target and the gripper; the world moves when someone looks at it."""
        self.world.command(q_target_rad, close)
        self._close, self._holding = close, False

    def hold(self) -> None:
        """Make the present joints the target; the gripper keeps what it does."""
        if not self._holding:  # once: measuring again and again would sag under load
            q, _ = self.world.state()
            self.world.command(np.asarray(q, float), self._close)
        self._holding = True

    def stop(self) -> None:
        """Nothing to disconnect; the world keeps its state for whoever asks about success."""

    def catch_up(self) -> float:
        """Move the world to the start of the current period; returns that moment on the clock."""
        self.start()
        assert self._start_s is not None
        elapsed_s = self._clock.now() - self._start_s
        periods = math.floor((elapsed_s + _EARLY_S) / self._period_s)
        if periods > self._periods:
            self.world.step((periods - self._periods) * self._period_s)
            self._periods = periods
        return self._start_s + periods * self._period_s
