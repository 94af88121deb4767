"""A Franka arm through franky (`pip install 'ddgrasp[franka]'`).

Written against franky-control 2.0 and tested against franky-sim, which speaks the arm's network protocol
(rig/fr3); it has not been run on an arm by us. docs/hardware.md says how to begin. Keep the
stop in your hand.
"""

import contextlib
import importlib
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from jaxtyping import Float

from ddgrasp import contract
from ddgrasp.config.deploy import FrankaConfig
from ddgrasp.contract import HOME_RAD
from ddgrasp.errors import Trouble, UserError
from ddgrasp.install import pip_install
from deploy import kinematics
from deploy.devices import franka_faults
from deploy.devices.franka_hand import FrankaHand, HandError
from deploy.devices.franka_probe import check_arm, check_hand
from deploy.devices.franka_spring import FrankaSpring, priority_kept, touched
from deploy.devices.options import Setup
from deploy.interfaces import Clock, RobotError, RobotState

AT_START_RAD = 0.01
"""No joint further than this from the start pose: the arm is there."""
START_S = 120.0
"""Longest wait for the start pose, of the arm's time, beside twice what the way takes."""
HOMING_S = 60.0
"""Longest wait, on this machine's clock; a hand takes some five seconds, a slow rig more."""
RISE_M = 0.002
"""A hand goes up that is to be higher by more, in a control step: away from what it pressed on."""
LOST = "the connection to"
"""How a fault begins that is the network's."""
RECOVERY_S = 0.5
"""Until the arm's state says that an error is gone."""
_POLL_S = 0.01


def make(setup: Setup) -> "FrankaRobot":
    """The configured arm, not connected yet."""
    confirm = None if setup.options.dry_run else setup.confirm
    return FrankaRobot(setup.config.deploy.franka, setup.clock, confirm, setup.say)


class FrankaRobot:
    """Joint targets that a compliant arm follows (`deploy.devices.franka_spring`)."""

    def __init__(
        self,
        config: FrankaConfig,
        clock: Clock,
        confirm: Callable[[str], None] | None,
        say: Callable[[str], None] = lambda text: None,
    ):
        """`confirm` is called with a question before anything moves, and raises UserError if the answer is
        no; without it `start` moves nothing. `say` is told what `start` does."""
        self._config, self._clock = config, clock
        self._confirm, self._say = confirm, say
        self._limits = contract.ARMS[config.model]
        self._arm: Any = None
        self._hand: FrankaHand | None = None
        self._following: FrankaSpring | None = None
        self._errors: tuple[type[Exception], ...] = ()
        self._lost_by: tuple[type[Exception], ...] = ()
        self._holding = self._moved = self._faulted = self._cut_off = self._hand_lost = False

    def start(self) -> None:
        """Connect, check which arm answers, clear its errors, set its limits, then move it to the start pose.

        Raises UserError.
        """
        franky = self._franky = load_franky()
        check_arm(self._config.host, self._config.model)
        # A socket that breaks comes through libfranka as a bare RuntimeError ("Net Exception").
        self._errors = (franky.Exception, RuntimeError)
        self._lost_by = (franky.NetworkException, RuntimeError)
        self._holding = self._moved = self._faulted = self._cut_off = self._hand_lost = False
        config = self._config
        realtime = franky.RealtimeConfig
        kernel = realtime.Enforce if config.kernel == "realtime" else realtime.Ignore
        try:
            with priority_kept():
                self._arm = franky.Robot(
                    config.host, relative_dynamics_factor=config.dynamics, realtime_config=kernel
                )
            self._prepare()
            gripper = self._gripper()
            if self._confirm is not None:
                self._go_to_start(gripper)
            self._hand = FrankaHand(gripper, self._errors, config.grip_force_n)
        except HandError as error:
            way = "on the way to the start pose " if self._moved else ""
            raise Trouble(f"{way}{self._hand_fault(error)}.") from error
        except self._errors as error:
            if self._moved:
                raise Trouble(f"on the way to the start pose {self._fault(error)}.") from error
            raise UserError(franka_faults.no_connection(franky, config.host, config.model, error)) from error

    def read_state(self) -> RobotState:
        """Joints as of now; the width as the gripper last reported it. Raises RobotError."""
        assert self._hand is not None
        with self._reporting():
            self._arm.poll_motion()  # raises what stopped the last motion (a reflex, a limit)
            met, felt_nm = ("", None) if self._following is None else self._following.felt()
            q_rad = np.asarray(self._arm.state.q, float)
            return RobotState(q_rad, self._hand.width_m(), self._clock.now(), met, felt_nm)

    def command(self, q_target_rad: Float[np.ndarray, "7"], close: bool) -> None:
        """Set the (7,) joint target, in place of the last, and the gripper. Raises RobotError."""
        assert self._hand is not None
        with self._reporting():
            self._arm.poll_motion()
            rises, lands = self._way(q_target_rad)
            self._spring().follow(q_target_rad, soft=lands, heeds=not rises)
            self._hand.set(close)
        self._holding = False

    def hold(self) -> None:
        """Brake and stay where the arm is now: asked again it stays there.

        Raises RobotError.
        """
        if not self._holding and self._moved and not self._faulted:
            with self._reporting():
                self._arm.poll_motion()
                self._spring().stay()
        self._holding = True

    def stop(self) -> None:
        """Brake, wait until the arm stands, let go of the connection. The gripper keeps its grip.

        Raises RobotError if the arm did not stop by itself before and cannot be told to.
        """
        hand, self._hand = self._hand, None
        try:
            if self._arm is not None and self._moved and not self._faulted:
                with self._reporting():
                    if self._following is not None:
                        self._following.stop()
                    else:  # on the way to the start pose
                        self._arm.stop()
        finally:
            if self._following is not None:
                self._following.release()
            self._arm = self._following = None
            if hand is not None:
                hand.stop(connected=not (self._cut_off or self._hand_lost))

    def time_s(self) -> float | None:
        """See TimedRobot: the arm's own clock; None once the arm has failed."""
        if self._arm is None or self._faulted:
            return None
        with self._reporting():
            return float(self._arm.state.time.to_sec())

    def _prepare(self) -> None:
        """Errors cleared, contact thresholds, load, and no limit above the arm's own. UserError."""
        arm, config = self._arm, self._config
        if arm.state.robot_mode == self._franky.RobotMode.UserStopped:
            raise UserError(
                f"the arm at {config.host!r} is stopped by a person: release the stop, try again."
            )
        stood = franka_faults.names(RuntimeError(repr(arm.state.current_errors)))
        if not self._recover():
            raise UserError(
                f"the arm at {config.host!r} does not recover from {', '.join(stood) or 'its error'}: "
                "look at it, clear the error in Desk, try again."
            )
        if stood:
            self._say(f"recovered from {', '.join(stood)}")
        arm.set_collision_behavior(
            lower_torque_threshold=config.give_way * config.contact_torque_nm,
            upper_torque_threshold=config.contact_torque_nm,
            lower_force_threshold=config.give_way * config.contact_force_n,
            upper_force_threshold=config.contact_force_n,
        )
        arm.set_load(config.load_kg, [0.0, 0.0, kinematics.GRIP_D_M], [0.0] * 9)
        if felt := touched(arm.state):
            self._say(
                f"the arm feels {felt} before it moves: does it touch something, or carry what it does "
                "not know of (deploy.franka.load_kg, the hand in Desk)?"
            )
        for limit, own in (
            (arm.joint_velocity_limit, self._limits.joint_velocity_rad_s),
            (arm.joint_acceleration_limit, self._limits.joint_acceleration_rad_s2),
        ):
            limit.set(np.minimum(limit.get(), own))

    def _gripper(self) -> Any:
        """The hand's connection. Raises UserError: the arm has answered by now, so it is the hand's alone."""
        try:
            check_hand(self._config.host)
            return self._franky.Gripper(self._config.host)
        except (OSError, *self._errors) as error:
            raise UserError(franka_faults.no_gripper(self._config.host, error)) from error

    def _go_to_start(self, gripper: Any) -> None:
        """Gripper homed and open, the arm at the start pose; a person is asked before either moves."""
        assert self._confirm is not None
        speed = min(self._config.start_dynamics, self._config.dynamics)
        self._confirm(
            f"The {self._limits.name} at {self._config.host} will home its gripper, which drops what it "
            f"holds, and move to the start pose ({self._away_rad():.2f} rad away) at "
            f"{100 * speed:.2g} % of its speed. Is the way clear?"
        )
        self._moved = True
        self._say("homing the gripper")
        self._home(gripper)
        away_rad = self._away_rad()  # it may have been led elsewhere meanwhile
        if away_rad > AT_START_RAD:
            self._say("moving to the start pose")
            slower = speed / self._config.dynamics
            self._arm.move(self._to(np.array(HOME_RAD), relative_dynamics_factor=slower), asynchronous=True)
            self._wait_at_start(START_S + 2.0 * away_rad / (speed * min(self._limits.joint_velocity_rad_s)))

    def _away_rad(self) -> float:
        """From the start pose, the joint that is furthest."""
        return float(np.max(np.abs(np.asarray(self._arm.state.q) - HOME_RAD)))

    def _home(self, gripper: Any) -> None:
        """Homed and open: where homing leaves the fingers is the hand's affair. Raises HandError."""
        self._awaited(gripper, "homing", gripper.homing_async)
        self._awaited(gripper, "opening", lambda: gripper.open_async(contract.GRIPPER_SPEED_M_S))

    def _awaited(self, gripper: Any, what: str, begin: Callable[[], Any]) -> None:
        """Raises HandError."""
        try:
            command, end_s = begin(), time.monotonic() + HOMING_S
            try:
                while not command.wait(_POLL_S):  # in parts, so that Ctrl-C is heard
                    if time.monotonic() > end_s:
                        raise HandError(f"{what} did not end in {HOMING_S:g} s: see what holds its fingers")
            except (HandError, KeyboardInterrupt):
                gripper.stop()
                raise
            succeeded = command.get()
        except self._errors as error:
            raise HandError(str(error)) from error
        if not succeeded:
            raise HandError(f"{what} failed: take away what is between its fingers, try again")

    def _wait_at_start(self, longest_s: float) -> None:
        """Until the joints are there. Raises UserError if they are not in so much of the arm's time."""
        begun_s = self._arm.state.time.to_sec()
        while True:
            self._arm.poll_motion()
            state = self._arm.state
            if self._away_rad() <= AT_START_RAD:
                self._arm.join_motion()  # what follows is of another kind, and must not cut it short
                return
            if state.time.to_sec() - begun_s > longest_s:
                waited = f"the arm is not at its start pose after {longest_s:.0f} s"
                raise Trouble(f"{waited}: see what holds it.")
            time.sleep(_POLL_S)

    def _to(self, q_target_rad: Float[np.ndarray, "7"], **options: Any) -> Any:
        return self._franky.JointMotion([float(q) for q in q_target_rad], **options)

    def _way(self, q_target_rad: Float[np.ndarray, "7"]) -> tuple[bool, bool]:
        """Whether the hand goes up, and whether it may land on something: where the safety filter has it come
        down slowly, unless it goes up."""
        here_m, there_m = (
            float(kinematics.grip_position(np.asarray(q))[2]) for q in (self._arm.state.q, q_target_rad)
        )
        rises = there_m > here_m + RISE_M
        return rises, not rises and there_m < self._config.approach_below_m

    def _spring(self) -> FrankaSpring:
        if self._following is None:
            self._following = FrankaSpring(self._franky, self._arm, self._config.stiffness_nm_rad)
            self._moved = True
        return self._following

    @contextlib.contextmanager
    def _reporting(self):
        try:
            yield
        except HandError as error:  # the arm goes on, and can be told to brake
            raise RobotError(self._hand_fault(error)) from error
        except self._errors as error:
            raise RobotError(self._fault(error)) from error

    def _hand_fault(self, error: HandError) -> str:
        said = franka_faults.one_line(error)
        self._hand_lost = isinstance(error.__cause__, self._lost_by)
        if self._hand_lost:
            return f"{LOST} {self._config.host} is lost (the gripper's: {said})"
        return f"the gripper failed: {said}"

    def _fault(self, error: Exception) -> str:
        """What happened and how the arm stands now, in one line; it is not told to move again."""
        self._faulted = True
        if isinstance(error, self._lost_by):
            return self._lost(error)
        try:
            recovered = self._recover()
        except self._lost_by:
            return self._lost(error)
        except self._errors as trouble:
            return f"{franka_faults.describe(error)}; no recovery: {franka_faults.one_line(trouble)}"
        after = "recovered, the arm stands" if recovered else "not recovered: look at it and clear it in Desk"
        return f"the arm stopped itself: {franka_faults.describe(error)}; {after}"

    def _recover(self) -> bool:
        """Whether the arm is free of errors after automatic error recovery."""
        if not self._arm.recover_from_errors():
            time.sleep(RECOVERY_S)  # the state it looked at may be older than the recovery
        return not self._arm.has_errors

    def _lost(self, error: Exception) -> str:
        self._cut_off = True
        said = franka_faults.one_line(error)
        return f"{LOST} {self._config.host} is lost ({said}): the arm stands by itself"


def load_franky() -> Any:
    """The library. Raises UserError with the remedy where it is absent."""
    try:
        return importlib.import_module("franky")
    except ImportError as error:
        raise UserError(f"robot 'franka' needs franky ({error}): {pip_install('franka')}.") from error
