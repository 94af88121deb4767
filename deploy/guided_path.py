"""A way for the arm as a person would lead it: to an object, away with it, down again, about the table."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float64

from ddgrasp import contract
from ddgrasp.contract import HOME_RAD
from deploy.calibration.poses import reach
from deploy.safety import SafetyLimits
from mjx_envs import grasp_math, kinematics
from rig.fr3.scene import SceneObject

STEP_RAD, TOUCH_STEP_RAD = 0.07, 0.03
"""Longest step of a joint in a control period, and near the object."""
ARRIVED_RAD = 0.03
PATIENCE = 25
"""Control periods after which the arm is led on, wherever it is."""
GRIP_STEPS = 12
"""Control periods that the hand takes to close or open."""
ABOVE_M, PUT_M = 0.12, 0.006
"""The grip's height above a grasp before it goes down; above it when the object is let go."""
WANDER_Z_M = (0.12, 0.35)


@dataclass(frozen=True)
class Stop:
    """A place on the way."""

    q_rad: Float64[np.ndarray, "7"]
    close: bool
    """The hand on the way there, and there."""
    step_rad: float = STEP_RAD
    stay_steps: int = 0
    """Control periods to stay."""


class GuidedPath:
    """From stop to stop, and round again: one action per control period."""

    def __init__(self, stops: Sequence[Stop]):
        self._stops = stops
        self._at, self._spent, self._stayed = 0, 0, 0

    def action(self, q_rad: Float[np.ndarray, "7"]) -> Float64[np.ndarray, "8"]:
        """(8,) action, as a policy's, for measured joints (7,)."""
        stop = self._stops[self._at]
        away = stop.q_rad - q_rad
        far_rad = float(np.abs(away).max())
        if far_rad < ARRIVED_RAD or self._spent > PATIENCE:
            self._stayed += 1
        self._spent += 1
        if self._stayed > stop.stay_steps:
            self._at, self._spent, self._stayed = (self._at + 1) % len(self._stops), 0, 0
        step = away * min(1.0, stop.step_rad / max(far_rad, 1e-9))
        return np.append(step / contract.ACTION_SCALE_RAD, 1.0 if stop.close else -1.0)


def plan(
    thing: SceneObject, place: dict[str, float], limits: SafetyLimits, rng: np.random.Generator
) -> list[Stop]:
    """Grasp `thing` where it stands, carry it elsewhere, put it down, look about.

    Args:
      place: x_m, y_m, yaw_rad of the object.
      limits: what the safety filter will allow.
    """
    there = np.array([place["x_m"], place["y_m"], thing.rest_height_m])
    quat = kinematics.quat_about_z(np.asarray(place["yaw_rad"]))
    branch = grasp_math.yaw_branch(quat, thing.grasp_symmetry)
    grasp_m, grasp_quat = grasp_math.grasp_pose(
        there, quat, thing.grasp_symmetry, branch, offset_m=thing.grasp_offset_m
    )
    above = _reached(grasp_m + (0.0, 0.0, ABOVE_M), grasp_quat, limits, np.array(HOME_RAD))
    down = _reached(grasp_m, grasp_quat, limits, above)
    carried = _anywhere(grasp_quat, limits, rng)
    put_m = _beside(rng, grasp_m[2] + PUT_M)
    over = _reached(put_m + (0.0, 0.0, ABOVE_M), grasp_quat, limits, carried)
    put = _reached(put_m, grasp_quat, limits, over)
    free = np.asarray(grasp_math.HAND_DOWN)
    return [
        Stop(above, False),
        Stop(down, False, TOUCH_STEP_RAD),
        Stop(down, True, TOUCH_STEP_RAD, GRIP_STEPS),
        Stop(above, True),
        Stop(carried, True),
        Stop(over, True),
        Stop(put, True, TOUCH_STEP_RAD),
        Stop(put, False, TOUCH_STEP_RAD, GRIP_STEPS),
        Stop(over, False, TOUCH_STEP_RAD),
        *(Stop(_anywhere(free, limits, rng), False) for _ in range(3)),
    ]


def _anywhere(
    quat: Float[np.ndarray, "4"], limits: SafetyLimits, rng: np.random.Generator
) -> Float64[np.ndarray, "7"]:
    """Above some place of the workspace."""
    return _reached(_beside(rng, rng.uniform(*WANDER_Z_M)), quat, limits, np.array(HOME_RAD))


def _beside(rng: np.random.Generator, z_m: float) -> Float64[np.ndarray, "3"]:
    center, size = np.array(contract.WORKSPACE_CENTER_M), np.array(contract.WORKSPACE_SIZE_M)
    return np.append(center + rng.uniform(-0.5, 0.5, 2) * size, z_m)


def _reached(
    position_m: Float[np.ndarray, "3"],
    quat: Float[np.ndarray, "4"],
    limits: SafetyLimits,
    q_guess_rad: Float[np.ndarray, "7"],
) -> Float64[np.ndarray, "7"]:
    """(7,) joints there; the guess where the arm cannot get there."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = kinematics.quat_to_mat(quat), position_m
    q = reach(T, q_guess_rad, limits)
    return q_guess_rad if q is None else q
