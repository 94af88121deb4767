"""Procedural depth noise of random strength, as depthfeat is trained on it. NumPy and OpenCV.

The family of DextrAH-G's noise: jittered lookup and disparity noise, dropout, random values, sticks.
Apart from sensors/models/procedural.py, which models one published camera and is compiled once per strength:
every training picture has a strength of its own, and what a frozen extractor was trained on does not change.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, Float32

from ddgrasp import contract


@dataclass(frozen=True)
class ProceduralConfig:
    """Strengths of the procedural noise, at the scale of a quarter-size D455."""

    shift_px: float = 0.5
    """Standard deviation of the smooth field by which pixels are displaced."""
    shift_scale_px: int = 4
    """Correlation length of that field."""
    disparity_px: float = 0.06
    """Standard deviation of correlated disparity noise."""
    disparity_scale_px: int = 2
    """Correlation length of disparity noise."""
    dropout: float = 0.003
    """Probability that a pixel becomes invalid."""
    random_value: float = 0.003
    """Probability that a pixel takes a random depth."""
    random_range_m: tuple[float, float] = (0.3, 2.0)
    """Range of these random depths."""
    sticks: int = 4
    """Thin occluding segments per frame, at most."""
    stick_length_px: int = 18
    """Longest stick."""
    stick_width_px: int = 3
    """Widest stick."""


def corrupt(
    depth_m: Float[np.ndarray, "*B H W"],
    rng: np.random.Generator,
    profile: contract.CameraProfile,
    config: ProceduralConfig = ProceduralConfig(),
) -> Float32[np.ndarray, "*B H W"]:
    """Noisy copy of clean depth.

    Args:
        depth_m: (B, H, W) or (H, W) planar metres, 0 = invalid.
        profile: gives focal length times baseline, which turns disparity noise into depth noise.

    Returns:
        Array of the same shape, float32, 0 = invalid.
    """
    if depth_m.ndim == 2:
        return corrupt(depth_m[None], rng, profile, config)[0]
    fb_px_m = profile.fx_px * profile.baseline_m
    noisy = np.stack([_shifted(frame.astype(np.float32), rng, config) for frame in depth_m])
    fields = [_smooth(noisy.shape[1:], config.disparity_scale_px, rng) for _ in noisy]
    disparity = fb_px_m / np.maximum(noisy, 1e-3) + config.disparity_px * np.stack(fields)
    noisy = np.where(noisy > 0, fb_px_m / np.maximum(disparity, 1e-3), 0)
    replaced = rng.random(noisy.shape) < config.random_value
    noisy = np.where(replaced, rng.uniform(*config.random_range_m, noisy.shape), noisy)
    noisy = np.where(rng.random(noisy.shape) < config.dropout, 0, noisy).astype(np.float32)
    for frame in noisy:
        _draw_sticks(frame, rng, config)
    return noisy


def _smooth(shape: tuple[int, ...], scale_px: int, rng: np.random.Generator) -> np.ndarray:
    """(H, W) float32 field of about unit variance, correlated over `scale_px`."""
    height, width = shape
    coarse = rng.standard_normal((height // scale_px + 2, width // scale_px + 2), dtype=np.float32)
    return cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC)


def _shifted(depth_m: np.ndarray, rng: np.random.Generator, config: ProceduralConfig) -> np.ndarray:
    """Each pixel looks up its depth a little beside itself: edges become ragged."""
    grid = np.indices(depth_m.shape, dtype=np.float32)
    for axis in grid:
        axis += config.shift_px * _smooth(depth_m.shape, config.shift_scale_px, rng)
    return cv2.remap(depth_m, grid[1], grid[0], cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE)


def _draw_sticks(depth_m: np.ndarray, rng: np.random.Generator, config: ProceduralConfig) -> None:
    """Draw random segments of constant depth into the frame, in place."""
    height, width = depth_m.shape
    for _ in range(rng.integers(config.sticks + 1)):
        start = np.array([rng.integers(width), rng.integers(height)])
        angle = rng.uniform(0, 2 * np.pi)
        end = start + rng.uniform(1, config.stick_length_px) * np.array([np.cos(angle), np.sin(angle)])
        thickness = int(rng.integers(1, config.stick_width_px + 1))
        points = [tuple(int(v) for v in point) for point in (start, end)]
        cv2.line(depth_m, *points, color=float(rng.uniform(*config.random_range_m)), thickness=thickness)
