"""Writes checkpoint files as the publishers' tools do, opcode by opcode: no PyTorch here."""

import json
import struct
import zipfile
from pathlib import Path

import numpy as np

STORAGES = {"float32": "FloatStorage", "float16": "HalfStorage", "int64": "LongStorage"}


def write_pth(path: Path, arrays: dict[str, np.ndarray], *, wrapper: str = "", extra: bytes = b"") -> None:
    """A `.pth` in the zip format; `wrapper` puts the arrays under that key, `extra` goes before the end."""
    body = state_pickle(arrays, wrapper)
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("archive/data.pkl", b"\x80\x02" + body + extra + b".")
        archive.writestr("archive/byteorder", "little")
        for number, array in enumerate(arrays.values()):
            archive.writestr(f"archive/data/{number}", np.ascontiguousarray(array).tobytes())
        archive.writestr("archive/version", "3\n")


def write_legacy_pth(path: Path, arrays: dict[str, np.ndarray]) -> None:
    """A `.pth` as PyTorch wrote before 1.6: five pickles, then length and numbers of each storage."""
    magic = b"\x80\x02\x8a\x0a" + (0x1950A86A20F9469CFC6C).to_bytes(10, "little") + b"."
    protocol = b"\x80\x02M" + struct.pack("<H", 1001) + b"."
    system = b"\x80\x02}(" + text("little_endian") + b"\x88u."
    keys = b"\x80\x02](" + b"".join(text(str(number)) for number in range(len(arrays))) + b"e."
    state = b"\x80\x02" + state_pickle(arrays, "", legacy=True) + b"."
    with open(path, "wb") as file:
        file.write(magic + protocol + system + state + keys)
        for array in arrays.values():
            file.write(struct.pack("<q", array.size) + np.ascontiguousarray(array).tobytes())


def write_safetensors(path: Path, arrays: dict[str, np.ndarray]) -> None:
    """A `.safetensors` of float32 arrays."""
    header, offset = {}, 0
    for name, array in arrays.items():
        header[name] = {
            "dtype": "F32", "shape": list(array.shape), "data_offsets": [offset, offset + array.nbytes]
        }  # fmt: skip
        offset += array.nbytes
    encoded = json.dumps(header | {"__metadata__": {"format": "pt"}}).encode()
    data = b"".join(np.ascontiguousarray(array).tobytes() for array in arrays.values())
    path.write_bytes(struct.pack("<Q", len(encoded)) + encoded + data)


def state_pickle(arrays: dict[str, np.ndarray], wrapper: str, *, legacy: bool = False) -> bytes:
    """An OrderedDict of tensors with its `_metadata` attribute, without the pickle's frame."""
    out = b"ccollections\nOrderedDict\n)R("
    for number, (name, array) in enumerate(arrays.items()):
        out += text(name) + tensor(str(number), array, legacy)
    out += b"u}(" + text("_metadata") + b"}ub"
    return b"}" + text(wrapper) + out + b"s" if wrapper else out


def tensor(key: str, array: np.ndarray, legacy: bool) -> bytes:
    """A call of `_rebuild_tensor_v2` on storage `key`."""
    storage = STORAGES[array.dtype.name]
    reference = (
        text("storage") + f"ctorch\n{storage}\n".encode() + text(key) + text("cpu") + integer(array.size)
    )
    strides = [stride // array.itemsize for stride in np.ascontiguousarray(array).strides]
    return (
        b"ctorch._utils\n_rebuild_tensor_v2\n(("
        + reference + (b"N" if legacy else b"") + b"tQ" + integer(0)
        + integers(array.shape) + integers(strides[: array.ndim])
        + b"\x89ccollections\nOrderedDict\n)RtR"
    )  # fmt: skip


def text(value: str) -> bytes:
    """A unicode string."""
    return b"X" + struct.pack("<I", len(value.encode())) + value.encode()


def integer(value: int) -> bytes:
    """A four-byte integer."""
    return b"J" + struct.pack("<i", value)


def integers(values) -> bytes:
    """A tuple."""
    return b"(" + b"".join(integer(value) for value in values) + b"t"
