"""Large planes of a depth picture (table, floor, wall): they show what a camera gets wrong over many pixels.

A stereo camera's matches bend flat surfaces into bumps some 10 to 20 pixels wide. A filter of a few pixels
takes them for the surface; a plane does not.
"""

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32

TOLERANCE_PER_M = 0.015
"""How far off a plane its own pixels may be, in inverse depth: twice the 90th percentile of the rig's camera
(0.0075; 0.24 px of a D455's disparity at 320 px), half of what a 3 cm high object on a table 1 m away is off.
"""
LEAST_SHARE = 0.05
"""Share of the picture: smaller planes are left as they are."""
MOST_PLANES = 3
MARGIN_SHARE = 1 / 50
"""Share of the picture's width: so near to anything that is not on the plane, the plane does not count."""
STRIDE_PX = 4
"""Planes are looked for among every so many pixels."""
_TRIALS = 60
_POINTS = 3
"""What a plane goes through."""


def on_planes(inverse: Float[np.ndarray, "H W"]) -> Float32[np.ndarray, "H W"]:
    """(H, W) inverse depth in 1/m without holes -> the same with large planes put where it is near them.

    A plane is an affine function of the pixel in inverse depth, whatever the lens's focal length. Planes are
    found one after the other by RANSAC (Fischler and Bolles 1981); the change from plane to what is left is
    gradual.
    """
    flat = np.array(inverse, np.float32)
    left = np.ones(flat.shape, bool)
    margin_px = max(1, round(MARGIN_SHARE * flat.shape[1]))
    for _ in range(MOST_PLANES):
        plane = _largest(flat, left)
        if plane is None:
            break
        near = left & (np.abs(flat - plane) < TOLERANCE_PER_M)
        weight = _weight(near, margin_px)
        if np.mean(weight > 0) < LEAST_SHARE:
            break
        flat += weight * (plane - flat)
        left &= ~near
    return flat


def _largest(inverse: np.ndarray, left: Bool[np.ndarray, "H W"]) -> Float32[np.ndarray, "H W"] | None:
    """(H, W) the plane that most of the pixels `left` are near; None if there is no large one."""
    from sklearn.linear_model import RANSACRegressor

    from sensors.statistics.plane import Plane

    rows, columns = np.nonzero(left[::STRIDE_PX, ::STRIDE_PX])
    if len(rows) < max(_POINTS, LEAST_SHARE * left[::STRIDE_PX, ::STRIDE_PX].size):
        return None
    pixels = np.stack([rows, columns], axis=1) * STRIDE_PX
    values = inverse[pixels[:, 0], pixels[:, 1]]
    search = RANSACRegressor(
        Plane(), min_samples=_POINTS, residual_threshold=TOLERANCE_PER_M, max_trials=_TRIALS, random_state=0
    )
    search.fit(pixels, values)
    everywhere = np.indices(inverse.shape).reshape(2, -1).T
    return search.predict(everywhere).reshape(inverse.shape).astype(np.float32)


def _weight(near: Bool[np.ndarray, "H W"], margin_px: int) -> Float32[np.ndarray, "H W"]:
    """(H, W) 1 well inside of what is near a plane, 0 within `margin_px` of anything else, between the two a
    ramp. Specks of one pixel do not count, whichever side they are of.
    """
    calm = cv2.medianBlur(near.astype(np.uint8), 5)
    distance_px = cv2.distanceTransform(calm, cv2.DIST_L2, 3)
    return np.clip(distance_px / margin_px - 1, 0, 1)
