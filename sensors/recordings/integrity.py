"""A recording's files: which there are, and whether those of a frame are whole.

PNG checksums, JPEG markers, a single valid pixel; few are decoded.
"""

import struct
import zlib
from pathlib import Path

import cv2

from ddgrasp.errors import UserError
from sensors.recordings.pictures import decoded
from sensors.recordings.sources import COLOR_SUFFIXES, in_time

_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_PNG_GREY = 0
_IHDR_BYTES = 13
_MOST_PIXELS = 64_000_000
"""A picture of a recording has no more: a file of 1 MB can claim, and be decoded to, far more."""


def find_depth(path: Path) -> list[Path]:
    """The depth pictures of the recording in `path`, in time order; UserError for none, or other files."""
    folder = path / "depth"
    inside = folder.iterdir() if folder.is_dir() else ()
    files = sorted((p for p in inside if p.is_file() and not p.name.startswith(".")), key=in_time)
    for file in files:
        if file.suffix.lower() in (".npy", ".npz", ".tif", ".tiff", ".exr", ".pfm"):
            raise UserError(
                f"{file}: depth as {file.suffix}; expected 16-bit PNG in millimetres: convert float "
                "metres with np.rint(depth_m * 1000).astype(np.uint16)."
            )
    files = [p for p in files if p.suffix.lower() == ".png"]
    if not files:
        raise UserError(f"{folder}: no depth pictures; expected 000000.png, 000001.png, ... (16-bit, mm).")
    return files


def find_color(path: Path, depth_file: Path) -> Path:
    """Where the colour picture of a depth picture is, or would be."""
    suffixes = (spelt for suffix in COLOR_SUFFIXES for spelt in (suffix, suffix.upper()))
    files = (path / "color" / f"{depth_file.stem}{suffix}" for suffix in suffixes)
    return next((file for file in files if file.is_file()), path / "color" / f"{depth_file.stem}.jpg")


def inspect_frame(depth_file: Path, color_file: Path) -> tuple[str, tuple[int, int]]:
    """(why the frame must be left out or "", (height, width) of its depth).

    Raises UserError for depth that is no 16-bit grey PNG: that is no damage, but another kind of recording.
    """
    data = depth_file.read_bytes()
    header = _png_header(data)
    if header is None:
        return "depth picture is truncated or corrupt", (0, 0)
    height, width, bits, kind = header
    if bits != 16 or kind != _PNG_GREY:
        channels = "grey" if kind == _PNG_GREY else "colour"
        raise UserError(
            f"{depth_file}: depth is a {bits}-bit {channels} PNG; expected 16-bit grey in millimetres "
            "(a colourised or 8-bit picture has lost the depth: record again)."
        )
    if not color_file.is_file():
        return f"colour picture {color_file.name} is missing", (0, 0)
    if not _color_complete(color_file):
        return f"colour picture {color_file.name} is truncated or corrupt", (0, 0)
    if _all_invalid(data, height, width):
        return "no valid depth pixel", (0, 0)
    return "", (height, width)


def _png_header(data: bytes) -> tuple[int, int, int, int] | None:
    """(height, width, bit depth, colour type) of an intact PNG, None if any chunk is damaged, or its size is
    no camera's."""
    if data[:8] != _PNG_SIGNATURE:
        return None
    offset, header = 8, None
    while offset + 12 <= len(data):
        length, kind = struct.unpack_from(">I4s", data, offset)
        end = offset + 8 + length
        if end + 4 > len(data):
            return None
        if zlib.crc32(memoryview(data)[offset + 4 : end]) != struct.unpack_from(">I", data, end)[0]:
            return None
        if kind == b"IHDR":
            if length != _IHDR_BYTES:
                return None
            width, height, bits, color = struct.unpack_from(">IIBB", data, offset + 8)
            if height * width > _MOST_PIXELS:
                return None
            header = (height, width, bits, color)
        if kind == b"IEND":
            return header
        offset = end + 4
    return None


def _color_complete(file: Path) -> bool:
    data = file.read_bytes()
    if file.suffix.lower() == ".png":
        return _png_header(data) is not None
    # Some cameras pad after the end-of-image marker; look for it near the end.
    return data[:2] == b"\xff\xd8" and b"\xff\xd9" in data[-64:]


def _all_invalid(data: bytes, height: int, width: int) -> bool:
    # Only constant pictures shrink this far, so only they need decoding here.
    if len(data) > 200 + height * width / 50:
        return False
    image = decoded(data, cv2.IMREAD_UNCHANGED)
    return image is None or not image.any()
