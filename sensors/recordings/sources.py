"""Where recordings come from: frames in time order, as a file, a folder or a camera has them."""

import re
from bisect import bisect_left
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from decimal import Decimal
from itertools import pairwise
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
from jaxtyping import UInt8

from ddgrasp.errors import UserError

COLOR_SUFFIXES = (".png", ".jpg", ".jpeg")
"""Those of colour pictures, in small or capital letters."""
_ROLE_WORDS = ("depth", "color", "colour", "rgb", "image")


@dataclass(frozen=True)
class RawFrame:
    """One frame as its source has it."""

    name: str
    depth: np.ndarray | None
    """(H, W) counts or floating-point lengths (what is neither is left out); None if it cannot be read."""
    rgb: UInt8[np.ndarray, "h w 3"] | None
    """(h, w, 3) uint8; None if there is none."""
    marked: int = 0
    """Pixels of `depth` that had a mark for "no reading" of their source's own, and are 0."""


@dataclass(frozen=True)
class Source:
    """Frames in time order and what is known about their camera."""

    path: Path
    frames: Callable[[], Iterator[RawFrame]]
    depth_unit_m: float
    """Metres per count of integer depth; for floating-point depth, metres per unit."""
    meta: dict[str, Any]
    """Fields of meta.json."""
    shape: tuple[int, ...] | None = None
    """(rows, columns) of depth; None for those of the first frame that can be used."""
    floats: bool | None = None
    """Whether depth is floating-point; None if one unit is that of both kinds."""
    unit_is_certain: bool = False
    """Whether depths that cannot be a D4xx's are the scene's fault, not the unit's."""
    closing_meta: Callable[[], dict[str, Any]] = dict
    """Fields of meta.json that are known after the last frame alone."""
    has_gaps: bool = False
    """Whether frames were left out, taken away or lost between those there are."""
    note: str = ""
    """What people ought to know of its frames, if anything."""
    cut_short: Callable[[OSError], None] | None = None
    """What is told that a frame could not be written, where the frames before are kept then, since they come
    but once; None keeps none."""


def is_depth(depth: np.ndarray) -> bool:
    """Whether an array can be depth in some unit: one channel of floats, or integers of more than 8 bits."""
    return depth.ndim == 2 and depth.dtype.kind in "iuf" and depth.dtype.itemsize > 1


def opened(paths: Iterable[Path], source_of: Callable[[Path], Source]) -> tuple[list[Source], list[str]]:
    """(the sources of `paths`, why others are refused). Raises UserError if all are."""
    sources, refused = [], []
    for path in paths:
        try:
            sources.append(source_of(path))
        except UserError as error:
            refused.append(str(error))
    if not sources:
        raise UserError(refused[0])
    return sources, refused


def visible(folder: Path) -> list[Path]:
    """What is in it, sorted, but for names that begin with a dot, as what is not finished has."""
    return sorted(p for p in folder.iterdir() if not p.name.startswith("."))


def in_time(file: Path) -> list[tuple[Decimal, str]]:
    """Key that sorts a recording's pictures: numbers in a name count as numbers, 10.png comes after 9.png.

    A point between digits is a decimal point, as in names that are seconds: 4.5.png comes after 4.25.png.
    """
    parts = enumerate(re.split(r"(\d+(?:\.\d+)?)", file.name))  # text and numbers in turn
    return [(Decimal(part), "") if place % 2 else (Decimal(-1), part) for place, part in parts]


def paired(depth: Sequence[Path], color: Sequence[Path]) -> tuple[dict[Path, Path], str]:
    """(the colour picture of each depth picture that has one, what is to be said of that).

    A pair has one name but for what says which of the two it is (0007_depth and 0007_rgb). A picture without
    such a partner, but named by its time, has the nearest in time, if that is less than half a period away:
    half of the median between depth pictures, in whatever unit the names are.
    """
    named = {moment(file): file for file in color}
    pairs = {file: named[moment(file)] for file in depth if moment(file) in named}
    times = {file: time for file in depth if (time := _time(file)) is not None}
    colors = sorted((time, file) for file in color if (time := _time(file)) is not None)
    if len(pairs) == len(depth) or len(times) < 2 or not colors:
        return pairs, ""
    half = median(b - a for a, b in pairwise(sorted(times.values()))) / 2
    apart = [Decimal(0)]
    for file in times.keys() - pairs.keys():
        at = bisect_left(colors, (times[file],))
        around = colors[max(0, at - 1) : at + 1]
        away, nearest = min((abs(time - times[file]), other) for time, other in around)
        if away < half:
            pairs[file] = nearest
            apart.append(away)
    count = len(apart) - 1
    said = f"colour of {count} frames is the nearest by the times in their names, up to {max(apart)} away"
    return pairs, said if count else ""


def has_alone_between(colors: Sequence[Path], taken: Iterable[Path]) -> bool:
    """Whether a colour picture lies without depth between others that have some."""
    with_depth = set(taken)
    places = [place for place, file in enumerate(sorted(colors, key=in_time)) if file in with_depth]
    return len(places) > 0 and places[-1] - places[0] + 1 > len(places)


def moment(file: Path) -> str:
    """The file's name without what says whether it is depth or colour: 0007_depth and 0007_rgb are a pair."""
    words = re.split(r"[-_.]", file.stem.lower())
    return "_".join(word for word in words if word not in _ROLE_WORDS)


def _time(file: Path) -> Decimal | None:
    """The only number in a name; None of one with several or none."""
    numbers = re.findall(r"\d+(?:\.\d+)?", file.stem)
    return Decimal(numbers[0]) if len(numbers) == 1 else None
