"""Recordings from elsewhere into the format of `recording.py`: folders of pictures, RealSense files.

Only pictures, what the camera is, and licence and source are kept: no pose, no CAD, no pairing. A frame that
cannot be used is named and left out; a source none of whose frames can be used, or whose depth is in another
unit, is refused.
"""

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ddgrasp.contract import DEPTH_UNIT_M
from ddgrasp.depth import from_counts
from ddgrasp.errors import UserError
from sensors.recordings.folders import folder_sources, is_pair
from sensors.recordings.recording import (
    FARTHEST_MEDIAN_M,
    NEAREST_MEDIAN_M,
    UNIT_CHECK_FRAMES,
    UNIT_IS_CERTAIN,
)
from sensors.recordings.sources import COLOR_SUFFIXES, RawFrame, Source, is_depth, opened, visible
from sensors.recordings.writer import RecordingWriter

MARKER = 2**16 - 1
SAME_SHAPE = 0.02
"""Colour and depth of one view have the same ratio of columns to rows, up to this share."""
REALSENSE_SUFFIXES = (".bag", ".db3")


@dataclass(frozen=True)
class Imported:
    """What became of one source."""

    path: Path
    frames: int
    skipped: tuple[str, ...]
    """Frames left out: name and reason."""
    loss: str = ""
    """What of its depth did not fit into the format, if anything."""
    note: str = ""
    """See `Source`."""
    marked: int = 0
    """Pixels with a mark for "no reading" of the source's own."""
    unlike: str = ""
    """How the shapes of colour and depth differ, which cannot be aligned then; nothing where they do not."""

    @property
    def lines(self) -> list[str]:
        """For people: what was left out, a line each, `loss`, `note`, `unlike`, `marked`."""
        said = [f"left out {what}" for what in self.skipped] + [self.loss] + [self.note] + [self.unlike]
        if self.marked:
            said.append(f"{self.marked} pixels of {MARKER}, the largest number, have no reading now")
        return [f"{self.path}: {text}" for text in said if text]


def import_recording(source: Source, path: Path) -> Imported:
    """Writes the usable frames of `source` to a recording at `path`, which appears only when complete.

    Frames left out between others are a gap: the recording's are not called consecutive then.

    Raises:
        UserError: `path` exists, no usable frame, or depth whose median cannot be a D4xx's in that unit (of
            the first frames alone, where the unit is certain).
        Trouble: the recording of a `source` that cannot be read again could not be ended: says where its
            frames are.
        OSError: a frame could not be written, and `source` keeps none then, or it was the first.
    """
    if os.path.lexists(path):
        raise UserError(f"{source.path}: {path} exists already: delete it, or give another --out.")
    skipped, medians_m, frames, gaps, last = [], [], 0, source.has_gaps, False
    loss, marked, unlike = "", 0, ""
    certain = {UNIT_IS_CERTAIN: True} if source.unit_is_certain else {}
    with RecordingWriter(path, source.meta | certain, keep=source.cut_short is not None) as writer:
        for frame in map(_without_markers, source.frames()):
            medians_m += _median_m(frame, source)
            depth_mm, reason = _usable(frame, source)
            if depth_mm is None or frame.rgb is None:
                skipped.append(f"{frame.name}: {reason}")
                last = False
                continue
            gaps, last = gaps or not (last or not frames), True
            source = replace(source, shape=depth_mm.shape)
            loss = loss or _loss(frame, source.depth_unit_m)
            marked += frame.marked
            unlike = unlike or _unlike(frame.rgb, depth_mm)
            try:
                writer.add(frame.rgb, depth_mm)
            except OSError as error:
                if source.cut_short is None or not frames:
                    raise
                source.cut_short(error)
                break
            frames += 1
            if frames == UNIT_CHECK_FRAMES:  # not after an hour
                _check_unit(source, medians_m)
        writer.meta.update(source.closing_meta())
        if gaps:
            writer.meta["consecutive_frames"] = False
        if writer.meta.get("color_aligned_to_depth") is False:
            unlike = ""  # somebody knows
        elif unlike:
            writer.meta["color_aligned_to_depth"] = False
        if not source.unit_is_certain or frames < UNIT_CHECK_FRAMES:
            _check_unit(source, medians_m)
        if not frames:
            raise UserError(
                f"{source.path}: none of its {len(skipped)} frames can be used "
                f"({skipped[0] if skipped else 'it is empty'})."
            )
    return Imported(path, frames, tuple(skipped), loss, source.note, marked, unlike)


def _unlike(rgb: np.ndarray, depth: np.ndarray) -> str:
    (rows, columns), (high, wide) = depth.shape, rgb.shape[:2]
    if abs(columns * high / (rows * wide) - 1) <= SAME_SHAPE:
        return ""
    return f"colour of {wide}x{high} beside depth of {columns}x{rows} is not aligned to it, and is noted so"


def _loss(frame: RawFrame, unit_m: float) -> str:
    floats = frame.depth is not None and frame.depth.dtype.kind == "f"
    if unit_m >= DEPTH_UNIT_M and not floats:
        return ""
    kind = "floating-point depth" if floats else f"depth in units of {unit_m:g} m"
    return f"{kind} was rounded to whole millimetres, which recordings here have"


def import_all(
    sources: list[Source], out: Path, refused: Sequence[str] = ()
) -> tuple[list[Imported], list[str]]:
    """Imports each source to `out`/<its name>; (what was imported, why others were refused).

    `refused`: why some were before (`find_sources`).

    Raises:
        UserError: every one was refused.
    """
    done, refused, names = [], list(refused), set()
    for source in sources:
        name = _name(source.path)
        if name in names:
            refused.append(f"{source.path}: another one here is called {name}, too: rename one of them.")
            continue
        try:
            done.append(import_recording(source, out / name))
            names.add(name)
        except UserError as error:
            refused.append(str(error))
    if not done:
        raise UserError(refused[0])
    return done, refused


def _name(source: Path) -> str:
    """The name of the recording made of it: a folder's own, a file's without what says its type."""
    source = Path(os.path.abspath(source))  # a link keeps its name
    name = source.stem if source.suffix.lower() in REALSENSE_SUFFIXES else source.name
    return name.lstrip(".") or name  # what a killed recording left has a dot, which a finished one has not


def summary(done: list[Imported], refused: list[str]) -> str:
    """What was imported and left out, counts last."""
    lines = [f"refused: {why}" for why in refused]
    lines += [line for one in done for line in one.lines]
    lines += [f"{one.path}: {one.frames} frames" for one in done]
    frames, skipped = sum(one.frames for one in done), sum(len(one.skipped) for one in done)
    return "\n".join(
        [
            *lines,
            f"{len(done)} recordings with {frames} frames imported; "
            f"left out: {skipped} frames, {len(refused)} recordings",
        ]
    )


def _without_markers(frame: RawFrame) -> RawFrame:
    """`frame` with 0 in the place of 16 bits' largest number: in many a dataset "no reading", and no depth
    that a camera sees."""
    if frame.depth is None or frame.depth.dtype != np.uint16:
        return frame
    marked = frame.depth == MARKER
    depth = np.where(marked, np.uint16(0), frame.depth)
    return replace(frame, depth=depth, marked=int(marked.sum())) if marked.any() else frame


def _usable(frame: RawFrame, source: Source) -> tuple[np.ndarray | None, str]:
    """((H, W) uint16 millimetres, "") or (None, why the frame is left out)."""
    depth, shape = frame.depth, source.shape
    if depth is None:
        return None, "depth cannot be read"
    if not is_depth(depth):
        return None, f"depth is {depth.dtype} {depth.shape}, expected one channel of 16 bits or floats"
    if frame.rgb is None:
        return None, f"colour is missing or cannot be read (a {', '.join(COLOR_SUFFIXES)} of its name)"
    if shape is not None and depth.shape != shape:
        return None, f"depth is {depth.shape[1]}x{depth.shape[0]}, the others' {shape[1]}x{shape[0]}"
    if not _is_of_kind(depth, source):
        others = "floating-point" if source.floats else "integers"
        return (
            None,
            f"depth is {depth.dtype}, the others' {others}: in another unit, to be imported by itself",
        )
    millimetres = from_counts(depth, source.depth_unit_m)
    return (millimetres, "") if millimetres.any() else (None, "no valid depth pixel")


def _median_m(frame: RawFrame, source: Source) -> list[float]:
    """The median of a frame's positive depths in metres; nothing if it has none."""
    depth = frame.depth
    if depth is None or not is_depth(depth) or not _is_of_kind(depth, source):
        return []
    positive = depth[np.isfinite(depth) & (depth > 0)]
    return [float(np.median(positive)) * source.depth_unit_m] if positive.size else []


def _is_of_kind(depth: np.ndarray, source: Source) -> bool:
    return source.floats in (None, depth.dtype.kind == "f")


def _check_unit(source: Source, medians_m: list[float]) -> None:
    median_m = float(np.median(medians_m)) if medians_m else NEAREST_MEDIAN_M
    if NEAREST_MEDIAN_M <= median_m <= FARTHEST_MEDIAN_M:
        return
    far = median_m > FARTHEST_MEDIAN_M
    tens = (10.0**-power for power in range(-9, 10))
    fit = [
        ten * source.depth_unit_m for ten in tens if NEAREST_MEDIAN_M <= ten * median_m <= FARTHEST_MEDIAN_M
    ]
    remedy = f"give its unit, perhaps --depth-unit-m {' or '.join(f'{unit_m:g}' for unit_m in fit)}"
    if source.unit_is_certain:
        remedy = f"point the camera at something {'nearer' if far else 'farther'}"
    raise UserError(
        f"{source.path}: median depth {median_m:.4g} m with {source.depth_unit_m:g} m per unit; expected "
        f"{NEAREST_MEDIAN_M:g} to {FARTHEST_MEDIAN_M:g} m: {remedy}."
    )


# --- anything --------------------------------------------------------------------------------------


def find_sources(path: Path, depth_unit_m: float, meta: dict[str, Any]) -> tuple[list[Source], list[str]]:
    """A RealSense file (`.bag`, `.db3`), a folder of them, or folders of pictures; why others are refused.

    Raises:
        UserError: nothing there that can be imported.
    """
    if not path.exists():
        raise UserError(
            f"{path}: no such file or folder; expected a .bag or .db3, a folder of them, or one of pictures."
        )
    if path.is_file() and path.suffix.lower() not in REALSENSE_SUFFIXES:
        raise UserError(f"{path}: a file of type {path.suffix!r}; expected a RealSense .bag or .db3.")
    inside = [path] if path.is_file() else visible(path)
    files = [file for file in inside if file.suffix.lower() in REALSENSE_SUFFIXES]
    if not files:
        return folder_sources(path, depth_unit_m, meta)
    from sensors.recordings.realsense import file_source

    def given(file: Path) -> Source:
        source = file_source(file)
        source = replace(source, meta={**source.meta, **meta})
        return replace(source, depth_unit_m=depth_unit_m, unit_is_certain=False) if depth_unit_m else source

    sources, refused = opened(files, given)
    passed_over = (
        f"{p}: pictures beside RealSense files: import it by itself." for p in inside if is_pair(p)
    )
    return sources, [*refused, *passed_over]
