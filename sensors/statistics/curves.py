"""How a depth stream's defects depend on the scene: by depth, edge distance, incidence angle, size. NumPy.

A camera delivers no ground truth, so the surface behind each pixel is estimated from the depth picture
itself (holes filled from the background, `sensors/statistics/holes.py`). Simulated and real frames go through
the same estimate, which is what makes their curves comparable; where it errs, it errs alike.

Disparity here is f B / z in pixels of the pictures given, whatever step the camera reports it in.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Real, UInt16

from sensors.models import planes
from sensors.statistics import stats
from sensors.statistics.holes import fill_from_background

DEPTH_BINS_M = (0.3, 0.5, 0.7, 0.9, 1.2, 1.6, 2.2, 3.0)
EDGE_BINS_PX = (0.0, 1.5, 3.0, 5.0, 8.0, 12.0, 20.0, 40.0)
ANGLE_BINS_DEG = (0.0, 15.0, 30.0, 45.0, 60.0, 75.0, 90.0)
SIZE_BINS_PX = (1, 2, 4, 8, 16, 32, 64, 128, 256, 1 << 30)

RATE_BINS = {"depth_m": DEPTH_BINS_M, "edge_px": EDGE_BINS_PX, "angle_deg": ANGLE_BINS_DEG}

EDGE_RATIO = 1.08
"""Neighbouring depths further apart than this are two surfaces."""
NORMAL_WINDOW_PX = 9
"""Normals are taken over this window, and only where no edge lies within it."""
PLANE_WINDOW_PX = 7
SHADOW_MARGIN_PX = 2
"""This close to an estimated shadow, rates count nothing: its place is only estimated."""
BORDER_PX = 2
"""Pixels along the picture's border that no curve counts."""
FEWEST = 200
"""Bins with fewer pixels say nothing: nan."""
STATIC_RATIO = 1.1
"""Frames stand still if they change at most this much more than the quietest tenth of the pairs."""
STATIC_FRAMES = 4
FB_TOLERANCE = 5e-4


@dataclass(frozen=True)
class Stream:
    """Depth frames of one camera and what turns them into disparity."""

    depth_mm: Real[np.ndarray, "T H W"]
    """(T, H, W), from cameras uint16; 0 = invalid."""
    fx_px: float
    """Focal length; pixels are square and the principal point is the picture's centre."""
    fb_px_m: float
    """Focal length times baseline."""
    static: tuple[slice, ...] = ()
    """Runs of frames in which neither the scene nor the camera moves."""


@dataclass(frozen=True)
class Surface:
    """What a picture's pixels probably look at, (H, W) each."""

    depth_m: Float32[np.ndarray, "H W"]
    edge_px: Float32[np.ndarray, "H W"]
    """Distance to the nearest depth edge."""
    angle_deg: Float[np.ndarray, "H W"]
    """Between the ray and the surface's normal; nan near edges."""
    seen: Bool[np.ndarray, "H W"]
    """bool: both imagers see the point, and the border is not near."""
    shadow: Bool[np.ndarray, "H W"]
    """bool: the right imager's picture would have the point, but a nearer surface covers it there."""


@dataclass(frozen=True)
class Curve:
    """One value per bin between consecutive `edges`; nan where too few pixels fell."""

    edges: tuple[float, ...]
    value: tuple[float, ...]
    count: tuple[int, ...]


def surface(depth_mm: Real[np.ndarray, "H W"], fx_px: float, fb_px_m: float) -> Surface:
    """Estimates the surface behind one (H, W) picture."""
    inverse = np.divide(1000.0, depth_mm, out=np.zeros(depth_mm.shape, np.float32), where=depth_mm > 0)
    inverse = cv2.medianBlur(fill_from_background(inverse), 5)
    inverse = np.maximum(inverse, np.float32(1e-3))
    edge_px = _edge_distance_px(inverse)
    angle = _incidence_deg(inverse, fx_px)
    angle[edge_px <= NORMAL_WINDOW_PX / 2 + 1] = np.nan
    right_px = np.arange(depth_mm.shape[1], dtype=np.float32)[None, :] - fb_px_m * inverse
    shadow = _covered(right_px)
    seen = right_px > BORDER_PX
    seen[:BORDER_PX] = seen[-BORDER_PX:] = seen[:, -BORDER_PX:] = False
    near_shadow = cv2.dilate(shadow.astype(np.uint8), np.ones((1, 2 * SHADOW_MARGIN_PX + 1), np.uint8)) > 0
    return Surface(1.0 / inverse, edge_px, angle, seen & ~near_shadow, seen & shadow)


def _covered(right_px: np.ndarray) -> np.ndarray:
    """(H, W): whether a point further right in the row comes to lie left of this one in the right picture.

    `right_px` is the column there. Then the other point is nearer and covers this one.
    """
    leftmost = np.minimum.accumulate(right_px[:, ::-1], axis=1)[:, ::-1]
    covered = np.zeros(right_px.shape, bool)
    covered[:, :-1] = leftmost[:, 1:] < right_px[:, :-1]
    return covered


def _edge_distance_px(inverse: np.ndarray) -> np.ndarray:
    """Pixels whose right or lower neighbour lies on another surface, and the distance to them."""
    edge = np.zeros(inverse.shape, bool)
    for here, there in ((np.s_[:, :-1], np.s_[:, 1:]), (np.s_[:-1], np.s_[1:])):
        a, b = inverse[here], inverse[there]
        edge[here] |= np.maximum(a, b) > EDGE_RATIO * np.minimum(a, b)
    return cv2.distanceTransform((~edge).astype(np.uint8), cv2.DIST_L2, 5)


def _incidence_deg(inverse: np.ndarray, fx_px: float) -> np.ndarray:
    """Inverse depth is affine in the picture of a plane n . X = 1: n = (f w_u, f w_v, w - w_u u - w_v v)."""
    (w_u, w_v), w = planes.slopes(inverse, NORMAL_WINDOW_PX)
    height, width = inverse.shape
    u = (np.arange(width, dtype=np.float32) + 0.5 - width / 2)[None, :]
    v = (np.arange(height, dtype=np.float32) + 0.5 - height / 2)[:, None]
    normal = np.sqrt((fx_px * w_u) ** 2 + (fx_px * w_v) ** 2 + (w - w_u * u - w_v * v) ** 2)
    ray = np.sqrt(1.0 + (u / fx_px) ** 2 + (v / fx_px) ** 2)
    return np.degrees(np.arccos(np.clip(np.abs(w) / (normal * ray), 0.0, 1.0)))


# --- invalid pixels --------------------------------------------------------------------------------


def by_surface(stream: Stream) -> tuple[dict[str, Curve], float]:
    """Curves that need the estimated surface, and the share of invalid pixels in occlusion shadows.

    "depth_m", "edge_px", "angle_deg": share of invalid pixels. Pixels that one imager cannot see (left band,
    shadow of a nearer surface) are left out: they follow from the baseline. Depth and angle count pixels away
    from edges alone. "spatial_px": median over windows of the disparity's deviation from a local plane.
    """
    tallies = [_tally(frame, stream) for frame in stream.depth_mm]
    made = {}
    for name, bins in RATE_BINS.items():
        lost, count = (np.sum([t.rates[name][i] for t in tallies], axis=0) for i in (0, 1))
        made[name] = _curve(bins, lost / np.maximum(count, 1), count)
    ranges, deviations = (np.concatenate([t.spatial[i] for t in tallies]) for i in (0, 1))
    made["spatial_px"] = _medians(DEPTH_BINS_M, ranges, deviations)
    lost, count = (sum(t.shadow[i] for t in tallies) for i in (0, 1))
    return made, lost / count if count else float("nan")


@dataclass(frozen=True)
class _Tally:
    """What one frame adds to the curves."""

    rates: dict[str, tuple[np.ndarray, np.ndarray]]
    """Per curve: invalid pixels and pixels in each bin."""
    shadow: tuple[int, int]
    spatial: tuple[np.ndarray, np.ndarray]
    """Range and deviation of windows without a hole."""


def _tally(frame: np.ndarray, stream: Stream) -> _Tally:
    s, lost = surface(frame, stream.fx_px, stream.fb_px_m), frame == 0
    inside = s.seen & (s.depth_m >= DEPTH_BINS_M[0]) & (s.depth_m < DEPTH_BINS_M[-1])
    smooth = inside & np.isfinite(s.angle_deg)
    counted = {
        "depth_m": (s.depth_m, smooth),
        "edge_px": (s.edge_px, inside),
        "angle_deg": (s.angle_deg, smooth),
    }
    rates = {
        name: stats.lost_by_bin(values[where], lost[where], RATE_BINS[name])
        for name, (values, where) in counted.items()
    }
    kernel = np.ones((PLANE_WINDOW_PX, PLANE_WINDOW_PX), np.uint8)
    whole = (cv2.erode((~lost).astype(np.uint8), kernel) > 0) & s.seen & (s.edge_px > PLANE_WINDOW_PX)
    deviation = _plane_deviation(_disparity(frame, stream.fb_px_m))
    shadow = int(np.count_nonzero(s.shadow & lost)), int(np.count_nonzero(s.shadow))
    return _Tally(rates, shadow, (s.depth_m[whole], deviation[whole]))


def hole_spectrum(stream: Stream) -> Curve:
    """Holes per 10,000 pixels, by their size in pixels."""
    count = stats.size_counts(stream.depth_mm, SIZE_BINS_PX)
    pixels = stream.depth_mm.size
    return Curve(
        tuple(map(float, SIZE_BINS_PX)), tuple((1e4 * count / pixels).tolist()), tuple(map(int, count))
    )


# --- noise -----------------------------------------------------------------------------------------


def temporal_deviation_px(stream: Stream) -> Curve:
    """Median over pixels of the standard deviation of disparity over time, by range, in the static runs."""
    ranges, deviations = [np.zeros(0)], [np.zeros(0)]
    for run in stream.static:
        frames = stream.depth_mm[run]
        steady = np.mean(frames > 0, axis=0) >= stats.STEADY_FRACTION
        disparity = _disparity(frames[:, steady], stream.fb_px_m)
        ranges.append(stream.fb_px_m / np.nanmedian(disparity, axis=0))
        deviations.append(np.nanstd(disparity, axis=0, ddof=1))
    return _medians(DEPTH_BINS_M, np.concatenate(ranges), np.concatenate(deviations))


def _plane_deviation(disparity_px: np.ndarray) -> np.ndarray:
    """(H, W) standard deviation from the least-squares plane of each window."""
    # The border as in the published figures.
    variance, _ = planes.residual_variance(
        np.nan_to_num(disparity_px), PLANE_WINDOW_PX, cv2.BORDER_REFLECT_101
    )
    count = PLANE_WINDOW_PX**2
    return np.sqrt(variance * count / (count - 3))


def flicker(stream: Stream) -> float:
    """Share of pixels that change validity from frame to frame in the static runs; nan without one."""
    changes = [
        np.mean(pair) for run in stream.static for pair in stats.validity_changes(stream.depth_mm[run])
    ]
    return float(np.mean(changes)) if changes else float("nan")


def flicker_by_edge(stream: Stream) -> Curve:
    """Share of pixels that change validity from frame to frame, by distance to an edge, in the static runs.

    Over the pixels that both imagers see, within the range of the other curves.
    """
    changed, count = (np.zeros(len(EDGE_BINS_PX) - 1) for _ in range(2))
    for run in stream.static:
        frames = stream.depth_mm[run]
        s = surface(_typical_mm(frames), stream.fx_px, stream.fb_px_m)
        rate = np.mean(stats.validity_changes(frames), axis=0)
        inside = s.seen & (s.depth_m >= DEPTH_BINS_M[0]) & (s.depth_m < DEPTH_BINS_M[-1])
        count += np.histogram(s.edge_px[inside], EDGE_BINS_PX)[0]
        changed += np.histogram(s.edge_px[inside], EDGE_BINS_PX, weights=rate[inside])[0]
    return _curve(EDGE_BINS_PX, changed / np.maximum(count, 1), count)


def _typical_mm(frames_mm: Real[np.ndarray, "T H W"]) -> UInt16[np.ndarray, "H W"]:
    """(H, W) uint16: the lower median over time of pixels valid in most frames, others 0."""
    ordered = np.sort(frames_mm, axis=0)
    valid = np.count_nonzero(frames_mm, axis=0)
    middle = np.minimum(len(frames_mm) - valid + (valid - 1) // 2, len(frames_mm) - 1)
    typical = np.take_along_axis(ordered, middle[None], axis=0)[0]
    return np.where(valid > len(frames_mm) / 2, typical, 0).astype(np.uint16)


def static_runs(depth_mm: Real[np.ndarray, "T H W"], fb_px_m: float) -> tuple[slice, ...]:
    """Runs of at least STATIC_FRAMES consecutive frames of a (T, H, W) recording that stand still.

    The median change of disparity between two frames has a floor, the camera's noise; a pair near the
    quietest tenth of the pairs is taken to stand still; one that shares no valid pixel is not. Nor is a frame
    that comes again to the bit, which no camera measures twice.
    """
    pairs = zip(depth_mm[:-1], depth_mm[1:], strict=True)
    change = np.array([_change_px(before, after, fb_px_m) for before, after in pairs])
    if np.isnan(change).all():
        return ()
    still = change <= STATIC_RATIO * np.nanquantile(change, 0.1)
    runs, start = [], 0
    for t in range(len(still) + 1):
        if t == len(still) or not still[t]:
            if t + 1 - start >= STATIC_FRAMES:
                runs.append(slice(start, t + 1))
            start = t + 1
    return tuple(runs)


def grid_share(depth_mm: Real[np.ndarray, "*shape"], fb_px_m: float, steps_per_px: float) -> float:
    """Share of depths that lie on the grid of disparities k / steps_per_px, where the grid is visible.

    Visible: neighbouring grid depths at least 4 mm apart, so that by chance a quarter would lie on it. f B is
    known to about a thousandth, the grid is finer: the best f B within FB_TOLERANCE counts. nan if no depth
    is that far.
    """
    fb = 1000.0 * fb_px_m * steps_per_px
    values, count = np.unique(depth_mm[depth_mm > np.sqrt(4.0 * fb)], return_counts=True)
    if not len(values):
        return float("nan")
    candidates = fb * np.linspace(1 - FB_TOLERANCE, 1 + FB_TOLERANCE, 41)[:, None]
    away_mm = np.abs(candidates / np.rint(candidates / values) - values)
    return float(np.max((away_mm <= 0.51) @ count) / count.sum())


def _disparity(depth_mm: np.ndarray, fb_px_m: float) -> np.ndarray:
    """float32 pixels, nan where invalid."""
    depth = np.where(depth_mm > 0, depth_mm, np.nan).astype(np.float32)
    return np.float32(1000.0 * fb_px_m) / depth


def _change_px(before_mm: np.ndarray, after_mm: np.ndarray, fb_px_m: float) -> np.floating:
    """Median change of disparity; nan where nothing is shared, or `after_mm` is `before_mm` again."""
    if np.array_equal(before_mm, after_mm):
        return np.float32("nan")
    return _median_valid(np.abs(_disparity(before_mm, fb_px_m) - _disparity(after_mm, fb_px_m)))


def _median_valid(values: np.ndarray) -> np.floating:
    """The median of those that are no nan; nan if all are."""
    valid = values[~np.isnan(values)]
    return np.median(valid) if len(valid) else np.float32("nan")


def _medians(edges: Sequence[float], where: np.ndarray, values: np.ndarray) -> Curve:
    index = np.digitize(where, edges) - 1
    groups = [values[index == i] for i in range(len(edges) - 1)]
    medians = [float(np.median(group)) if len(group) else float("nan") for group in groups]
    return _curve(edges, medians, [len(group) for group in groups])


def _curve(edges: Sequence[float], values, counts) -> Curve:
    shown = [float(v) if n >= FEWEST else float("nan") for v, n in zip(values, counts, strict=True)]
    return Curve(tuple(float(e) for e in edges), tuple(shown), tuple(int(n) for n in counts))
