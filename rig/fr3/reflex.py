"""What the control unit of an FR3 does by itself: watch contact and limits, stop the arm, refuse until reset.

franky-sim answers the protocol but says of itself that it enforces no limits and produces no control errors:
it takes collision thresholds and error recovery and does nothing with them. This adds both to its server.
Error numbers: `research_interface::robot::Error` of Franka's published protocol headers (libfranka-common).
"""

import select
import socket
from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from franky_sim import FrankaRobotServer
from franky_sim import franka_robot_protocol as protocol
from franky_sim.base_simulator import BaseRobot
from franky_sim.franka_gripper_protocol import GripperCommandStatus
from franky_sim.franka_gripper_server import FrankaGripperServer
from franky_sim.franka_robot_state import FrankaRobotState
from franky_sim.franka_server import BaseCommand
from jaxtyping import Float

from ddgrasp import contract
from rig.fr3.strays import Guarded, check_numbers

JOINT_REFLEX, CARTESIAN_REFLEX = 6, 7
GENERATOR_POSITION_LIMITS = 12
"""joint_motion_generator_position_limits_violation."""
_ERRORS = 41
FILTER_SHARE = 0.05
"""Share of the newest millisecond in the contact torque that is compared: a time constant of 20 ms."""
_CONTACTS = (
    mujoco.mjtConstraint.mjCNSTR_CONTACT_FRICTIONLESS,
    mujoco.mjtConstraint.mjCNSTR_CONTACT_PYRAMIDAL,
    mujoco.mjtConstraint.mjCNSTR_CONTACT_ELLIPTIC,
)


@dataclass(frozen=True)
class Thresholds:
    """Above the upper ones the arm stops, above the lower ones it says that it touches something.

    As `setCollisionBehavior` sets them (nominal).
    """

    torque_nm: tuple[float, ...] = (20.0,) * 7
    force_n: tuple[float, ...] = (30.0,) * 6
    lower_torque_nm: tuple[float, ...] = (20.0,) * 7
    lower_force_n: tuple[float, ...] = (30.0,) * 6


class ReflexServer(Guarded, FrankaRobotServer):
    """franky-sim's robot server with reflexes.

    Reaches into franky-sim 1.0.4 in the three places named `_Franka...` below: the extra pins that version.
    """

    def __init__(self, robot: BaseRobot, hostnames: list[str]):
        self._arm = robot
        super().__init__(robot, hostnames)
        commands = self._FrankaServer__command_class_map  # type: ignore[attr-defined]
        commands[protocol.RobotCommand.kSetCollisionBehavior] = _SetCollisionBehavior
        commands[protocol.RobotCommand.kAutomaticErrorRecovery] = _Recover
        check_numbers(commands)
        self.thresholds = Thresholds()
        self.error: int | None = None
        """The number of the error that stopped the arm, None if it may move."""
        self._torque_nm, self._force_n = np.zeros(7), np.zeros(6)

    def _bind_children(self, hostname: str) -> None:
        gripper = GripperServer(self._arm, hostname)
        gripper.init()
        self._FrankaRobotServer__gripper_server = gripper

    def start_motion(
        self,
        controller_mode: protocol.MoveCommandControllerMode,
        motion_generator_mode: protocol.MoveCommandMotionGeneratorMode,
        motion_id: int,
    ) -> None:
        """See franky-sim; refused while an error stands."""
        if self.error is not None:
            raise RuntimeError(f"error {self.error} stands: automatic error recovery first")
        super().start_motion(controller_mode, motion_generator_mode, motion_id)

    def watch(self, model: mujoco.MjModel, data: mujoco.MjData) -> None:
        """Once per tick: stops the arm if what it touches or is told goes beyond the limits."""
        self._torque_nm += FILTER_SHARE * (contact_torque(model, data) - self._torque_nm)
        self._force_n = hand_force(model, data, self._torque_nm)
        if self.error is None and self.current_motion_id and (error := self._exceeded()) is not None:
            self._stop(error)

    def recover(self) -> None:
        """Automatic error recovery: the arm may be moved again. What presses on still stops it again."""
        self.error = None
        self._torque_nm[:], self._force_n[:] = 0.0, 0.0

    def hold(self) -> None:
        """One tick at the joints where it was last told to stand."""
        self._post_process_commands()

    @property
    def robot_state(self) -> FrankaRobotState:
        """See franky-sim; with what the arm touches and the error that stands.

        External torques and forces with the sign of Franka's `RobotState`: what the arm does to others.
        """
        thresholds = self.thresholds
        state = super().robot_state.replace(
            tau_ext_hat_filtered=tuple((-self._torque_nm).tolist()),
            O_F_ext_hat_K=tuple((-self._force_n).tolist()),
            joint_contact=_above(self._torque_nm, thresholds.lower_torque_nm),
            cartesian_contact=_above(self._force_n, thresholds.lower_force_n),
        )
        if self.error is None:
            return state
        flags = tuple(index == self.error for index in range(_ERRORS))
        return state.replace(robot_mode=protocol.RobotMode.kReflex, errors=flags, reflex_reason=flags)

    def wait_for_command(self, seconds: float) -> None:
        """Wait until a moving client has answered the last state, at most `seconds`.

        Client and server share a machine: without this a client that gets no time would leave gaps in its
        own motion that no arm's control unit would take.
        """
        udp = self._FrankaServer__udp_socket  # type: ignore[attr-defined]
        if self.current_motion_id and udp is not None:
            select.select([udp], [], [], seconds)

    def _exceeded(self) -> int | None:
        command = self._FrankaRobotServer__current_control_command  # type: ignore[attr-defined]
        target, state = np.array(command.q_c), self._arm.inner_state
        if (target.any() and _beyond(target)) or _beyond(_standstill(state.q, state.dq)):
            return GENERATOR_POSITION_LIMITS
        if np.any(np.abs(self._torque_nm) > self.thresholds.torque_nm):
            return JOINT_REFLEX
        return CARTESIAN_REFLEX if np.any(np.abs(self._force_n) > self.thresholds.force_n) else None

    def _stop(self, error: int) -> None:
        """Hold the measured joints and tell the client why its motion ended."""
        motion = self.current_motion_id
        self.stop_motion(send_preemption_signal=False)
        self._FrankaRobotServer__holding_q = tuple(self._arm.inner_state.q)  # type: ignore[attr-defined]
        self.error = error
        self.send_state()  # the client looks for the reason in the state that comes before the answer
        status, client = protocol.MoveStatus.kReflexAborted, self._tcp_socket
        if client is not None:  # it was dropped if its state did not reach it
            BaseCommand.send_response(client, protocol.RobotCommand.kMove, motion, status)
        self.reset_current_motion_id()


class GripperServer(Guarded, FrankaGripperServer):
    """franky-sim's gripper, which answers the command that a stop aborts: its caller would wait for ever."""

    def __init__(self, robot: BaseRobot, hostname: str):
        super().__init__(robot, hostname)
        check_numbers(self._FrankaServer__command_class_map)  # type: ignore[attr-defined]

    def stop(self, command_id: int, tcp_socket: socket.socket) -> None:
        """See franky-sim."""
        if self._pending_command_id is not None:
            assert self._pending_tcp_socket is not None and self._pending_command_type is not None
            BaseCommand.send_response(
                self._pending_tcp_socket,
                self._pending_command_type,
                self._pending_command_id,
                GripperCommandStatus.kAborted,
                command_type_struct="H",
                status_type_struct="H",
            )
        super().stop(command_id, tcp_socket)


class _SetCollisionBehavior(protocol.SetCollisionBehaviorCommand):
    def handle(self, server: ReflexServer) -> None:
        server.thresholds = Thresholds(
            tuple(self.upper_torque_thresholds_nominal),
            tuple(self.upper_force_thresholds_nominal),
            tuple(self.lower_torque_thresholds_nominal),
            tuple(self.lower_force_thresholds_nominal),
        )
        self.reply(0)


class _Recover(protocol.AutomaticErrorRecoveryCommand):
    def handle(self, server: ReflexServer) -> None:
        server.recover()
        self.reply(protocol.AutomaticErrorRecoveryStatus.kSuccess)


def _standstill(q_rad: Sequence[float], speed_rad_s: Sequence[float]) -> Float[np.ndarray, "7"]:
    """(7,) where the joints stand after braking as hard as they may: q + v |v| / 2a."""
    speed = np.array(speed_rad_s)
    return np.array(q_rad) + speed * np.abs(speed) / (2.0 * np.array(contract.FR3.joint_acceleration_rad_s2))


def _above(values: np.ndarray, thresholds: Sequence[float]) -> tuple[float, ...]:
    """1 where the magnitude is above its threshold, else 0."""
    return tuple((np.abs(values) > thresholds).astype(float).tolist())


def _beyond(q_rad: Float[np.ndarray, "7"]) -> bool:
    return bool(np.any((q_rad < contract.FR3.joint_lower_rad) | (q_rad > contract.FR3.joint_upper_rad)))


def contact_torque(model: mujoco.MjModel, data: mujoco.MjData) -> Float[np.ndarray, "7"]:
    """(7,) N m that contacts exert on the arm's joints (J^T f of the contact rows alone)."""
    torque = np.zeros(model.nv)
    if data.ncon:
        force = np.where(np.isin(data.efc_type, _CONTACTS), data.efc_force, 0.0)
        mujoco.mj_mulJacTVec(model, data, torque, force)
    return torque[:7]


def hand_force(
    model: mujoco.MjModel, data: mujoco.MjData, torque_nm: Float[np.ndarray, "7"]
) -> Float[np.ndarray, "6"]:
    """(6,) force (N) and torque (N m) at the hand, world axes, that would exert `torque_nm` on the joints."""
    jacobian = np.zeros((6, model.nv))
    body = model.body("robot0_hand").id
    mujoco.mj_jac(model, data, jacobian[:3], jacobian[3:], data.xpos[body], body)
    return np.linalg.lstsq(jacobian[:, :7].T, torque_nm, rcond=0.05)[0]
