"""Where recordings come from: frames in time order, as a file, a folder or a camera has them."""

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from decimal import Decimal
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8

COLOR_SUFFIXES = (".png", ".jpg", ".jpeg")
"""Those of colour pictures, in small or capital letters."""


@dataclass(frozen=True)
class RawFrame:
    """One frame as its source has it."""

    name: str
    depth: np.ndarray | None
    """(H, W) counts or floating-point lengths (what is neither is left out); None if it cannot be read."""
    rgb: UInt8[np.ndarray, "h w 3"] | None
    """(h, w, 3) uint8; None if there is none."""


@dataclass(frozen=True)
class Source:
    """Frames in time order and what is known about their camera."""

    path: Path
    frames: Callable[[], Iterator[RawFrame]]
    depth_unit_m: float
    """Metres per count of integer depth; for floating-point depth, metres per unit."""
    meta: dict[str, Any]
    """Fields of meta.json."""
    unit_is_certain: bool = False
    """Whether depths that cannot be a D4xx's are the scene's fault, not the unit's."""
    closing_meta: Callable[[], dict[str, Any]] = dict
    """Fields of meta.json that are known after the last frame alone."""
    cut_short: Callable[[OSError], None] | None = None
    """What is told that a frame could not be written, where the frames before are kept then, since they come
    but once; None keeps none."""


def in_time(file: Path) -> list[tuple[Decimal, str]]:
    """Key that sorts a recording's pictures: numbers in a name count as numbers, 10.png comes after 9.png.

    A point between digits is a decimal point, as in names that are seconds: 4.5.png comes after 4.25.png.
    """
    parts = enumerate(re.split(r"(\d+(?:\.\d+)?)", file.name))  # text and numbers in turn
    return [(Decimal(part), "") if place % 2 else (Decimal(-1), part) for place, part in parts]
