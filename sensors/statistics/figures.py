"""The figures by which two depth cameras are compared, measured from a stream of either. JSON in and out."""

import json
import math
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt16

from ddgrasp.contract import CameraProfile
from sensors.recordings.recording import Recording
from sensors.statistics import curves, stats
from sensors.statistics.curves import STATIC_FRAMES, Curve, Stream

STEPS_PER_PX = 32
"""D4xx cameras report disparity in 1/32 of a native pixel."""
MOST_PIXELS = 64_000_000
"""A recording's that are measured, 157 frames of 848x480: they take 40 bytes a pixel at the peak (100 still
ones of that size, 2026-11-30)."""


@dataclass(frozen=True)
class Figures:
    """Defects of one camera at one picture size."""

    camera: str
    width_px: int
    height_px: int
    frames: int
    scalars: dict[str, float] = field(default_factory=dict)
    """By name: see `SCALARS`; nan where the stream cannot tell."""
    curves: dict[str, Curve] = field(default_factory=dict)
    """By name: see `CURVES`."""


SCALARS = {
    "invalid_fraction": "invalid pixels",
    "hole_components": "holes per frame",
    "holes_per_10k_px": "holes per 10,000 px",
    "hole_median_px": "median hole, px",
    "left_band_px": "left invalid band, px",
    "left_band_excess_px": "left band beyond the disparity there, px",
    "shadow_invalid": "invalid in occlusion shadows",
    "temporal_deviation_mm": f"deviation over time at {stats.RANGE_MM / 1000:g} m, mm",
    "flicker_fraction": "validity flicker",
    "grid_share": "depths on the 1/32 px grid",
}
"""Scalars and how they are printed."""
CURVES = {
    "edge_px": "invalid by distance to a depth edge, px",
    "flicker_edge": "validity flicker by distance to a depth edge, px",
    "angle_deg": "invalid by incidence angle, degrees",
    "depth_m": "invalid by depth, m",
    "spectrum": "holes per 10,000 px by size, px",
    "temporal_px": "deviation over time by depth (m), px of disparity",
    "spatial_px": "deviation from a local plane by depth (m), px of disparity",
}
"""Curves and how they are printed."""


def measure(camera: str, stream: Stream, steps_per_px: float) -> Figures:
    """All figures of a stream; `steps_per_px` is the camera's disparity grid at this picture size."""
    depth = stream.depth_mm
    conditional, shadow_invalid = curves.by_surface(stream)
    holes = stats.hole_statistics(depth)
    height, width = depth.shape[1:]
    band = holes["left_band_px"]
    deviations = [stats.temporal_deviation_mm(depth[run]) for run in stream.static]
    scalars = {
        **holes,
        "holes_per_10k_px": 1e4 * holes["hole_components"] / (height * width),
        "left_band_excess_px": band - _left_disparity_px(stream, round(band)),
        "shadow_invalid": shadow_invalid,
        "temporal_deviation_mm": _mean(deviations),
        "flicker_fraction": curves.flicker(stream),
        "grid_share": curves.grid_share(depth, stream.fb_px_m, steps_per_px),
    }
    return Figures(
        camera,
        width,
        height,
        len(depth),
        scalars,
        {
            **conditional,
            "flicker_edge": curves.flicker_by_edge(stream),
            "spectrum": curves.hole_spectrum(stream),
            "temporal_px": curves.temporal_deviation_px(stream),
        },
    )


def measured_frames(recording: Recording) -> int:
    """How many of a recording's frames, the first ones, are measured: those that fit into MOST_PIXELS."""
    most = MOST_PIXELS // (recording.height_px * recording.width_px)
    return min(len(recording), max(most, STATIC_FRAMES))


def stream_of(recording: Recording, factor: int = 1) -> Stream:
    """A recording's frames (`measured_frames`), decimated by `factor`, with the baseline of its sensor.

    Raises:
        UserError: focal length or sensor unknown (`Recording.optics`).
    """
    fx_px, baseline_m = recording.optics()
    depth = np.stack([recording.depth_mm(i) for i in range(measured_frames(recording))])
    fb_px_m = fx_px * baseline_m
    static = curves.static_runs(depth, fb_px_m) if recording.consecutive else ()
    if factor > 1:
        depth = np.stack([stats.decimated(frame, factor) for frame in depth])
    return Stream(depth, fx_px / factor, fb_px_m / factor, static)


def rig_stream(depth_mm: UInt16[np.ndarray, "frames H W"], profile: CameraProfile, scenes: int) -> Stream:
    """(scenes * n, H, W) frames of the rig's camera, n consecutive ones of each standing scene."""
    per_scene = len(depth_mm) // scenes
    static = tuple(slice(i * per_scene, (i + 1) * per_scene) for i in range(scenes))
    return Stream(depth_mm, profile.fx_px, profile.fx_px * profile.baseline_m, static)


def _left_disparity_px(stream: Stream, band_px: int) -> float:
    """Median disparity just right of the left band: as wide as the band is by geometry."""
    beside = stream.depth_mm[:, :, band_px : band_px + max(4, stream.depth_mm.shape[2] // 40)]
    valid = beside[beside > 0]
    return 1000.0 * stream.fb_px_m / float(np.median(valid)) if len(valid) else float("nan")


def _mean(values: list[float]) -> float:
    finite = [v for v in values if math.isfinite(v)]
    return float(np.mean(finite)) if finite else float("nan")


# --- files -----------------------------------------------------------------------------------------


def to_json(figures: Figures) -> dict[str, Any]:
    """Plain values, nan as None, four significant digits."""
    return _plain(asdict(figures))


def from_json(values: dict[str, Any]) -> Figures:
    """The inverse of `to_json`, to its precision."""
    made = {
        name: Curve(
            tuple(c["edges"]), tuple(float("nan") if v is None else v for v in c["value"]), tuple(c["count"])
        )
        for name, c in values.get("curves", {}).items()
    }
    scalars = {k: float("nan") if v is None else v for k, v in values["scalars"].items()}
    return Figures(values["camera"], values["width_px"], values["height_px"], values["frames"], scalars, made)


def published() -> list[Figures]:
    """Figures of real cameras that come with the package (sensors/statistics/real_figures.json)."""
    file = Path(__file__).with_name("real_figures.json")
    return [from_json(values) for values in json.loads(file.read_bytes())["figures"]]


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {k: _plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    if isinstance(value, float):
        return float(f"{value:.4g}") if math.isfinite(value) else None
    return value
