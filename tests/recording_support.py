"""Recordings on disk for what reads them."""

import json
import struct
import zlib
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


def png_chunk(kind: bytes, data: bytes) -> bytes:
    """A chunk of a PNG, with its length and its checksum."""
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def png(header: bytes) -> bytes:
    """A PNG of intact chunks with this IHDR and next to no pixels."""
    chunks = [(b"IHDR", header), (b"IDAT", zlib.compress(bytes(1000))), (b"IEND", b"")]
    return b"\x89PNG\r\n\x1a\n" + b"".join(png_chunk(kind, data) for kind, data in chunks)


def claiming(width_px: int, height_px: int) -> bytes:
    """A 16-bit grey PNG that says it has so many pixels, and has next to none."""
    return png(struct.pack(">IIBBBBB", width_px, height_px, 16, 0, 0, 0, 0))
