"""A Franka arm through franky (`pip install ddgrasp[franka]`).

Written against franky-control's documented API; it has not been run on an arm by us. Keep the
emergency stop in your hand, and start with a small `dynamics`.
"""

import threading
from typing import Any

import numpy as np

from ddgrasp import contract
from ddgrasp.errors import UserError
from deploy.interfaces import Clock, RobotState

GRIPPER_SPEED_M_S = 0.1
GRASP_ANY_WIDTH_M = contract.GRIPPER_MAX_WIDTH_M
"""franky's outer tolerance: a grasp of any width counts, as in simulation."""
WIDTH_PERIOD_S = 0.03


class FrankaRobot:
    """Joint position targets that pre-empt each other: franky replans smoothly from the moving state."""

    def __init__(self, host: str, clock: Clock, *, dynamics: float = 0.2, grip_force_n: float = 20.0):
        """`dynamics` in (0, 1] scales the arm's velocity, acceleration and jerk limits."""
        if not 0.0 < dynamics <= 1.0:
            raise UserError(f"deploy.franka_dynamics is {dynamics}; expected above 0 and at most 1.")
        self._host, self._clock = host, clock
        self._dynamics, self._grip_force_n = dynamics, grip_force_n
        self._arm: Any = None
        self._gripper: Any = None
        self._gripper_motion: Any = None
        self._closed: bool | None = None
        self._holding = False
        self._width_m = float("nan")
        self._watcher: threading.Thread | None = None
        self._watching = threading.Event()

    def start(self) -> None:
        """Connect to arm and gripper. Raises UserError."""
        franky = self._franky = _franky()
        try:
            arm = franky.Robot(self._host, relative_dynamics_factor=self._dynamics)
            arm.recover_from_errors()
            self._gripper = franky.Gripper(self._host)
            self._width_m = float(self._gripper.width)
        except franky.Exception as error:
            raise UserError(
                f"no Franka at {self._host!r} ({error}): unlock the joints, activate FCI in Desk and check "
                "deploy.franka_host."
            ) from error
        self._arm = arm
        self._watching.set()
        self._watcher = threading.Thread(target=self._watch_width, daemon=True)
        self._watcher.start()

    def read_state(self) -> RobotState:
        """Joints as of now; the width as the gripper last reported it (NaN once it is lost)."""
        q = np.asarray(self._arm.state.q, float)
        return RobotState(q, self._width_m, self._clock.now())

    def command(self, q_target_rad: np.ndarray, close: bool) -> None:
        joints = [float(q) for q in q_target_rad]
        self._move(self._franky.JointMotion(joints, return_when_finished=False))
        self._holding = False
        self._set_gripper(close)

    def hold(self) -> None:
        """Brake as fast as the limits allow, then stay: once, since asking again would restart the stop."""
        if not self._holding:
            self._move(self._franky.JointStopMotion())
        self._holding = True

    def stop(self) -> None:
        """Brake along a planned stop, wait for it, let go of the connection. The gripper keeps its grip."""
        self._watching.clear()
        if self._watcher is not None:
            self._watcher.join(timeout=1.0)
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

    def _set_gripper(self, close: bool) -> None:
        """Start closing or opening when the wish changes; the hand takes about half a second."""
        if close == self._closed:
            return
        self._closed = close
        if close:
            self._gripper_motion = self._gripper.grasp_async(
                0.0, GRIPPER_SPEED_M_S, self._grip_force_n, epsilon_outer=GRASP_ANY_WIDTH_M
            )
        else:
            self._gripper_motion = self._gripper.open_async(GRIPPER_SPEED_M_S)

    def _watch_width(self) -> None:
        # The gripper answers over the network, too slowly to be asked inside a control period.
        pause = threading.Event()
        while self._watching.is_set():
            try:
                self._width_m = float(self._gripper.width)
            except self._franky.Exception:
                self._width_m = float("nan")
            pause.wait(WIDTH_PERIOD_S)


def _franky() -> Any:
    try:
        import franky
    except ImportError as error:
        raise UserError(f"robot 'franka' needs franky ({error}): pip install 'ddgrasp[franka]'.") from error
    return franky
