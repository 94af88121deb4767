"""What an active-stereo camera does with its two pictures: match them, refine, smooth what is flat.

NumPy and OpenCV alone.
"""

import cv2
import numpy as np
from jaxtyping import Bool, Float

from ddgrasp.config import StereoConfig
from sensors.models import planes

Map = Float[np.ndarray, "H W"]

OTHER_SURFACE_PX = 0.5
"""Neighbouring disparities further apart than this belong to two surfaces."""


def matcher(config: StereoConfig, disparities: int) -> cv2.StereoSGBM:
    """OpenCV's semi-global matcher that searches that many disparities."""
    area = config.block_px**2
    return cv2.StereoSGBM.create(
        minDisparity=0,
        numDisparities=disparities,
        blockSize=config.block_px,
        P1=round(8 * area * config.smoothness),
        P2=round(32 * area * config.smoothness),
        disp12MaxDiff=config.left_right_px,
        preFilterCap=31,
        uniquenessRatio=config.uniqueness_percent,
        speckleWindowSize=config.speckle_px,
        speckleRange=1,
        mode=cv2.STEREO_SGBM_MODE_SGBM,
    )


def contrast(picture: np.ndarray, window_px: int) -> np.ndarray:
    """(H, W) float32: standard deviation of the grey levels around each pixel."""
    window = (window_px, window_px)
    mean, square = cv2.blur(picture.astype(np.float32), window), cv2.sqrBoxFilter(picture, cv2.CV_32F, window)
    return np.sqrt(np.maximum(square - mean * mean, 0.0))


def without_mean(picture: np.ndarray, window_px: int) -> np.ndarray:
    """(H, W) float32: the picture less its local mean."""
    picture = picture.astype(np.float32)
    return picture - cv2.blur(picture, (window_px, window_px))


def refine(
    left: np.ndarray, right: np.ndarray, coarse_px: np.ndarray, config: StereoConfig
) -> tuple[np.ndarray, np.ndarray]:
    """One Gauss-Newton step on the windowed squared difference (Lucas and Kanade 1981).

    The semi-global matcher interpolates its cost by a parabola in 1/16 px, which pulls towards whole
    pixels and differs from pixel to pixel. With i the pixels of a window, c_i their coarse disparity, e_i
    the difference of the pictures there and s_i the slope, the disparity d that all of them share minimises
    sum (e_i + s_i (d - c_i))^2. Pixels whose c_i is more than OTHER_SURFACE_PX from their neighbourhood's
    median do not take part.

    Returns:
        (H, W) disparity in pixels, moved by at most half a pixel; (H, W) residual relative to the
        local contrast: near 0 for a perfect match, 1.4 for unrelated pictures.
    """
    gradient = cv2.Sobel(right, cv2.CV_32F, 1, 0, ksize=1, scale=0.5)
    grid = np.indices(left.shape, dtype=np.float32)
    rows, at = grid[0], grid[1] - coarse_px
    matched = cv2.remap(right, at, rows, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    slope = cv2.remap(gradient, at, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    window = (config.refine_window_px, config.refine_window_px)
    difference = left - matched
    middle = cv2.medianBlur(coarse_px, 5)
    smooth = cv2.blur(middle, window)
    smooth = np.where(np.abs(smooth - middle) < OTHER_SURFACE_PX, smooth, middle)
    weight = slope * slope * (np.abs(coarse_px - middle) < OTHER_SURFACE_PX)
    towards = weight * (coarse_px - smooth) - np.where(weight > 0, slope * difference, 0)
    total = cv2.blur(weight, window)
    fine = smooth + cv2.blur(towards, window) / np.maximum(total, 1e-3)
    window = (config.residual_window_px, config.residual_window_px)
    energy = 0.5 * cv2.blur(left * left + matched * matched, window) + 1e-3
    residual = np.sqrt(cv2.blur(difference * difference, window) / energy)
    return np.clip(fine, coarse_px - 0.5, coarse_px + 0.5), residual


def flatten(fine_px: Map, valid: Bool[np.ndarray, "H W"], config: StereoConfig) -> Map:
    """(H, W) disparity, noise on flat surfaces averaged away over a window, edges and relief kept.

    Lee's filter (1980) about the window's plane instead of its mean: with v the variance of the window from
    its plane and n that of the noise, a pixel keeps max(0, 1 - n / v) of its distance from the plane. For the
    fit, small holes are filled with the mean around them; large ones leave v, and so the pixel, as it is.
    """
    window = (config.flat_window_px, config.flat_window_px)
    share = cv2.blur(valid.astype(np.float32), window)
    around = cv2.blur(np.where(valid, fine_px, 0), window) / np.maximum(share, 1e-3)
    whole = np.where(valid, fine_px, around)
    variance, plane = planes.residual_variance(whole, config.flat_window_px)
    keep = np.maximum(1.0 - config.flat_noise_px**2 / np.maximum(variance, 1e-9), 0.0)
    return (plane + keep * (whole - plane)).astype(np.float32)
