"""Recordings on disk for what reads them."""

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from sensors.recordings.writer import RecordingWriter


def write_depth(path: Path, frames_mm: Iterable[np.ndarray], **meta: Any) -> Path:
    """A recording of these frames, (H, W) uint16, with black colour; `meta` is in its meta.json."""
    with RecordingWriter(path, meta) as writer:
        for depth_mm in frames_mm:
            writer.add(np.zeros((*depth_mm.shape, 3), np.uint8), depth_mm)
    return path


def flat(size: tuple[int, int], depth_mm: int) -> np.ndarray:
    """A frame of `size` (H, W) with the same depth everywhere."""
    return np.full(size, depth_mm, np.uint16)


def set_meta(path: Path, **values: Any) -> None:
    """Changes the meta.json of the recording at `path` as a person might."""
    file = path / "meta.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | values))
