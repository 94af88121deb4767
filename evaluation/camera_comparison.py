"""The rig's camera beside real ones: a table, curves as JSON and PNG. Behind `ddgrasp sensors compare`."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ddgrasp import tables
from ddgrasp.config import RecordConfig
from ddgrasp.contract import CameraProfile
from ddgrasp.errors import UserError
from ddgrasp.files import atomic_write_bytes, atomic_write_json, to_png
from ddgrasp.progress import Progress
from mjx_envs.objects import OBJECTS
from rig.scenes import StandingScene, standing_scenes
from sensors.recordings.recording import find_recordings
from sensors.statistics import figures, stats
from sensors.statistics.curves import Curve
from sensors.statistics.figures import CURVES, SCALARS, Figures

PERCENT = {"invalid_fraction", "flicker_fraction", "grid_share", "shadow_invalid"}
"""Scalars printed in per cent; so are the curves of invalid pixels."""
_LABEL_WIDTH, _CELL_WIDTH = 26, 8
"""Characters of a table's first column, which may take several lines, and of its numbers, which must not."""


@dataclass(frozen=True)
class Comparison:
    """`real` and `rig` figures, and what the rig's camera loses of each object."""

    real: list[Figures]
    rig: Figures
    objects: dict[str, dict[str, float]]
    """By name: pixels of the object per frame, share of them invalid, share that flickers."""
    skipped: list[str]
    """Why recordings could not be used, one line each."""


def compare(
    config: RecordConfig,
    profile: CameraProfile,
    real: Path | None,
    *,
    per_object: int,
    frames: int,
    seed: int,
    progress: Progress,
) -> Comparison:
    """Measures the rig on standing scenes of all objects, and the recordings in `real`.

    Without `real`, the figures measured before (`figures.published`) stand in for them.
    """
    known, skipped = (figures.published(), []) if real is None else measure_real(real, profile, progress)
    scenes = []
    with progress.task("rig scenes", per_object * len(OBJECTS)) as task:
        for scene in standing_scenes(config, profile, tuple(OBJECTS), per_object, frames, seed):
            scenes.append(scene)
            task.advance()
    stream = figures.rig_stream(np.concatenate([s.depth_mm for s in scenes]), profile, len(scenes))
    name = f"rig {profile.width_px}x{profile.height_px}"
    rig = figures.measure(name, stream, figures.STEPS_PER_PX)
    return Comparison(known, rig, object_losses(scenes), skipped)


def measure_real(folder: Path, profile: CameraProfile, progress: Progress) -> tuple[list[Figures], list[str]]:
    """Figures of every recording at its own size and decimated to about the rig's; why others were left out.

    Raises:
        UserError: no recording in `folder`, or none with a known focal length and baseline.
    """
    measured, skipped = [], []
    for recording in progress.track(find_recordings(folder), "real recordings"):
        if (taken := figures.measured_frames(recording)) < len(recording):
            progress.note(f"{recording.path}: the first {taken} of {len(recording)} frames are measured")
        decimation = max(1, round(recording.width_px / profile.width_px))
        for factor in sorted({1, decimation}):
            try:
                stream = figures.stream_of(recording, factor)
            except UserError as error:
                skipped.append(str(error))
                break
            height, width = stream.depth_mm.shape[1:]
            name = f"{recording.name} {width}x{height}"
            measured.append(figures.measure(name, stream, figures.STEPS_PER_PX * factor))
    if not measured:
        raise UserError(f"{folder}: none of its recordings can be compared; the first: {skipped[0]}")
    return measured, skipped


def object_losses(scenes: list[StandingScene]) -> dict[str, dict[str, float]]:
    """What the camera loses of each object, over its scenes."""
    names = dict.fromkeys(scene.object_name for scene in scenes)
    return {name: _losses([s for s in scenes if s.object_name == name]) for name in names}


def _losses(scenes: list[StandingScene]) -> dict[str, float]:
    pixels = [scene.depth_mm[:, scene.object_px] for scene in scenes]
    changes = [stats.validity_changes(depth).mean(axis=0) for depth in pixels]
    return {
        "pixels": float(np.mean([depth.shape[1] for depth in pixels])),
        "invalid_fraction": 1.0
        - float(np.mean(np.concatenate([(depth > 0).mean(axis=0) for depth in pixels]))),
        "flicker_fraction": float(np.mean(np.concatenate(changes))),
    }


# --- what is shown ---------------------------------------------------------------------------------


def as_json(result: Comparison) -> dict[str, Any]:
    """Everything measured, as plain values."""
    return {
        "rig": figures.to_json(result.rig),
        "real": [figures.to_json(real) for real in result.real],
        "objects": result.objects,
        "skipped": result.skipped,
    }


def write(result: Comparison, out: Path) -> tuple[Path, Path]:
    """Writes `out`/sensors.json and `out`/sensors.png; returns their paths."""
    json_file, png_file = out / "sensors.json", out / "sensors.png"
    atomic_write_json(json_file, as_json(result))
    atomic_write_bytes(png_file, plot(result))
    return json_file, png_file


def print_tables(result: Comparison) -> None:
    """Prints scalars, curves and losses per object, cameras side by side."""
    console = tables.console()
    groups = side_by_side(result, console.width)
    for group in groups:
        console.print(_table("", group, [(SCALARS[n], [_scalar(n, f) for f in group]) for n in SCALARS]))
    for name, title in CURVES.items():
        for group in groups:
            console.print(_curve_table(name, title, [camera for camera in group if name in camera.curves]))
    console.print(_object_table(result.objects))
    for line in result.skipped:
        console.print(f"left out: {line}", soft_wrap=True)


def side_by_side(result: Comparison, width: int) -> list[list[Figures]]:
    """Groups of cameras, the rig's last in each, whose columns fit into `width` characters uncut."""

    def columns(camera: Figures) -> int:
        return 2 + max(_CELL_WIDTH, len(camera.camera))

    room = width - _LABEL_WIDTH - columns(result.rig)
    groups: list[list[Figures]] = [[]]
    for camera in result.real:
        if groups[-1] and sum(map(columns, groups[-1])) + columns(camera) > room:
            groups.append([])
        groups[-1].append(camera)
    return [[*group, result.rig] for group in groups]


def _curve_table(name: str, title: str, cameras: list[Figures]):
    edges = cameras[-1].curves[name].edges
    rows = [
        (_bin(edges, i), [_value(name, camera.curves[name].value[i]) for camera in cameras])
        for i in range(len(edges) - 1)
    ]
    return _table(title, cameras, rows)


def _table(title: str, cameras: list[Figures], rows: list[tuple[str, list[str]]]):
    names = [camera.camera for camera in cameras]
    return tables.table(("", *names), [(label, *values) for label, values in rows], title, numbers=names)


def _object_table(objects: dict[str, dict[str, float]]):
    shares = ("invalid_fraction", "flicker_fraction")
    rows = [
        (name, f"{loss['pixels']:.0f}", *(f"{100 * loss[share]:.1f} %" for share in shares))
        for name, loss in sorted(objects.items(), key=lambda item: -item[1]["invalid_fraction"])
    ]
    numbers = ("pixels", "invalid", "flicker")
    return tables.table(("object", *numbers), rows, "rig, by object", numbers)


def _scalar(name: str, camera: Figures) -> str:
    value = camera.scalars.get(name, math.nan)
    if not math.isfinite(value):
        return "-"
    return f"{100 * value:.1f} %" if name in PERCENT else f"{value:.3g}"


def _value(name: str, value: float) -> str:
    if not math.isfinite(value):
        return "-"
    return f"{value:.3g}" if name in ("spectrum", "temporal_px", "spatial_px") else f"{100 * value:.1f} %"


def _bin(edges: tuple[float, ...], i: int) -> str:
    return f"{edges[i]:g} +" if edges[i + 1] > 1e6 else f"{edges[i]:g} to {edges[i + 1]:g}"


def plot(result: Comparison) -> bytes:
    """PNG: one panel per curve, one line per camera."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(15, 7), layout="constrained")
    for place, (name, title) in enumerate(CURVES.items(), start=1):
        axes = figure.add_subplot(2, (len(CURVES) + 1) // 2, place)
        for camera in [*result.real, result.rig]:
            if name in camera.curves:
                _line(axes, camera.curves[name], camera.camera, bold=camera is result.rig)
        edges = result.rig.curves[name].edges
        axes.set_xticks(range(len(edges) - 1), [_bin(edges, i) for i in range(len(edges) - 1)], rotation=30)
        axes.set_title(title, fontsize=9)
        axes.set_yscale("log")
        axes.tick_params(labelsize=7)
        axes.grid(alpha=0.3)
    figure.axes[0].legend(fontsize=7)
    return to_png(figure, dpi=110)


def _line(axes, curve: Curve, label: str, bold: bool) -> None:
    value = np.array(curve.value)
    value[value <= 0] = np.nan
    axes.plot(range(len(value)), value, "o-", label=label, linewidth=2.5 if bold else 1.2, markersize=3)
