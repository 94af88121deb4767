"""Holes filled from around them: what a depth camera's user does who does not want them. JAX-free."""

import cv2
import numpy as np
from jaxtyping import UInt16

RADIUS_PX = 3.0
"""Neighbourhood that a filled pixel is made from."""


def inpainted(
    depth_mm: UInt16[np.ndarray, "*T H W"], radius_px: float = RADIUS_PX
) -> UInt16[np.ndarray, "*T H W"]:
    """(..., H, W) millimetres, every hole (0) of every picture filled by OpenCV (Telea 2004); the paper names
    OpenCV and no method. A picture without any reading stays as it is."""
    if depth_mm.ndim > 2:
        return np.stack([inpainted(frame, radius_px) for frame in depth_mm])
    return cv2.inpaint(depth_mm, (depth_mm == 0).astype(np.uint8), radius_px, cv2.INPAINT_TELEA)
