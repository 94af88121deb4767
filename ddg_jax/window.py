"""A stereo camera's matching window: what it compares, and so what it mixes, is no single pixel."""

import cv2
import numpy as np
from jaxtyping import Float, Float32

from ddgrasp.depth import inverse_depth


def mixed(depth_m: Float[np.ndarray, "B H W"], window_px: float) -> Float32[np.ndarray, "B H W"]:
    """(B, H, W) planar depth, metres, 0 = none, as a window of standard deviation `window_px` sees it.

    Inverse depth, in which disparity is linear, is averaged over valid pixels by a Gaussian: edges become
    ramps, near surfaces grow and thin things sink into what is behind them. Pixels without depth stay so.
    Recorded depth has gone through the camera's window, so that a generator whose prior is made of recorded
    depth cannot learn it: it belongs to the way from simulation to what the generator takes for clean.
    """
    if window_px == 0:
        return np.asarray(depth_m, np.float32)
    return np.stack([_mixed(np.asarray(frame, np.float32), window_px) for frame in depth_m])


def _mixed(depth_m: Float32[np.ndarray, "H W"], window_px: float) -> Float32[np.ndarray, "H W"]:
    valid = depth_m > 0
    inverse = inverse_depth(depth_m)
    weight = cv2.GaussianBlur(valid.astype(np.float32), (0, 0), window_px)
    mean = cv2.GaussianBlur(inverse, (0, 0), window_px)
    return np.divide(weight, mean, out=np.zeros_like(depth_m), where=valid)
