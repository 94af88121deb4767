"""Published checkpoint files as arrays: `.pth` (foundation/pickled_tensors.py) and `.safetensors`."""

import json
import struct
from pathlib import Path

import ml_dtypes
import numpy as np

from ddgrasp.errors import UserError
from foundation.pickled_tensors import read_pth

SUFFIXES = (".pth", ".pt", ".bin", ".safetensors")
MAX_HEADER_BYTES = 100_000_000
"""The format's own limit."""
SAFETENSORS_DTYPES = {
    "F64": np.dtype("<f8"),
    "F32": np.dtype("<f4"),
    "F16": np.dtype("<f2"),
    "BF16": np.dtype(ml_dtypes.bfloat16),
    "I64": np.dtype("<i8"),
    "I32": np.dtype("<i4"),
    "I16": np.dtype("<i2"),
    "I8": np.dtype("i1"),
    "U8": np.dtype("u1"),
    "BOOL": np.dtype("?"),
}
_WRAPPER = "module."


def read_checkpoint(path: Path) -> dict[str, np.ndarray]:
    """Name -> array, in the file's own types.

    Names lose a common `module.` in front, which training on several devices leaves there. UserError for a
    file that is absent, of another kind, or damaged.
    """
    if not path.is_file():
        raise UserError(f"{path} does not exist: expected a checkpoint file ({', '.join(SUFFIXES)}).")
    if path.suffix not in SUFFIXES:
        raise UserError(f"{path} ends in {path.suffix!r}; expected one of {', '.join(SUFFIXES)}.")
    tensors = read_safetensors(path) if path.suffix == ".safetensors" else read_pth(path)
    if all(name.startswith(_WRAPPER) for name in tensors):
        tensors = {name.removeprefix(_WRAPPER): array for name, array in tensors.items()}
    return tensors


def read_safetensors(path: Path) -> dict[str, np.ndarray]:
    """Name -> array, mapped from the file: 8 bytes of header length, a JSON header, then the numbers."""
    size = path.stat().st_size
    try:
        with open(path, "rb") as file:
            (length,) = struct.unpack("<Q", file.read(8))
            if length > min(size - 8, MAX_HEADER_BYTES):
                raise ValueError(f"its header claims {length} bytes")
            header = json.loads(file.read(length))
        data = np.memmap(path, np.uint8, "r", 8 + length) if size > 8 + length else np.zeros(0, np.uint8)
        return {name: _array(entry, data) for name, entry in header.items() if name != "__metadata__"}
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError, struct.error) as error:
        raise UserError(f"{path} is no readable safetensors file: {error}.") from None


def _array(entry: dict, data: np.ndarray) -> np.ndarray:
    if entry["dtype"] not in SAFETENSORS_DTYPES:
        raise ValueError(f"numbers of type {entry['dtype']}; known: {', '.join(SAFETENSORS_DTYPES)}")
    dtype, (first, last) = SAFETENSORS_DTYPES[entry["dtype"]], entry["data_offsets"]
    if not 0 <= first <= last <= len(data):
        raise ValueError(f"offsets {first} to {last} in {len(data)} bytes")
    return data[first:last].view(dtype).reshape(entry["shape"])
