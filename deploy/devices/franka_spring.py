"""A Franka arm that follows like the one in training, and gives way to what it touches.

franky's joint impedance controller, on this machine at 1 kHz: torque = K (q_ref - q) + D (v_ref - v). A stiff
arm told to be somewhere else every 0.1 s either never gets there, since every plan ends at rest, or presses
with hundreds of newtons on what it lands on; docs/hardware.md has both in numbers.
"""

import contextlib
import os
import threading
from collections.abc import Iterator
from typing import Any

import numpy as np
from jaxtyping import Float

from ddgrasp import contract

WEIGHTS = np.array((1.0, 1.0, 1.0, 1.0, 0.4, 0.4, 0.4))
"""Stiffness of the joints relative to the first: the wrist's carry less."""
DAMPING_S = 0.15
"""Damping over stiffness. Chosen on the FR3 rig so that a step is made within its period as in training."""
LATE = 1.5
"""Control periods for which a joint keeps its speed if no command follows; then it brakes."""
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
        stiffness = stiffness_nm_rad * WEIGHTS
        self._motion: Any = franky.JointImpedanceTrackingMotion(
            stiffness=stiffness, damping=DAMPING_S * stiffness
        )
        self._lock, self._ended = threading.Lock(), threading.Event()
        self._due_s: float | None = None
        self.stay()
        arm.move(self._motion, asynchronous=True)
        self._watch = threading.Thread(target=self._brake_when_late, daemon=True)
        self._watch.start()

    def follow(self, q_target_rad: Float[np.ndarray, "7"]) -> None:
        """Make the step to (7,) `q_target_rad` within a control period.

        At the step's speed, about its middle: over the period the spring's pull is zero on average.
        """
        state = self._arm.state
        step = q_target_rad - np.asarray(state.q)
        with self._lock:
            self._due_s = state.time.to_sec() + LATE * contract.CONTROL_DT_S
            self._set(np.asarray(state.q) + step / 2, step / contract.CONTROL_DT_S)

    def stay(self) -> None:
        """Brake, and hold where the arm is now."""
        with self._lock:
            self._stay()
            self._due_s = None

    def stop(self) -> None:
        """Brake, and return when the arm stands; its own control unit holds it then."""
        arm = self.release()
        with priority_kept():
            arm.move(self._franky.TorqueStopMotion())

    def release(self) -> Any:
        """Let go of the arm, which is returned: a connection ends when nobody has it any more."""
        self._ended.set()
        self._watch.join()
        arm, self._arm, self._motion = self._arm, None, None
        return arm

    def _stay(self) -> None:
        self._set(np.asarray(self._arm.state.q), np.zeros(len(contract.ARM_JOINTS)))

    def _set(self, q_rad: Float[np.ndarray, "7"], speed_rad_s: Float[np.ndarray, "7"]) -> None:
        self._motion.set_reference(self._franky.JointReference(q_rad, speed_rad_s))

    def _brake_when_late(self) -> None:
        """In a thread of its own, by the arm's clock: whoever sends commands may hang."""
        while not self._ended.wait(_LOOK_S):
            try:
                now_s = self._arm.state.time.to_sec()
            except (self._franky.Exception, RuntimeError):
                return  # the connection has gone, and the arm with it stands
            with self._lock:
                if self._due_s is not None and now_s > self._due_s:
                    self._stay()
                    self._due_s = None
