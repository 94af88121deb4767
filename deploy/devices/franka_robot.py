"""A Franka arm through franky (`pip install -e '.[franka]'`).

Written against franky-control 2.0's documented API and tried against franky-sim, a simulator that
speaks the arm's network protocol; it has not been run on an arm by us. Keep the emergency stop in
your hand, and start with a small `dynamics`.
"""

import importlib
import threading
from collections.abc import Callable
from typing import Any

import numpy as np
from jaxtyping import Float

from ddgrasp import contract
from ddgrasp.errors import UserError
from deploy.devices.options import Setup
from deploy.interfaces import Clock, RobotState

GRIPPER_SPEED_M_S = 0.1
GRASP_ANY_WIDTH_M = contract.GRIPPER_MAX_WIDTH_M
"""franky's outer tolerance: a grasp of any width counts, as in simulation."""
WIDTH_PERIOD_S = 0.03


def make(setup: Setup) -> "FrankaRobot":
    """The configured arm, not connected yet."""
    config = setup.config.deploy.franka
    return FrankaRobot(
        config.host,
        setup.clock,
        dynamics=config.dynamics,
        grip_force_n=config.grip_force_n,
    )


class FrankaRobot:
    """Joint position targets that pre-empt each other: franky replans smoothly from the moving state."""

    def __init__(
        self,
        host: str,
        clock: Clock,
        *,
        dynamics: float = 0.2,
        grip_force_n: float = 20.0,
        realtime: bool = True,
    ):
        """`dynamics` in (0, 1] scales the arm's velocity, acceleration and jerk limits.

        `realtime` insists on a real-time kernel, as a real arm needs; a simulated one does not.
        """
        if not 0.0 < dynamics <= 1.0:
            raise UserError(f"deploy.franka.dynamics is {dynamics}; expected above 0 and at most 1.")
        self._host, self._clock = host, clock
        self._dynamics, self._grip_force_n, self._realtime = dynamics, grip_force_n, realtime
        self._arm: Any = None
        self._hand: _Hand | None = None
        self._holding = False

    def start(self) -> None:
        """Connect to arm and gripper. Raises UserError."""
        franky = self._franky = _franky()
        try:
            kernel = franky.RealtimeConfig.Enforce if self._realtime else franky.RealtimeConfig.Ignore
            arm = franky.Robot(self._host, relative_dynamics_factor=self._dynamics, realtime_config=kernel)
            arm.recover_from_errors()
            self._hand = _Hand(franky.Gripper(self._host), franky.Exception, self._grip_force_n)
        except franky.Exception as error:
            raise UserError(
                f"no Franka at {self._host!r} ({error}): unlock the joints, activate FCI in Desk and check "
                "deploy.franka.host."
            ) from error
        self._arm = arm

    def read_state(self) -> RobotState:
        """Joints as of now; the width as the gripper last reported it. Raises what stopped the gripper."""
        assert self._hand is not None
        q = np.asarray(self._arm.state.q, float)
        return RobotState(q, self._hand.width_m(), self._clock.now())

    def command(self, q_target_rad: Float[np.ndarray, "7"], close: bool) -> None:
        """Set the (7,) joint target, pre-empting the last, and the gripper. Raises what stopped the last."""
        assert self._hand is not None
        joints = [float(q) for q in q_target_rad]
        self._move(self._franky.JointMotion(joints, return_when_finished=False))
        self._holding = False
        self._hand.set(close)

    def hold(self) -> None:
        """Brake as fast as the limits allow, then stay: once, since asking again would restart the stop."""
        if not self._holding:
            self._move(self._franky.JointStopMotion())
        self._holding = True

    def stop(self) -> None:
        """Brake along a planned stop, wait for it, let go of the connection. The gripper keeps its grip."""
        hand, self._hand = self._hand, None
        if hand is not None:
            hand.stop()
        arm, self._arm = self._arm, None
        if arm is None:
            return
        try:
            arm.move(self._franky.JointStopMotion())
        except self._franky.Exception:
            arm.stop()
            raise

    def _move(self, motion: Any) -> None:
        self._arm.poll_motion()  # raises what stopped the last motion (a reflex, a limit)
        self._arm.move(motion, asynchronous=True)


class _Hand:
    """The gripper, asked and told in threads of its own.

    It answers over the network, and a command waits for the end of the one before: both take too
    long for a control period.
    """

    def __init__(self, gripper: Any, error_class: type[Exception], force_n: float):
        self._gripper, self._error_class, self._force_n = gripper, error_class, force_n
        self._width_m = float(gripper.width)
        self._wish: bool | None = None
        self._changed, self._stopping = threading.Event(), threading.Event()
        self._error: Exception | None = None
        for work in (self._watch, self._act):
            threading.Thread(target=self._guard, args=(work,), daemon=True).start()

    def width_m(self) -> float:
        """As the gripper last reported it. Raises what stopped it."""
        if self._error is not None:
            raise self._error
        return self._width_m

    def set(self, close: bool) -> None:
        """Close or open, once the motion under way has ended; the newest wish counts."""
        if close != self._wish:
            self._wish = close
            self._changed.set()

    def stop(self) -> None:
        """End both threads, after what they are at; the gripper keeps its grip."""
        self._stopping.set()
        self._changed.set()

    def _guard(self, work: Callable[[], None]) -> None:
        try:
            while not self._stopping.is_set():
                work()
        except self._error_class as error:
            self._error = error

    def _watch(self) -> None:
        self._width_m = float(self._gripper.width)
        self._stopping.wait(WIDTH_PERIOD_S)

    def _act(self) -> None:
        self._changed.wait()
        self._changed.clear()
        if self._stopping.is_set():
            return
        if self._wish:
            self._gripper.grasp(0.0, GRIPPER_SPEED_M_S, self._force_n, epsilon_outer=GRASP_ANY_WIDTH_M)
        else:
            self._gripper.open(GRIPPER_SPEED_M_S)


def _franky() -> Any:
    try:
        return importlib.import_module("franky")
    except ImportError as error:
        raise UserError(f"robot 'franka' needs franky ({error}): pip install -e '.[franka]'.") from error
