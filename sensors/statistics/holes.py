"""The surface behind a depth picture: holes filled, noise smoothed away, edges kept. NumPy and OpenCV."""

import cv2
import numpy as np
from jaxtyping import Float, Float32

MEDIAN_PX = 5
BILATERAL_PX, BILATERAL_SPATIAL_PX, BILATERAL_PER_M = 9, 4.0, 0.02
"""Window and widths of the bilateral filter: in pixels, and in inverse depth (1/m), where steps are kept that
are larger than a stereo camera's noise on a surface (a third of a pixel for a D455 at 320 px)."""


def smooth_surface(inverse: Float[np.ndarray, "H W"]) -> Float32[np.ndarray, "H W"]:
    """Inverse depth (H, W) float32 without holes -> the surface under its noise, steps kept.

    A median and a bilateral filter (Tomasi and Manduchi 1998).
    """
    flat = cv2.medianBlur(np.ascontiguousarray(inverse, np.float32), MEDIAN_PX)
    return cv2.bilateralFilter(flat, BILATERAL_PX, BILATERAL_PER_M, BILATERAL_SPATIAL_PX)


def fill_from_background(inverse: Float[np.ndarray, "H W"]) -> Float[np.ndarray, "H W"]:
    """Fills holes (0) of an inverse depth map (H, W) with the farther of the row's nearest valid pixels.

    A stereo camera loses pixels mostly beside near objects, where one imager sees the background and the
    other does not: the farther neighbour is the surface that was lost. Rows without a valid pixel take the
    nearest row's values. A median over the filled pixels removes the streaks.
    """
    valid = inverse > 0
    rows = np.flatnonzero(valid.any(axis=1))
    if len(rows) == 0:
        return inverse.copy()
    left, right = (
        _nearest_valid_in_row(inverse, valid),
        _nearest_valid_in_row(inverse[:, ::-1], valid[:, ::-1]),
    )
    right = right[:, ::-1]
    background = np.where((left > 0) & (right > 0), np.minimum(left, right), np.maximum(left, right))
    filled = np.where(valid, inverse, background)
    row_of = rows[np.abs(np.arange(len(inverse))[:, None] - rows).argmin(axis=1)]
    filled = filled[row_of].astype(np.float32)
    return np.where(valid, inverse, cv2.medianBlur(filled, 5))


def _nearest_valid_in_row(values: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """(H, W): the last valid value at or before each column, 0 where there is none."""
    columns = np.maximum.accumulate(np.where(valid, np.arange(values.shape[1]), -1), axis=1)
    found = np.take_along_axis(values, np.maximum(columns, 0), axis=1)
    return np.where(columns >= 0, found, 0)
