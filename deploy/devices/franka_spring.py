"""A Franka arm that follows like the one in training, and gives way to what it touches.

franky's joint impedance controller, on this machine at 1 kHz: torque = K (q_ref - q) + D (v_ref - v). A stiff
arm told to be somewhere else every 0.1 s either never gets there, since every plan ends at rest, or presses
with hundreds of newtons on what it lands on; docs/hardware.md has both in numbers.
"""

import contextlib
import os
import threading
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
from jaxtyping import Float

from ddgrasp import contract

WEIGHTS = np.array((1.0, 1.0, 1.0, 1.0, 0.4, 0.4, 0.4))
"""Stiffness of the joints relative to the first: the wrist's carry less."""
DAMPING_S = 0.15
"""Damping over stiffness. Chosen on the FR3 rig so that a step is made within its period as in training."""
SOFT = 1.0 / 3.0
"""Share of stiffness and damping of an arm that may land on something. What a hand that is stopped presses
with is what was to carry it on, (DAMPING_S + half a period) * stiffness * speed of every joint: in proportion
to the stiffness, and at the hand the more the nearer it is to the base, with the square of the distance."""
FRICTION_NM = 1.2 * WEIGHTS
"""At most this is added to a joint that does not make its steps. The first four joints of an FR3 stick with
1.1 N m (franky-sim's model of it), with which a soft arm makes 0.45 of steps of 0.007 rad."""
MOST_OWED_RAD = FRICTION_NM / (400.0 * WEIGHTS * SOFT * (1.0 + DAMPING_S / contract.CONTROL_DT_S))
"""(7,) at most this, 3.6 mrad at 0.036 rad/s, is added whatever the stiffness: what `FRICTION_NM` comes to
on a soft arm of the default one. It is added to what the safety filter let pass."""
LATE = 1.5
"""Control periods for which a joint keeps its speed if no command follows; then it brakes."""
STANDS_RAD_S = 0.02
"""No joint faster: the arm stands, as franky's `TorqueStopMotion` has it."""
BRAKES_S = 1.0
"""At most so long, by the arm's clock, `FrankaSpring.stop` has the spring brake the arm."""
LETS_GO_S = (0.05, 0.2)
"""Within the first its torque goes; after the second at the latest the control unit holds the arm."""
_LOOK_S = 0.01


@contextlib.contextmanager
def priority_kept() -> Iterator[None]:
    """This thread's scheduling stays what it is, on Linux.

    libfranka gives a thread that connects or controls the highest real-time priority where it may, for good:
    every thread started from there has it as well, and what computes keeps the machine from all others.
    """
    if not hasattr(os, "sched_setscheduler"):
        yield
        return
    policy, parameters = os.sched_getscheduler(0), os.sched_getparam(0)
    try:
        yield
    finally:
        os.sched_setscheduler(0, policy, parameters)


class FrankaSpring:
    """Runs from its making until `stop`; what ends it in between, `poll_motion` of the arm raises."""

    def __init__(self, franky: Any, arm: Any, stiffness_nm_rad: float):
        """`arm` is a franky.Robot without a motion."""
        self._franky: Any = franky
        self._arm: Any = arm
        self._stiffness = stiffness_nm_rad * WEIGHTS
        self._motion: Any = franky.JointImpedanceTrackingMotion(
            stiffness=self._stiffness, damping=DAMPING_S * self._stiffness
        )
        self._soft, self._heeds = False, True
        self._lock, self._ended = threading.Lock(), threading.Event()
        self._due_s: float | None = None
        self._target_rad: np.ndarray | None = None
        self._owed_rad = np.zeros(len(contract.ARM_JOINTS))
        self._met, self._felt_nm = "", np.zeros(len(contract.ARM_JOINTS))
        self.stay()
        arm.move(self._motion, asynchronous=True)
        self._watch = threading.Thread(target=self._brake_in_time, daemon=True)
        self._watch.start()

    def follow(self, q_target_rad: Float[np.ndarray, "7"], soft: bool = False, heeds: bool = True) -> None:
        """Make the step to (7,) `q_target_rad` within a control period.

        `soft`: with `SOFT` of the strength; `heeds`: gives way to what it touches, short of stopping itself.
        At the step's speed, about its middle: over the period the spring's pull is zero on average. What
        joints lacked of the steps before, within `FRICTION_NM` and `MOST_OWED_RAD`, is added. A soft arm that
        touches something already makes no step that heeds it: it would press with the step's pull on top.
        """
        state = self._arm.state
        q_rad = np.asarray(state.q)
        step = q_target_rad - q_rad
        with self._lock:
            self._be(soft)
            self._feel(state)
            if soft and heeds and (met := touched(state)):
                self._give_way(state, met)
                return
            self._due_s, self._heeds = state.time.to_sec() + LATE * contract.CONTROL_DT_S, heeds
            owed = self._owe(q_rad, step)
            self._set(q_rad + step / 2 + owed, (step + owed) / contract.CONTROL_DT_S)
            self._target_rad = q_target_rad

    def stay(self) -> None:
        """Brake, and hold where the arm is now, with all of its strength."""
        with self._lock:
            self._brake(self._arm.state)

    def felt(self) -> tuple[str, Float[np.ndarray, "7"]]:
        """What the arm gave way to since the last call, in words, empty if to nothing; and the (7,) torques
        on its joints by what pressed on it hardest."""
        with self._lock:
            felt = self._met, self._felt_nm
            self._met, self._felt_nm = "", np.zeros(len(contract.ARM_JOINTS))
        return felt

    def stop(self) -> None:
        """Brake, and return when the arm stands; its own control unit holds it then.

        A motion of torques ends in damping alone, in which a hand sinks with what it carries and the arm does
        not know of: with the library's values 38 cm in two seconds by 1 kg (FR3 rig). So the spring brakes,
        and what follows is as short as may be and as strong as the spring's own damping.
        """
        self.stay()
        self._wait_until_it_stands()
        arm = self.release()
        ramp_s, longest_s = LETS_GO_S
        with priority_kept():
            arm.move(
                self._franky.TorqueStopMotion(
                    damping=DAMPING_S * self._stiffness, ramp_duration=ramp_s, max_duration=longest_s,
                    velocity_epsilon=STANDS_RAD_S,
                )
            )  # fmt: skip

    def release(self) -> Any:
        """Let go of the arm, which is returned: a connection ends when nobody has it any more."""
        self._ended.set()
        self._watch.join()
        arm, self._arm, self._motion = self._arm, None, None
        return arm

    def _wait_until_it_stands(self) -> None:
        """For `BRAKES_S` at most: somebody may push it."""
        state = self._arm.state
        end_s = state.time.to_sec() + BRAKES_S
        while np.abs(state.dq).max() > STANDS_RAD_S and state.time.to_sec() < end_s:
            time.sleep(_LOOK_S)
            state = self._arm.state

    def _be(self, soft: bool) -> None:
        """The controller comes to the new gains by itself, with a time constant of 0.1 s."""
        if soft != self._soft:
            self._soft = soft
            gains = self._franky.JointImpedanceGains(self._strength(), DAMPING_S * self._strength())
            self._motion.set_gains(gains)

    def _feel(self, state: Any) -> None:
        """What it does to others is what libfranka's external torques say (Franka's documentation of
        `RobotState`), and so with the other sign what is done to it."""
        torque_nm = -np.asarray(state.tau_ext_hat_filtered, float)
        hardest_nm = np.linalg.norm(self._felt_nm)
        if np.isfinite(hardest_nm) and not np.linalg.norm(torque_nm) <= hardest_nm:  # no number is told, too
            self._felt_nm = torque_nm

    def _give_way(self, state: Any, met: str) -> None:
        """Stand, as soft as it came."""
        self._stay(state)
        self._met = met

    def _brake(self, state: Any) -> None:
        """Stand with all of its strength."""
        self._be(soft=False)
        self._stay(state)

    def _owe(self, q_rad: Float[np.ndarray, "7"], step: Float[np.ndarray, "7"]) -> Float[np.ndarray, "7"]:
        """(7,) what is left of the steps before the joints at `q_rad`; nothing of it against `step`."""
        if self._target_rad is not None:
            pull_nm_rad = self._strength() * (1.0 + DAMPING_S / contract.CONTROL_DT_S)
            most = np.minimum(FRICTION_NM / pull_nm_rad, MOST_OWED_RAD)
            self._owed_rad = np.clip(self._owed_rad + self._target_rad - q_rad, -most, most)
        self._owed_rad = np.where(self._owed_rad * step > 0.0, self._owed_rad, 0.0)
        return self._owed_rad

    def _strength(self) -> Float[np.ndarray, "7"]:
        return self._stiffness * (SOFT if self._soft else 1.0)

    def _stay(self, state: Any) -> None:
        self._due_s, self._target_rad = None, None
        self._owed_rad = np.zeros(len(contract.ARM_JOINTS))
        self._set(np.asarray(state.q), np.zeros(len(contract.ARM_JOINTS)))

    def _set(self, q_rad: Float[np.ndarray, "7"], speed_rad_s: Float[np.ndarray, "7"]) -> None:
        self._motion.set_reference(self._franky.JointReference(q_rad, speed_rad_s))

    def _brake_in_time(self) -> None:
        """When the next command is late, or the control unit says that the arm presses on something.

        In a thread of its own, by the arm's clock: whoever sends commands may hang, and the next comes only
        after a period in which the arm presses on.
        """
        while not self._ended.wait(_LOOK_S):
            try:
                state = self._arm.state
            except (self._franky.Exception, RuntimeError):
                return  # the connection has gone, and the arm with it stands
            with self._lock:
                self._feel(state)
                if self._due_s is None:
                    continue
                met = touched(state) if self._heeds else ""
                if met:
                    self._give_way(state, met)
                elif state.time.to_sec() > self._due_s:
                    self._brake(state)


def touched(state: Any) -> str:
    """What the arm feels where its control unit sees a contact (the lower thresholds); empty elsewhere."""
    if not (np.any(state.joint_contact) or np.any(state.cartesian_contact)):
        return ""
    force_n, turn_nm = map(np.linalg.norm, np.split(np.asarray(state.O_F_ext_hat_K), 2))
    torque_nm = np.abs(np.asarray(state.tau_ext_hat_filtered))
    joint = int(torque_nm.argmax())
    hand = f"{force_n:.0f} N and {turn_nm:.0f} N m at the hand"
    return f"{hand}, {torque_nm[joint]:.0f} N m on joint {joint + 1}"
