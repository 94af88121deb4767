"""Pinhole cameras: where they stand and what they see. NumPy alone."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Float64

from ddgrasp import contract

Point = Sequence[float | int] | Float[np.ndarray, "3"]


@dataclass(frozen=True)
class Camera:
    """A pinhole camera in the world; OpenCV axes (x right, y down, z forward)."""

    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float
    height_px: int
    width_px: int
    T_world_cam: Any
    """(4, 4) pose of the camera in the world frame, metres; NumPy or JAX."""

    @classmethod
    def of(cls, profile: contract.CameraProfile, T_world_cam: Any) -> "Camera":
        """The camera with `profile`'s pixels at (4, 4) `T_world_cam`."""
        p = profile
        return cls(p.fx_px, p.fy_px, p.cx_px, p.cy_px, p.height_px, p.width_px, T_world_cam)

    def cropped(self, row0: int, col0: int, height_px: int, width_px: int) -> "Camera":
        """The camera that sees only the window whose first pixel is (row0, col0) of this one."""
        return replace(
            self, cx_px=self.cx_px - col0, cy_px=self.cy_px - row0, height_px=height_px, width_px=width_px
        )


class Buffers(NamedTuple):
    """What a renderer returns; NumPy or JAX arrays, a batch may come first."""

    depth_m: Any
    """(H, W) float32 planar depth, metres; 0 where nothing is hit within the far limit."""
    rgb: Any
    """(H, W, 3) float32 in [0, 1], shaded; the background colour where nothing is hit."""
    segmentation: Any
    """(H, W) int32 geom id of the model, -1 where nothing is hit (not limited by far)."""
    normal_w: Any
    """(H, W, 3) float32 outward unit normal in the world frame, zero where nothing is hit."""


_VERTICAL = 1e-9
"""Sine of the angle to the vertical below which a view has no level axis of its own."""


def look_at(position_m: Point, target_m: Point) -> Float64[np.ndarray, "4 4"]:
    """(4, 4) T_world_cam of a camera at `position_m` that faces `target_m`, image x axis level.

    Straight up or down it points to -y, as that of a camera would that faces along x and is tilted so far.
    """
    position = np.asarray(position_m, float)
    forward = np.asarray(target_m, float) - position
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    level = np.linalg.norm(right)
    right = right / level if level > _VERTICAL else np.array([0.0, -1.0, 0.0])
    down = np.cross(forward, right)
    T_world_cam = np.eye(4)
    T_world_cam[:3, :3] = np.stack([right, down, forward], axis=1)
    T_world_cam[:3, 3] = position
    return T_world_cam


def nominal_pose() -> Float64[np.ndarray, "4 4"]:
    """(4, 4) T_world_cam that training assumes, before it is displaced."""
    return look_at(contract.CAMERA_POSITION_M, contract.CAMERA_LOOK_AT_M)


def nominal_camera(profile: contract.CameraProfile) -> Camera:
    """The contract's camera at its nominal place, with `profile`'s pixels."""
    return Camera.of(profile, nominal_pose())
