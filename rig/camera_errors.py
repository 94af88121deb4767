"""The rig's camera with some of its errors and not the others: which of them cost a policy its grasps."""

from typing import Literal, get_args

import mujoco
import numpy as np
from jaxtyping import Bool, Float, UInt16

from ddgrasp.config import StereoConfig
from ddgrasp.contract import CameraProfile
from rig.camera import RigCamera

ErrorName = Literal["holes", "small holes", "large holes", "values", "ripple", "mismatches"]
ERRORS: tuple[ErrorName, ...] = get_args(ErrorName)
MISMATCH_PX = 1.0
"""A disparity this far from the true one was matched to something else; below it the surface ripples."""
SMALL_PX = 16
"""Pixels of the largest hole that is small; a 4 cm cube takes 100 to 300 of a picture 320 wide."""


class PartlyWrongCamera(RigCamera):
    """Makes one kind of the camera's errors; everything else of its picture is as rendered."""

    def __init__(
        self, model: mujoco.MjModel, config: StereoConfig, profile: CameraProfile, errors: ErrorName
    ):
        super().__init__(model, config, profile)
        self.errors: ErrorName = errors

    def _sense(
        self,
        data: mujoco.MjData,
        T_world_cam: Float[np.ndarray, "4 4"],
        rng: np.random.Generator,
        object_name: str,
    ) -> UInt16[np.ndarray, "H W"]:
        """By the same draws of `rng` as the whole camera's."""
        sensed_mm = super()._sense(data, T_world_cam, rng, object_name)
        return only(self.errors, sensed_mm, self.clean_mm(data, T_world_cam), self.stereo.profile)


def only(
    errors: ErrorName,
    sensed_mm: UInt16[np.ndarray, "H W"],
    clean_mm: UInt16[np.ndarray, "H W"],
    profile: CameraProfile,
) -> UInt16[np.ndarray, "H W"]:
    """(H, W) uint16 millimetres: `clean_mm` but for one kind of what `sensed_mm` has wrong.

    Args:
      errors: holes, of them those of up to SMALL_PX pixels that touch (small holes) or the others (large
        holes), values (whatever is reported, its holes filled with the truth), or parts of values by how far
        the disparity is off: ripple (less than MISMATCH_PX) or mismatches (the others).
      sensed_mm: as the camera reports it.
      clean_mm: the same view without errors.
      profile: the camera of both.
    """
    hole = sensed_mm == 0
    if errors == "holes":
        return np.where(hole, np.uint16(0), clean_mm)
    if errors in ("small holes", "large holes"):
        kind = hole & (_small(hole) if errors == "small holes" else ~_small(hole))
        return np.where(kind, np.uint16(0), clean_mm)
    if errors == "values":
        return np.where(hole, clean_mm, sensed_mm)
    mismatch = _disparity_error_px(sensed_mm, clean_mm, profile) >= MISMATCH_PX
    kept: Bool[np.ndarray, "H W"] = ~hole & (mismatch if errors == "mismatches" else ~mismatch)
    return np.where(kept, sensed_mm, clean_mm)


def _small(hole: Bool[np.ndarray, "H W"]) -> Bool[np.ndarray, "H W"]:
    """(H, W) pixels of holes of up to SMALL_PX; pixels that touch at a corner belong together."""
    import cv2

    _, label, about, _ = cv2.connectedComponentsWithStats(hole.astype(np.uint8), connectivity=8)
    small = np.asarray(about)[:, cv2.CC_STAT_AREA] <= SMALL_PX
    small[0] = False  # what is no hole
    return small[np.asarray(label, np.int32)]


def _disparity_error_px(
    sensed_mm: UInt16[np.ndarray, "H W"], clean_mm: UInt16[np.ndarray, "H W"], profile: CameraProfile
) -> Float[np.ndarray, "H W"]:
    """(H, W) pixels; what is out of range is infinitely far."""
    sensed, clean = (np.where(depth > 0, 1e3 / np.maximum(depth, 1), 0.0) for depth in (sensed_mm, clean_mm))
    return profile.fx_px * profile.baseline_m * np.abs(sensed - clean)
