"""Hole-level measures of depth maps: where holes are, how large, how steady, and what valid pixels are worth.

Everything is kept as sums over an episode, so that episodes add up and can be resampled. NumPy and OpenCV.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from itertools import combinations
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float, Float32, Real

from ddgrasp.arrays import AnyArray
from foundation.depth_feature_data import depth_edges
from sensors.statistics import stats

DEPTH_EDGES_M = (0.0, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0, 1.2, 1.5, 2.0, 3.0, 4.0, 6.0, np.inf)
EDGE_DISTANCE_PX = (0, 1, 2, 3, 4, 6, 8, 12, 16, 24, np.inf)
INCIDENCE_DEG = (0, 10, 20, 30, 40, 50, 60, 70, 80, 90.001)
BINS: dict[str, Sequence[float]] = {
    "depth_m": DEPTH_EDGES_M, "edge_distance_px": EDGE_DISTANCE_PX, "incidence_deg": INCIDENCE_DEG,
}  # fmt: skip
"""Quantities of the clean geometry that hole rates are drawn against, and their bins' edges."""
SIZE_EDGES_PX = (*(2**b for b in range(17)), np.inf)
"""Hole sizes 1, 2-3, 4-7, ... pixels."""
OUTLIER_M = 0.05
"""A valid pixel farther than this from the clean depth is an outlier."""

Sums = dict[str, Real[AnyArray, "..."]]
"""Numbers (NumPy scalars once added up), and counts per bin."""
Depth = Float[np.ndarray, "H W"]


# --- geometry ------------------------------------------------------------------------------------


def geometry(clean_m: Depth, focal_px: float) -> dict[str, Depth]:
    """The quantities of BINS per pixel of (H, W) clean depth in metres."""
    return {
        "depth_m": clean_m,
        "edge_distance_px": edge_distance_px(clean_m),
        "incidence_deg": incidence_deg(clean_m, focal_px),
    }


def edge_distance_px(clean_m: Depth) -> Float32[np.ndarray, "H W"]:
    """(H, W) pixels to the nearest depth edge; 0 on one, the diagonal where there is none."""
    edges = depth_edges(clean_m)
    if not edges.any():
        return np.full(clean_m.shape, np.hypot(*clean_m.shape), np.float32)
    return cv2.distanceTransform((~edges).astype(np.uint8), cv2.DIST_L2, 5)


def incidence_deg(clean_m: Depth, focal_px: float) -> Depth:
    """(H, W) degrees between the line of sight and the surface normal, from the depth of neighbours.

    The principal point is the picture's centre.
    """
    height, width = clean_m.shape
    x = (np.arange(width, dtype=np.float32) + 0.5 - width / 2)[None] / focal_px
    y = (np.arange(height, dtype=np.float32) + 0.5 - height / 2)[:, None] / focal_px
    points = np.stack([x * clean_m, y * clean_m, clean_m], axis=-1)
    across, down = np.gradient(points, axis=1), np.gradient(points, axis=0)
    normal = np.cross(across, down)
    scale = np.linalg.norm(normal, axis=-1) * np.linalg.norm(points, axis=-1)
    cosine = np.abs(np.sum(normal * points, axis=-1)) / np.maximum(scale, 1e-12)
    return np.degrees(np.arccos(np.clip(cosine, 0, 1)))


# --- sums over an episode --------------------------------------------------------------------------


def episode_sums(
    depth_m: Float[np.ndarray, "T H W"],
    clean_m: Float[np.ndarray, "T H W"],
    places: Sequence[Mapping[str, Any]],
) -> Sums:
    """Hole sums of maps (T, H, W) in time order over the clean geometry they show.

    `places` is the `geometry` of each frame. Errors and rates by place are counted
    where the clean geometry has a surface, holes, their sizes and how they change over the whole picture.
    """
    holes, surface = depth_m <= 0, clean_m > 0
    both = ~holes & surface
    error = (depth_m - clean_m)[both].astype(np.float64)
    changed = stats.validity_changes(depth_m)
    sums: Sums = {
        "pixels": np.array(holes.size), "holes": np.array(holes.sum()), "frames": np.array(len(depth_m)),
        "valid": np.array(both.sum()), "error": np.array(error.sum()),
        "squared_error": np.array((error**2).sum()),
        "outliers": np.array((np.abs(error) > OUTLIER_M).sum()),
        "pairs": np.array(changed.size), "changed": np.array(changed.sum()),
        "hole_before": np.array(holes[:-1].sum()), "hole_stayed": np.array((holes[1:] & holes[:-1]).sum()),
        "size_counts": stats.size_counts(depth_m, SIZE_EDGES_PX),
    }  # fmt: skip
    for name, edges in BINS.items():
        values = np.stack([place[name] for place in places])
        lost, count = stats.lost_by_bin(values[surface], holes[surface], edges)
        sums[f"{name}_pixels"], sums[f"{name}_holes"] = count, lost
    return sums


def repeat_sums(depth_m: Float[np.ndarray, "K H W"]) -> Sums:
    """Hole sums of one motionless scene sensed again and again, (K, H, W) metres."""
    holes = depth_m <= 0
    overlaps = [
        (a & b).sum() / union
        for a, b in combinations(holes, 2)
        if (union := (a | b).sum())  # two pictures without a hole have no overlap to speak of
    ]
    always = ~holes.any(0)
    deviation = np.std(depth_m[:, always], axis=0, ddof=1, dtype=np.float64)
    return {
        "overlap": np.array(sum(overlaps)), "overlap_pairs": np.array(len(overlaps)),
        "still_changed": np.array(stats.validity_changes(depth_m).sum()),
        "still_pairs": np.array(holes[1:].size),
        "deviation": np.array(deviation.sum()), "deviation_pixels": np.array(always.sum()),
    }  # fmt: skip


def added(sums: Sequence[Sums]) -> Sums:
    """Sums of several episodes; one that lacks a quantity (no repeats) adds nothing to it."""
    total: Sums = {}
    for item in sums:
        for name, value in item.items():
            total[name] = total[name] + value if name in total else value
    return total


# --- figures --------------------------------------------------------------------------------------


SHARES = (
    "invalid_share", "flicker", "persistence", "outlier_share", "repeat_iou", "repeat_flicker",
    *(f"gap_{name}" for name in BINS),
)  # fmt: skip
SIGNED = ("bias_mm",)
"""Figures between 0 and 1, and such as may be negative; all others are 0 or more."""


def bounds(names: Iterable[str]) -> dict[str, tuple[float, float]]:
    """(least, most) of each of these figures."""
    return {
        name: (-math.inf if name in SIGNED else 0.0, 1.0 if name in SHARES else math.inf) for name in names
    }


def figures(total: Sums) -> dict[str, float]:
    """Plain numbers; nan where there was nothing to measure."""
    rmse = np.sqrt(_ratio(total, "squared_error", "valid"))
    return {
        "invalid_share": _ratio(total, "holes", "pixels"),
        "components_per_frame": float(total["size_counts"].sum() / total["frames"]),
        "flicker": _ratio(total, "changed", "pairs"),
        "persistence": _ratio(total, "hole_stayed", "hole_before"),
        "rmse_mm": 1000 * float(rmse),
        "bias_mm": 1000 * _ratio(total, "error", "valid"),
        "outlier_share": _ratio(total, "outliers", "valid"),
        "repeat_iou": _ratio(total, "overlap", "overlap_pairs"),
        "repeat_flicker": _ratio(total, "still_changed", "still_pairs"),
        "repeat_deviation_mm": 1000 * _ratio(total, "deviation", "deviation_pixels"),
    }


def curves(total: Sums) -> dict[str, Float[np.ndarray, " _"]]:
    """Hole rate per bin of BINS (nan where no pixel fell), and hole regions per frame by size."""
    with np.errstate(invalid="ignore", divide="ignore"):
        rates = {name: total[f"{name}_holes"] / total[f"{name}_pixels"] for name in BINS}
    return {**rates, "size_px": total["size_counts"] / total["frames"]}


def gaps(total: Sums, real: Sums) -> dict[str, float]:
    """How far the hole-rate curves lie from the real ones: mean |difference| over the real pixels' bins; for
    sizes the sum of |differences| of regions per frame over the real ones."""
    mine, theirs = curves(total), curves(real)
    result = {}
    for name in BINS:
        weight = np.where(total[f"{name}_pixels"] > 0, real[f"{name}_pixels"], 0)
        difference = np.nan_to_num(np.abs(mine[name] - theirs[name]))
        result[f"gap_{name}"] = float((difference * weight).sum() / max(weight.sum(), 1))
    regions = max(float(theirs["size_px"].sum()), 1e-9)
    result["gap_size_px"] = float(np.abs(mine["size_px"] - theirs["size_px"]).sum() / regions)
    return result


def _ratio(total: Sums, above: str, below: str) -> float:
    count = float(total.get(below, np.array(0)))
    return float(total[above]) / count if count else float("nan")
