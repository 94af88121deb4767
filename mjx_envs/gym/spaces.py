"""Spaces of the grasping task, with bounds that hold: what lies beyond them is put onto them."""

from typing import Any

import numpy as np
from gymnasium import spaces
from jaxtyping import Float

from ddgrasp import contract
from ddgrasp.errors import unknown_name
from ddgrasp.layout import OBSERVATION, STATE, Layout

KINDS = ("state", "depth")
"""Observations: the teacher's (40,), or the student's depth picture and joints."""
RENDER_MODES = ("rgb_array",)
FAR_M = 2.0
"""Depth farther than this is no reading."""

_ANGLE_RAD, _SPEED_RAD_S, _PLACE_M, _UNIT = (-4.0, 4.0), (-20.0, 20.0), (-2.0, 2.0), (-1.0, 1.0)
BOUNDS = {
    "arm": _ANGLE_RAD, "fingers": (-0.02, 0.06), "arm_velocity": _SPEED_RAD_S, "finger_velocity": (-5.0, 5.0),
    "grip_pos": _PLACE_M, "grip_quat": _UNIT, "object_pos": _PLACE_M, "object_quat": _UNIT,
    "grasp_pos": _PLACE_M, "grasp_quat": _UNIT, "category": (0.0, 10.0), "width": (-0.04, 0.12),
}  # fmt: skip
"""Part of `OBSERVATION` or `STATE` -> its bounds: rad, m, rad/s, m/s. No joint or place gets there, and
speeds do so in collisions alone."""


def check_shape(action: Any, space: spaces.Space) -> None:
    """ValueError for an action that is no member of `space` by its shape: too short a one would drive the
    gripper by a joint's number."""
    if np.shape(action) != space.shape:
        raise ValueError(f"the action has shape {np.shape(action)}; expected {space.shape}")


def check_render_mode(mode: str | None) -> None:
    """UserError for a mode that is neither None nor one of RENDER_MODES."""
    if mode is not None and mode not in RENDER_MODES:
        raise unknown_name("render_mode", mode, RENDER_MODES)


def action_space() -> spaces.Box:
    """(8,) in [-1, 1]: `ddgrasp.layout.ACTION`."""
    return spaces.Box(-1.0, 1.0, (contract.ACTION_SIZE,), np.float32)


def state_space() -> spaces.Box:
    """(40,): `ddgrasp.layout.OBSERVATION`."""
    return _box(OBSERVATION)


def joints_space() -> spaces.Box:
    """(8,): `ddgrasp.layout.STATE`."""
    return _box(STATE)


def depth_space(profile: contract.CameraProfile) -> spaces.Dict:
    """depth (H, W) metres of the window that the student sees, 0 = no reading; state (8,): `STATE`."""
    window = (profile.crop_height_px, profile.crop_width_px)
    return spaces.Dict({"depth": spaces.Box(0.0, FAR_M, window, np.float32), "state": joints_space()})


def within(space: spaces.Box, values: Float[np.ndarray, "*any"]) -> Float[np.ndarray, "*any"]:
    """A new array: `values` (N, ...) clipped to the bounds of one environment's `space`."""
    return np.clip(values, space.low, space.high, dtype=np.float32)


def _box(layout: Layout) -> spaces.Box:
    low, high = np.empty(layout.size, np.float32), np.empty(layout.size, np.float32)
    for name, part in layout.items():
        low[part], high[part] = BOUNDS[name]
    return spaces.Box(low, high)
