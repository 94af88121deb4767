"""Folders of pictures as sources of recordings: depth/ beside colour, named alike or by their times."""

import json
from collections.abc import Iterator, Sequence
from itertools import islice
from pathlib import Path
from statistics import mode
from typing import Any

import cv2
import numpy as np

from ddgrasp.contract import DEPTH_UNIT_M
from ddgrasp.errors import UserError
from ddgrasp.files import DAMAGED_JSON
from sensors.recordings.pictures import decoded
from sensors.recordings.recording import COLOR_AS_STORED, META_FILE, UNIT_IS_CERTAIN, check_fields
from sensors.recordings.sources import (
    COLOR_SUFFIXES,
    RawFrame,
    Source,
    has_alone_between,
    in_time,
    is_depth,
    moment,
    opened,
    paired,
    visible,
)
from sensors.recordings.writer import BEGUN_FILE

COLOR_FOLDERS = ("color", "colour", "rgb", "image")
_COLOR_NAMES = ", ".join(f"{name}/" for name in COLOR_FOLDERS)
DEPTH_SUFFIXES = (".png", ".npy", ".tif", ".tiff")
LOOKED_AT = 9
"""Pictures, from the first to the last, that say of which size and kind a folder's are."""
KEPT_META = (
    "sensor", "fx_px", "baseline_m", "hz", "consecutive_frames", "color_aligned_to_depth", "repeated_frames",
    "licence", "source", UNIT_IS_CERTAIN,
)  # fmt: skip
"""What is taken over of a folder's own meta.json."""


def folder_sources(root: Path, depth_unit_m: float, meta: dict[str, Any]) -> tuple[list[Source], list[str]]:
    """`root` if it has depth/ and a colour folder, else every folder in it that does; why others are refused.

    A name that begins with a dot is passed over: a recording that is not finished has one.

    Raises:
        UserError: neither, or every one was refused.
    """
    inside = visible(root)
    folders = [root] if is_pair(root) else [p for p in inside if is_pair(p)]
    if not folders:
        raise UserError(
            f"{root}: no depth/ beside one of {_COLOR_NAMES} in it or in its folders; put the pictures "
            "there, named alike."
        )
    sources, refused = opened(folders, lambda folder: folder_source(folder, depth_unit_m, meta))
    without = (p for p in inside if (p / "depth").is_dir() and not is_pair(p))
    passed_over = (f"{p}: depth/ without one of {_COLOR_NAMES} beside it." for p in without)
    return sources, [*refused, *(() if folders == [root] else passed_over)]


def folder_source(folder: Path, depth_unit_m: float, meta: dict[str, Any]) -> Source:
    """Pictures depth/*.png (16 bits), .npy or .tif, matched with those of the colour folder (`paired`).

    `depth_unit_m` 0 takes that of the folder's own meta.json, if it is or was a recording; without one,
    millimetres for integers, metres for floats; of another size or kind than most are, pictures are left out
    then. `meta` comes before that file's KEPT_META.

    Raises:
        UserError: no depth pictures, two files of one name, or a meta.json that is none.
    """
    files = _named_once(sorted(_pictures(folder / "depth", DEPTH_SUFFIXES), key=in_time))
    if not files:
        raise UserError(f"{folder / 'depth'}: no depth pictures; expected {', '.join(DEPTH_SUFFIXES)}.")
    own = _own_meta(folder / META_FILE) or _own_meta(folder / BEGUN_FILE)
    depth_unit_m = depth_unit_m or own.get("depth_unit_m", 0.0)
    by_kind = not depth_unit_m
    shape, floats = _most(files, by_kind)
    if by_kind:
        depth_unit_m = 1.0 if floats else DEPTH_UNIT_M
    colors = _named_once(_colors(folder))
    pairs, note = paired(files, colors)
    by_name = not note  # by time, a faster colour stream has pictures of its own
    gaps = (own.get("frames") or 0) > len(files) or (by_name and has_alone_between(colors, pairs.values()))

    def frames() -> Iterator[RawFrame]:
        for file in files:
            color = pairs.get(file)
            yield RawFrame(file.name, _read_depth(file), None if color is None else _read_rgb(color))

    kept = {name: own[name] for name in KEPT_META if name in own}
    certain = bool(kept.pop(UNIT_IS_CERTAIN, False)) and depth_unit_m == own.get("depth_unit_m")
    return Source(
        folder, frames, depth_unit_m, {**kept, **meta}, shape, floats if by_kind else None, certain,
        has_gaps=gaps, note=note,
    )  # fmt: skip


def _most(files: Sequence[Path], by_kind: bool) -> tuple[tuple[int, ...] | None, bool | None]:
    """(size of depth, whether it is floating-point) of most of `LOOKED_AT` of the `files`, or else of the
    first that is depth at all; `by_kind`: the size of those of that kind."""

    def kinds(some: Sequence[Path]) -> Iterator[tuple[tuple[int, ...], bool]]:
        read = (depth for depth in map(_read_depth, some) if depth is not None and is_depth(depth))
        return ((depth.shape, depth.dtype.kind == "f") for depth in read)

    seen = list(kinds(files[:: -(-len(files) // LOOKED_AT)])) or list(islice(kinds(files), 1))
    if not seen:
        return None, None
    floats = mode(kind for _, kind in seen)
    return mode(shape for shape, kind in seen if kind == floats or not by_kind), floats


def _named_once(files: Sequence[Path]) -> list[Path]:
    """Those of `files`, without what is no depth beside depth of its name, as pictures for people are.

    Raises UserError for two of depth, or of colour, of one name: each would be a frame, in a unit of its own.
    """
    named: dict[str, list[Path]] = {}
    for file in files:
        named.setdefault(moment(file), []).append(file)
    for alike in (alike for alike in named.values() if len(alike) > 1):
        usable = [file for file in alike if (depth := _read_depth(file)) is not None and is_depth(depth)]
        if len(usable) != 1:
            names = " and ".join(file.name for file in alike)
            raise UserError(f"{files[0].parent}: {names} have one name: keep pictures of one type there.")
        named[moment(alike[0])] = usable
    return [file for file in files if file in named[moment(file)]]


def _own_meta(file: Path) -> dict[str, Any]:
    """What a folder's meta.json says, nothing if there is none. Raises UserError if it is none."""
    if not file.exists():
        return {}
    try:
        meta = json.loads(file.read_bytes())
    except (*DAMAGED_JSON, OSError) as error:
        raise UserError(f"{file}: cannot be read ({error}); repair it, or take it away.") from None
    if not isinstance(meta, dict):
        raise UserError(f"{file}: is a {type(meta).__name__}; expected a recording's fields: take it away.")
    unit = meta.get("depth_unit_m", DEPTH_UNIT_M)
    if isinstance(unit, bool) or not isinstance(unit, int | float) or not 0 < unit <= 1:
        raise UserError(f"{file}: depth_unit_m is {unit!r}; expected metres per unit of depth, up to 1.")
    check_fields(file, meta)
    return meta


def is_pair(folder: Path) -> bool:
    """Whether it holds pictures of depth and of colour."""
    return (folder / "depth").is_dir() and any((folder / name).is_dir() for name in COLOR_FOLDERS)


def _pictures(folder: Path, suffixes: Sequence[str]) -> Iterator[Path]:
    """Those of these kinds, but what macOS lays beside each on a drive of another system (`._000000.png`)."""
    names = (p for p in folder.iterdir() if not p.name.startswith("."))
    return (p for p in names if p.suffix.lower() in suffixes)


def _colors(folder: Path) -> list[Path]:
    """The pictures of the first colour folder that has any."""
    inside = (
        sorted(_pictures(folder / name, COLOR_SUFFIXES)) for name in COLOR_FOLDERS if (folder / name).is_dir()
    )
    return next((found for found in inside if found), [])


def _read_depth(file: Path) -> np.ndarray | None:
    if file.suffix.lower() == ".npy":
        try:
            array = np.load(file, allow_pickle=False) if file.is_file() else None
        except (ValueError, EOFError, OSError, MemoryError):  # the last of a header that claims too much
            return None
        return array if isinstance(array, np.ndarray) else None  # several under one name are no picture
    return _read_picture(file, cv2.IMREAD_UNCHANGED)


def _read_rgb(file: Path) -> np.ndarray | None:
    bgr = _read_picture(file, COLOR_AS_STORED)
    return None if bgr is None else cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB)


def _read_picture(file: Path, how: int) -> np.ndarray | None:
    """None of what cannot be read: a folder or a pipe of that name, a bad disk, no permission, no picture."""
    try:
        return decoded(file.read_bytes(), how) if file.is_file() else None  # a pipe would be waited for
    except OSError:
        return None
