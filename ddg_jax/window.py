"""A stereo camera's matching window: what it compares, and so what it mixes, is no single pixel."""

import cv2
import numpy as np
from jaxtyping import Float, Float32

from ddgrasp.config import BOX, GraftConfig
from ddgrasp.depth import inverse_depth


def mixed(depth_m: Float[np.ndarray, "B H W"], graft: GraftConfig) -> Float32[np.ndarray, "B H W"]:
    """(B, H, W) planar depth, metres, 0 = none, as the window `graft.window_px` wide sees it.

    Inverse depth, in which disparity is linear, is averaged over valid pixels by a box or a Gaussian
    (`graft.window_shape`): edges become ramps, near surfaces grow and thin things sink into what is behind
    them. Pixels without depth stay so. Recorded depth has gone through the camera's window, so that a
    generator whose prior is made of recorded depth cannot learn it: it belongs to the way from simulation to
    what the generator takes for clean.
    """
    if graft.window_px == 0:
        return np.asarray(depth_m, np.float32)
    return np.stack([_mixed(np.asarray(frame, np.float32), graft) for frame in depth_m])


def _mixed(depth_m: Float32[np.ndarray, "H W"], graft: GraftConfig) -> Float32[np.ndarray, "H W"]:
    valid = depth_m > 0
    weight, mean = (_averaged(x, graft) for x in (valid.astype(np.float32), inverse_depth(depth_m)))
    return np.divide(weight, mean, out=np.zeros_like(depth_m), where=valid)


def _averaged(picture: Float32[np.ndarray, "H W"], graft: GraftConfig) -> np.ndarray:
    if graft.window_shape == BOX:
        return cv2.blur(picture, (int(graft.window_px), int(graft.window_px)))
    return cv2.GaussianBlur(picture, (0, 0), graft.window_px)
