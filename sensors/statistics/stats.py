"""What a depth stream's defects measure: holes, their sizes, temporal noise, flicker. NumPy and OpenCV.

Depth is (T, H, W) or (H, W) with 0 = invalid, from cameras uint16 millimetres. Where no unit is named, any
will do, and a mask of the valid pixels, too.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Int, Real, Shaped, UInt16

Stream = Real[np.ndarray, "T H W"]
Frame = Real[np.ndarray, "H W"]

RANGE_MM = 750.0
"""Where temporal deviation is taken, unless told otherwise."""
RANGE_TOLERANCE = 0.1
"""A pixel belongs to a range if its median depth is within 10 % of it."""
STEADY_FRACTION = 0.8
"""Temporal deviation is taken over pixels valid in at least this share of the frames."""


@dataclass(frozen=True)
class DepthStatistics:
    """Defects of a depth stream, averaged over its frames."""

    frames: int
    invalid_fraction: float
    """Share of invalid pixels."""
    hole_components: float
    """8-connected invalid regions per frame."""
    hole_median_px: float
    """Median region size."""
    left_band_px: float
    """Width of the left band in which most rows are invalid."""
    temporal_deviation_mm: float
    """Median over pixels of the standard deviation over time, at `temporal_range_mm` (static scene)."""
    flicker_fraction: float
    """Share of pixels that change validity between consecutive frames."""
    temporal_range_mm: float = RANGE_MM

    def as_dict(self) -> dict[str, float]:
        """Name -> value, for manifests."""
        return asdict(self)


def measure(depth_mm: Stream, range_mm: float = RANGE_MM) -> DepthStatistics:
    """Statistics of a (T, H, W) stream; the temporal ones assume a static scene and camera."""
    return DepthStatistics(
        frames=len(depth_mm),
        **hole_statistics(depth_mm),
        temporal_deviation_mm=temporal_deviation_mm(depth_mm, range_mm),
        flicker_fraction=flicker_fraction(depth_mm),
        temporal_range_mm=range_mm,
    )


def hole_statistics(depth: Stream) -> dict[str, float]:
    """Share of invalid pixels, regions per frame, median region and left band of a (T, H, W) stream, named
    as in `DepthStatistics`.
    """
    sizes = [hole_sizes_px(frame) for frame in depth]
    every = np.concatenate(sizes) if sizes else np.zeros(0)
    return {
        "invalid_fraction": float(np.mean(depth == 0)),
        "hole_components": float(np.mean([len(s) for s in sizes])),
        "hole_median_px": float(np.median(every)) if len(every) else 0.0,
        "left_band_px": float(np.mean([left_band_px(frame) for frame in depth])),
    }


def hole_sizes_px(depth_mm: Frame) -> Int[np.ndarray, " holes"]:
    """(n,) pixel counts of the invalid regions of one (H, W) frame, connected along sides or corners."""
    holes = (depth_mm <= 0).astype(np.uint8)
    _, _, stats, _ = cv2.connectedComponentsWithStats(holes, connectivity=8)
    return stats[1:, cv2.CC_STAT_AREA]


def left_band_px(depth_mm: Frame) -> int:
    """Leading columns of one (H, W) frame of which more than half the pixels are invalid."""
    valid_columns = np.flatnonzero(np.mean(depth_mm == 0, axis=0) <= 0.5)
    return int(valid_columns[0]) if len(valid_columns) else depth_mm.shape[1]


def size_counts(depth: Stream, edges_px: Sequence[float | int]) -> Int[np.ndarray, " bins"]:
    """(bins,) connected invalid regions of a (T, H, W) stream, in any unit, by size."""
    sizes = [hole_sizes_px(frame) for frame in depth]
    return np.histogram(np.concatenate(sizes), edges_px)[0]


def lost_by_bin(
    values: Real[np.ndarray, " n"], lost: Bool[np.ndarray, " n"], edges: Sequence[float | int]
) -> tuple[Int[np.ndarray, " bins"], Int[np.ndarray, " bins"]]:
    """(bins,) invalid pixels and (bins,) pixels between consecutive `edges` of a quantity.

    Args:
      values: (n,) of the pixels that count.
      lost: (n,) bool, whether they are invalid.
    """
    return np.histogram(values[lost], edges)[0], np.histogram(values, edges)[0]


def validity_changes(depth: Shaped[np.ndarray, "T ..."]) -> Bool[np.ndarray, "T-1 ..."]:
    """(T - 1, ...) bool: pixels of a (T, ...) stream whose validity the next frame changes."""
    valid = depth > 0
    return valid[1:] != valid[:-1]


def flicker_fraction(depth_mm: Stream) -> float:
    """Share of pixels of a (T, H, W) stream that change validity from one frame to the next."""
    return float(np.mean(validity_changes(depth_mm))) if len(depth_mm) > 1 else float("nan")


def temporal_deviation_mm(depth_mm: Stream, range_mm: float = RANGE_MM) -> float:
    """Median over pixels near `range_mm` of the deviation over time; nan if there are none."""
    if len(depth_mm) < 2:
        return float("nan")
    values = np.where(depth_mm > 0, depth_mm, np.nan).astype(np.float32)
    steady = np.mean(depth_mm > 0, axis=0) >= STEADY_FRACTION
    values = values[:, steady]
    middle = np.nanmedian(values, axis=0)
    near = np.abs(middle - range_mm) <= RANGE_TOLERANCE * range_mm
    if not near.any():
        return float("nan")
    return float(np.median(np.nanstd(values[:, near], axis=0, ddof=1)))


def decimated(depth_mm: Real[np.ndarray, "H W"], factor: int) -> UInt16[np.ndarray, "h w"]:
    """(H / factor, W / factor) median of the valid pixels per cell, as a D4xx's decimation filter.

    A cell without valid pixels is invalid. Rows and columns that do not fill a cell are dropped.
    """
    height, width = (size // factor * factor for size in depth_mm.shape)
    cells = depth_mm[:height, :width].reshape(height // factor, factor, width // factor, factor)
    cells = np.sort(cells.transpose(0, 2, 1, 3).reshape(height // factor, width // factor, -1), axis=-1)
    valid = np.count_nonzero(cells, axis=-1)
    index = cells.shape[-1] - valid + (valid - 1) // 2
    picked = np.take_along_axis(cells, np.minimum(index, cells.shape[-1] - 1)[..., None], axis=-1)[..., 0]
    return np.where(valid > 0, picked, 0).astype(np.uint16)
