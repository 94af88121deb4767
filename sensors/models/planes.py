"""Least-squares planes in square windows of a picture. NumPy and OpenCV."""

import cv2
import numpy as np
from jaxtyping import Float, Float64

Map = Float[np.ndarray, "H W"]


def slopes(picture: Map, window_px: int) -> tuple[tuple[Map, Map], Map]:
    """Plane of every window of an (H, W) picture: ((slope along u, along v), mean), (H, W) each."""
    offset = np.arange(window_px, dtype=np.float32) - (window_px - 1) / 2
    ramp = offset / np.sum(offset**2)
    flat = np.full(window_px, 1.0 / window_px, np.float32)
    along_u = cv2.sepFilter2D(picture, -1, ramp, flat, borderType=cv2.BORDER_REPLICATE)
    along_v = cv2.sepFilter2D(picture, -1, flat, ramp, borderType=cv2.BORDER_REPLICATE)
    return (along_u, along_v), cv2.sepFilter2D(picture, -1, flat, flat, borderType=cv2.BORDER_REPLICATE)


def residual_variance(
    picture: Map, window_px: int, border: int = cv2.BORDER_REPLICATE
) -> tuple[Float64[np.ndarray, "H W"], Float64[np.ndarray, "H W"]]:
    """(H, W) mean squared distance of each window's pixels from its plane; (H, W) the plane at its centre.

    In double precision: the variance is a small difference of squares. `border` is how OpenCV continues
    the picture for the squares.
    """
    picture = picture.astype(np.float64)
    (along_u, along_v), mean = slopes(picture, window_px)
    square = cv2.boxFilter(picture * picture, -1, (window_px, window_px), borderType=border)
    spread = (window_px**2 - 1) / 12.0
    return np.maximum(square - mean**2 - spread * (along_u**2 + along_v**2), 0.0), mean
