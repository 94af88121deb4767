"""Depth maps: millimetres on disk and metres in memory, inverses, nearest-neighbour resampling. JAX-free.

Depth is planar. On disk and from cameras: uint16 millimetres. In memory: float32 metres. 0 in both = no
reading.

Other ways to resize are elsewhere, because they answer other questions: `student_jax.preprocess` (what the
student's network sees: averaged over valid pixels, exported to ONNX), `ddg_jax.network_prior.at_size` (a
network's smooth output, averaged) and `foundation.resample` (conventions that published networks were trained
with).
"""

from collections.abc import Sequence
from types import ModuleType

import numpy as np
from jaxtyping import Float, Float32, Int, Real, Shaped, UInt16

from ddgrasp.arrays import AnyArray
from ddgrasp.contract import DEPTH_UNIT_M, CameraProfile
from ddgrasp.errors import UserError

MAX_MM = 65535
"""The farthest depth that fits: 65.535 m."""


def to_metres(depth_mm: Int[AnyArray, "*any"]) -> Float32[AnyArray, "*any"]:
    """uint16 millimetres to float32 metres, any shape, NumPy or JAX: float32(mm) * float32(0.001).

    The exported graph has the same two operations (export/graph.py), so that all see the same numbers.
    Raises UserError for what is no whole number: metres, most likely.
    """
    if depth_mm.dtype.kind not in "iu":
        raise UserError(f"Depth is {depth_mm.dtype}; expected whole millimetres (uint16).")
    return depth_mm.astype(np.float32) * np.float32(DEPTH_UNIT_M)


def to_millimetres(depth_m: Float[AnyArray, "*any"], xp: ModuleType = np) -> UInt16[AnyArray, "*any"]:
    """Floating metres to uint16 millimetres, any shape: the nearest, half a millimetre to the even one.

    What is no depth, or does not fit, is no reading: 0 for NaN, infinities, negative values and everything
    that rounds to more than 65.535 m. Raises UserError for whole numbers: millimetres, most likely.

    Args:
      xp: the array's own namespace, numpy or jax.numpy.
    """
    if depth_m.dtype.kind in "iu":
        raise UserError(f"Depth is {depth_m.dtype}; expected metres (float32).")
    return _whole(xp.round(depth_m / DEPTH_UNIT_M), xp)


def from_counts(counts: Real[np.ndarray, "*any"], unit_m: float) -> UInt16[np.ndarray, "*any"]:
    """A device's or a file's numbers, `unit_m` metres each, to uint16 millimetres: a new array of that shape.

    Rounded and refused as by `to_millimetres`, in float64.
    """
    if counts.dtype == np.uint16 and unit_m == DEPTH_UNIT_M:
        return counts.copy()
    return _whole(np.rint(counts.astype(np.float64) * (unit_m / DEPTH_UNIT_M)), np)


def metres_from_counts(counts: UInt16[np.ndarray, "*any"], unit_m: float) -> Float32[np.ndarray, "*any"]:
    """A file's counts of `unit_m` metres to float32 metres: as fine as they are, where millimetres are not.

    0 where `from_counts` has 0; of counts of a millimetre or more, its millimetres.
    """
    millimetres = from_counts(counts, unit_m)
    if unit_m >= DEPTH_UNIT_M:
        return to_metres(millimetres)
    return np.where(millimetres > 0, counts * unit_m, 0).astype(np.float32)


def inverse_depth(depth_m: Float[np.ndarray, "*x"]) -> Float32[np.ndarray, "*x"]:
    """1/d in 1/m, 0 where depth is 0 (infinitely far, or a hole). Any shape."""
    return np.divide(1, depth_m, out=np.zeros(depth_m.shape, np.float32), where=depth_m > 0)


def _whole(millimetres: AnyArray, xp: ModuleType) -> AnyArray:
    fits = (millimetres >= 0) & (millimetres <= MAX_MM)  # False for NaN
    return xp.where(fits, millimetres, 0).astype(np.uint16)


# --- nearest neighbours --------------------------------------------------------------------------


def resize_nearest(
    maps: Shaped[AnyArray, "*b H W"], size: Sequence[int]
) -> Shaped[AnyArray, "*b {size[0]} {size[1]}"]:
    """(..., H, W) to (..., *size), NumPy or JAX: each pixel is the one that lies under its centre.

    Pixel i of n takes pixel floor((i + 1/2) N / n) of N: centres lie at i + 1/2, as in
    `contract.CameraProfile`. At a factor of 2 that is pixel 1, 3, 5, ...; OpenCV's INTER_NEAREST takes the
    one under the left edge, floor(i N / n): 0, 2, 4, ... A centre on the line between two pixels is the
    right one's.

    Nothing is interpolated: a hole stays a hole, a depth stays a measured depth.
    """
    if maps.shape[-2:] == tuple(size):
        return maps
    rows, columns = (_under_centres(had, n, had, n) for had, n in zip(maps.shape[-2:], size, strict=True))
    return maps[..., rows[:, None], columns]


def crop_nearest(
    maps: Shaped[AnyArray, "*b H W"], size: Sequence[int]
) -> Shaped[AnyArray, "*b {size[0]} {size[1]}"]:
    """The same after a centred crop to the shape of `size`: both axes are scaled alike."""
    (height, width), (rows, columns) = maps.shape[-2:], size
    had, n = (height, rows) if height * columns <= width * rows else (width, columns)
    return maps[..., _under_centres(height, rows, had, n)[:, None], _under_centres(width, columns, had, n)]


def window(had: Sequence[int], size: Sequence[int]) -> tuple[int, int]:
    """(height, width) of the largest centred window of a picture `had` (H, W) that has the shape of `size`:
    what `crop_nearest` shows of it."""
    scale = min(had[0] / size[0], had[1] / size[1])
    return round(scale * size[0]), round(scale * size[1])


def at_profile(
    maps: Shaped[np.ndarray, "*b H W"], had: CameraProfile, wanted: CameraProfile
) -> Shaped[np.ndarray, "*b {wanted.height_px} {wanted.width_px}"]:
    """(..., H, W) of the camera `had` to what `wanted` would have seen from the same place, in NumPy.

    Each pixel is the one of `had` that its ray goes through; 0 where there is none. Nothing is interpolated.
    """
    rows = _under_rays(wanted.height_px, wanted.fy_px, wanted.cy_px, had.fy_px, had.cy_px)
    columns = _under_rays(wanted.width_px, wanted.fx_px, wanted.cx_px, had.fx_px, had.cx_px)
    seen = ((rows >= 0) & (rows < had.height_px))[:, None] & ((columns >= 0) & (columns < had.width_px))
    taken = maps[..., rows.clip(0, had.height_px - 1)[:, None], columns.clip(0, had.width_px - 1)]
    return np.where(seen, taken, maps.dtype.type(0))


def _under_rays(out: int, focal_px: float, middle_px: float, had_focal_px: float, had_middle_px: float):
    """(out,) pixels of an axis, floor(f' (i + 1/2 - c) / f + c'), possibly outside the picture."""
    at = (np.arange(out) + 0.5 - middle_px) * (had_focal_px / focal_px) + had_middle_px
    return np.floor(at).astype(int)


def _under_centres(length: int, out: int, had: int, n: int) -> np.ndarray:
    """(out,) pixels of an axis under the centres of `out` pixels that are had / n wide and centred on it.

    floor((i + 1/2) s + (length - out s) / 2), s = had / n, in whole numbers: floats miss ties.
    """
    return ((2 * np.arange(out) + 1 - out) * had + length * n) // (2 * n)
