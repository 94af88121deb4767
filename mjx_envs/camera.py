"""Pinhole cameras: where they stand and what they see. NumPy alone."""

from dataclasses import dataclass

import numpy as np

from ddgrasp import contract


@dataclass(frozen=True)
class Camera:
    """A pinhole camera in the world; OpenCV axes (x right, y down, z forward)."""

    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float
    height_px: int
    width_px: int
    T_world_cam: np.ndarray
    """(4, 4) pose of the camera in the world frame, metres."""


def look_at(position_m, target_m) -> np.ndarray:
    """(4, 4) T_world_cam of a camera at `position_m` that faces `target_m`, image x axis level."""
    position = np.asarray(position_m, float)
    forward = np.asarray(target_m, float) - position
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    down = np.cross(forward, right)
    T_world_cam = np.eye(4)
    T_world_cam[:3, :3] = np.stack([right, down, forward], axis=1)
    T_world_cam[:3, 3] = position
    return T_world_cam


def nominal_camera(profile: contract.CameraProfile) -> Camera:
    """The contract's camera at its nominal place, with `profile`'s pixels."""
    return Camera(
        profile.fx_px, profile.fy_px, profile.cx_px, profile.cy_px, profile.height_px, profile.width_px,
        look_at(contract.CAMERA_POSITION_M, contract.CAMERA_LOOK_AT_M),
    )
