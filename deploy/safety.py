"""The last word before the robot: every target passes the limits here, every change is counted.

A policy is a learned function; nothing it says is trusted. The filter is pure arithmetic on the
measured joints, so it holds for any robot driver and in simulation alike.
"""

import math
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from ddgrasp import contract
from ddgrasp.config import DeployConfig
from ddgrasp.layout import ACTION, closes
from deploy import kinematics

_BISECTIONS = 12
"""Halvings when a step is too long for the hand: 1/4096 of the step, below 0.1 mm."""
APPROACH = "approach"
"""Cause of a change by which a hand that comes down makes a part of a step, straight on."""
_NEWTON_STEPS = 3
_SLIDE_TOLERANCE_M = 1e-4


@dataclass(frozen=True)
class SafetyLimits:
    """What the robot may be told to do."""

    lower_rad: tuple[float, ...] = contract.JOINT_LOWER_RAD
    upper_rad: tuple[float, ...] = contract.JOINT_UPPER_RAD
    velocity_rad_s: tuple[float, ...] = contract.JOINT_VELOCITY_LIMIT_RAD_S
    """Largest step per control period, divided by the period; no more than the driver will let the arm do."""
    acceleration_rad_s2: tuple[float, ...] = contract.JOINT_ACCELERATION_LIMIT_RAD_S2
    """Largest change between two steps that follow each other, divided by the period squared."""
    braking_rad_s2: tuple[float, ...] | None = None
    """How hard a joint brakes before its position limit (`contract.Arm`); None for one that stops at once."""
    braking_reserve_rad_s: tuple[float, ...] = (0.0,) * 7
    workspace_lower_m: tuple[float, float, float] = DeployConfig.workspace_lower_m
    workspace_upper_m: tuple[float, float, float] = DeployConfig.workspace_upper_m
    """Box for the point between the finger pads, robot base frame."""
    arm_lower_m: tuple[float, float, float] = DeployConfig.arm_lower_m
    arm_upper_m: tuple[float, float, float] = DeployConfig.arm_upper_m
    """Box that elbow, forearm, wrist, hand and open fingers stay inside: table and walls."""
    approach_below_m: float = 0.0
    """Below this height the grip point comes down slowly: the hand may land on something. 0: nowhere."""
    approach_m_s: float = math.inf
    """How fast it may come down there."""
    period_s: float = contract.CONTROL_DT_S


@dataclass
class SafetyCounts:
    """How often the filter changed a command: control steps by cause."""

    commands: int = 0
    by_cause: Counter[str] = field(default_factory=Counter)

    def as_dict(self) -> dict[str, int]:
        """Commands in all, and how many were changed for which cause."""
        causes = (
            "action", "joint_position", "joint_velocity", "joint_acceleration", APPROACH,
            "workspace", "arm",
        )  # fmt: skip
        return {"commands": self.commands} | {cause: self.by_cause[cause] for cause in causes}


class NonFiniteAction(Exception):
    """The policy answered NaN or infinity."""


def _shorten(step: np.ndarray, allowed: Callable[[np.ndarray], bool]) -> np.ndarray:
    """(7,) the longest part of `step` that bisection finds allowed; standing still is."""
    inside, beyond = 0.0, 1.0
    for _ in range(_BISECTIONS):
        middle = (inside + beyond) / 2
        if allowed(middle * step):
            inside = middle
        else:
            beyond = middle
    return inside * step


class SafetyFilter:
    """Turns a policy's action into a joint target that respects `limits`."""

    def __init__(self, limits: SafetyLimits, action_scale_rad: float):
        self.limits = limits
        self.action_scale_rad = action_scale_rad
        self.counts = SafetyCounts()
        self._last_step_rad = np.zeros(len(contract.ARM_JOINTS))

    def stopped(self) -> None:
        """The arm was told to hold: the next step accelerates from rest."""
        self._last_step_rad = np.zeros(len(contract.ARM_JOINTS))

    def target(
        self, q_rad: Float[np.ndarray, "7"], action: np.ndarray
    ) -> tuple[Float[np.ndarray, "7"], bool, list[str]]:
        """Joint target for a measured position and an action.

        Args:
            q_rad: (7,) measured joint positions.
            action: (8,); the first seven are joint steps in units of `action_scale_rad` and belong
                into [-1, 1], the last closes the gripper if above 0.

        Returns:
            (7,) target within all limits, whether to close, and the causes of any change.

        Raises:
            NonFiniteAction: nothing can be made of such an action; hold.
        """
        if action.shape != (contract.ACTION_SIZE,) or not np.isfinite(action).all():
            raise NonFiniteAction(f"action {np.array2string(action, precision=3)}")
        causes: list[str] = []
        unit = self._noted(np.clip(action[ACTION.arm], -1.0, 1.0), action[ACTION.arm], "action", causes)
        step = unit.astype(float) * self.action_scale_rad
        step = self._limit_step(q_rad, step, causes)
        step = self._limit_workspace(q_rad, step, causes)
        step = self._limit_arm(q_rad, step, causes)
        self._last_step_rad = step
        self.counts.commands += 1
        self.counts.by_cause.update(causes)
        return q_rad + step, bool(closes(action)), causes

    def _limit_step(self, q_rad: np.ndarray, step: np.ndarray, causes: list[str]) -> np.ndarray:
        """(7,) `step` within acceleration, velocity and position limits; the later one wins."""
        step = self._noted(self._accelerated(step), step, "joint_acceleration", causes)
        # All joints alike: the hand goes where it was told to, more slowly.
        slower = min(1.0, float((self._largest_rad / np.maximum(np.abs(step), 1e-9)).min()))
        step = self._noted(step if slower == 1.0 else slower * step, step, "joint_velocity", causes)
        step = self._noted(self._in_room(q_rad, step), step, "joint_position", causes)
        # Last: a joint cut by itself may be the one that was raising the hand.
        return self._noted(self._gently_down(q_rad, step), step, APPROACH, causes)

    @property
    def _largest_rad(self) -> np.ndarray:
        return np.array(self.limits.velocity_rad_s) * self.limits.period_s

    def _accelerated(self, step: np.ndarray) -> np.ndarray:
        """(7,) `step`, no further from the last one than a joint may accelerate."""
        change = np.array(self.limits.acceleration_rad_s2) * self.limits.period_s**2
        return np.clip(step, self._last_step_rad - change, self._last_step_rad + change)

    def _in_room(self, q_rad: np.ndarray, step: np.ndarray) -> np.ndarray:
        """(7,) `step`, from which every joint can still stop before its limit.

        A joint measured outside its range may only come back, no faster than the largest step.
        """
        room_down = np.minimum(np.array(self.limits.lower_rad) - q_rad, self._largest_rad)
        room_up = np.maximum(np.array(self.limits.upper_rad) - q_rad, -self._largest_rad)
        return np.clip(step, -self._braked(-room_down), self._braked(room_up))

    def _gently_down(self, q_rad: np.ndarray, step: np.ndarray) -> np.ndarray:
        """(7,) `step`, shortened so that the grip point comes down no faster than it may where low."""
        limits = self.limits
        if not limits.approach_below_m:
            return step
        way_m = limits.approach_m_s * limits.period_s
        here_m = kinematics.grip_position(q_rad)[2]

        def gentle(part: np.ndarray) -> bool:
            there_m = kinematics.grip_position(q_rad + part)[2]
            return bool(there_m >= limits.approach_below_m or here_m - there_m <= way_m)

        return step if gentle(step) else _shorten(step, gentle)

    def _braked(self, room_rad: np.ndarray) -> np.ndarray:
        """(7,) the longest step towards a limit `room_rad` (7,) away after which the joint can still stop.

        The step's speed v obeys v <= -c + sqrt(2 a (room - v dt)): braking a, reserve c, period dt.
        """
        if self.limits.braking_rad_s2 is None:
            return room_rad
        a, c = np.array(self.limits.braking_rad_s2), np.array(self.limits.braking_reserve_rad_s)
        dt = self.limits.period_s
        root = np.sqrt(np.maximum((c + a * dt) ** 2 - c**2 + 2.0 * a * room_rad, 0.0))
        return np.minimum(room_rad, np.maximum(root - (c + a * dt), 0.0) * dt)

    def outside_m(self, q_rad: Float[np.ndarray, "7"]) -> dict[str, float]:
        """How far the point between the pads, and the arm, are outside of their boxes; 0 inside."""
        return {"workspace": self._outside_m(q_rad), "arm": self._arm_outside_m(q_rad)}

    def _limit_workspace(self, q_rad: np.ndarray, step: np.ndarray, causes: list[str]) -> np.ndarray:
        """(7,) `step`, changed so that the grip point ends in the box, or no further outside than it is, of
        the whole and of every face: who is outside of one wall may not go through the table instead."""
        allowed, faces = self._outside_m(q_rad), np.abs(self._overshoot_m(q_rad))

        def inside(part: np.ndarray, tolerance_m: float = 0.0) -> bool:
            there = self._overshoot_m(q_rad + part)
            whole = float(np.linalg.norm(there)) <= max(allowed, tolerance_m)
            return whole and bool((np.abs(there) <= np.maximum(faces, tolerance_m)).all())

        if inside(step):
            return step
        causes.append("workspace")
        slid = self._gently_down(q_rad, self._slide(q_rad, step))
        return slid if inside(slid, _SLIDE_TOLERANCE_M) else _shorten(step, inside)

    def _limit_arm(self, q_rad: np.ndarray, step: np.ndarray, causes: list[str]) -> np.ndarray:
        """(7,) `step`, shortened so that no part of the arm ends outside its box, or any face of it further
        than one is."""
        allowed = self._arm_over_m(q_rad)
        if (self._arm_over_m(q_rad + step) <= allowed).all():
            return step
        causes.append("arm")
        grip = max(self._outside_m(q_rad), _SLIDE_TOLERANCE_M)
        return _shorten(
            step,
            lambda part: (
                bool((self._arm_over_m(q_rad + part) <= allowed).all())
                and self._outside_m(q_rad + part) <= grip
            ),
        )

    def _slide(self, q_rad: np.ndarray, step: np.ndarray) -> np.ndarray:
        """(7,) `step` without what leads out of the box (Newton steps), within the other limits."""
        for _ in range(_NEWTON_STEPS):
            target = q_rad + step
            correction = np.linalg.pinv(kinematics.position_jacobian(target)) @ -self._overshoot_m(target)
            step = np.clip(self._accelerated(step + correction), -self._largest_rad, self._largest_rad)
            step = self._in_room(q_rad, step)
        return step

    def _overshoot_m(self, q_rad: np.ndarray) -> np.ndarray:
        """(3,) vector from the nearest point of the workspace box to the grip point."""
        position = kinematics.grip_position(q_rad)
        return position - np.clip(position, self.limits.workspace_lower_m, self.limits.workspace_upper_m)

    def _outside_m(self, q_rad: np.ndarray) -> float:
        """Distance from the workspace box to the grip point, 0 inside."""
        return float(np.linalg.norm(self._overshoot_m(q_rad)))

    def _arm_outside_m(self, q_rad: np.ndarray) -> float:
        """How far the part that reaches furthest is outside the arm's box, 0 with all inside."""
        return float(self._arm_over_m(q_rad).max())

    def _arm_over_m(self, q_rad: np.ndarray) -> np.ndarray:
        """(2, 3) the same of each face by itself: the lower ones, the upper ones."""
        centers, radii = kinematics.part_centers(q_rad), kinematics.PART_RADII_M[:, None]
        below = np.array(self.limits.arm_lower_m) - (centers - radii)
        above = (centers + radii) - np.array(self.limits.arm_upper_m)
        return np.maximum([below.max(axis=0), above.max(axis=0)], 0.0)

    @staticmethod
    def _noted(limited: np.ndarray, wanted: np.ndarray, cause: str, causes: list[str]) -> np.ndarray:
        if not np.array_equal(limited, wanted):
            causes.append(cause)
        return limited
