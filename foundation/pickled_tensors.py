"""Tensors out of PyTorch's `.pth` files without PyTorch and without running what is pickled in them.

A pickle is a program, and loading one with Python's `pickle` calls whatever it names. Here its instructions
are read one by one (`pickletools.genops`) by a machine that knows the few a dictionary of tensors consists
of. Names of classes and functions stay text; the few that occur in such files are understood, any other is
refused.

Formats: the zip archive that PyTorch writes since 1.6, and the sequence of pickles it wrote before.
"""

import pickletools
import struct
import zipfile
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import ml_dtypes
import numpy as np

from ddgrasp.errors import UserError

LEGACY_MAGIC = 0x1950A86A20F9469CFC6C
"""The first pickle of a file written before 1.6."""
LEGACY_PROTOCOL = 1001

DTYPES = {
    "FloatStorage": np.dtype("<f4"),
    "DoubleStorage": np.dtype("<f8"),
    "HalfStorage": np.dtype("<f2"),
    "BFloat16Storage": np.dtype(ml_dtypes.bfloat16),
    "LongStorage": np.dtype("<i8"),
    "IntStorage": np.dtype("<i4"),
    "ShortStorage": np.dtype("<i2"),
    "CharStorage": np.dtype("i1"),
    "ByteStorage": np.dtype("u1"),
    "BoolStorage": np.dtype("?"),
}

_DAMAGE = (
    ArithmeticError, AttributeError, EOFError, LookupError, MemoryError, RuntimeError, TypeError, ValueError,
    struct.error, zipfile.BadZipFile, zlib.error,
)  # fmt: skip
"""What reading a damaged file may end in."""


@dataclass(frozen=True)
class _Name:
    """A class or function the pickle names: text, never imported."""

    text: str


@dataclass(frozen=True)
class _Storage:
    """A flat array elsewhere in the file."""

    key: str
    dtype: np.dtype
    length: int


@dataclass(frozen=True)
class _View:
    """A tensor: strides over a storage, in elements."""

    storage: _Storage
    offset: int
    shape: tuple[int, ...]
    strides: tuple[int, ...]


def read_pth(path: Path) -> dict[str, np.ndarray]:
    """Name -> array, in the file's own types, of a `.pth` holding a state dict.

    A dictionary that holds the state dict under `state_dict` or `model` is looked into. UserError for a file
    that is damaged, of another format, or pickles anything but tensors and plain values.
    """
    try:
        tree, storages = _read_zip(path) if zipfile.is_zipfile(path) else _read_legacy(path)
        return {name: _array(name, view, storages, path) for name, view in _state_dict(tree, path).items()}
    except _DAMAGE as error:
        reason = str(error) or type(error).__name__
        raise UserError(f"{path} is no readable PyTorch checkpoint: {reason}.") from None


def _state_dict(tree: Any, path: Path) -> dict[str, _View]:
    for _ in range(2):
        if isinstance(tree, dict):
            tree = next(
                (tree[key] for key in ("state_dict", "model") if isinstance(tree.get(key), dict)), tree
            )
    tensors = {str(k): v for k, v in tree.items() if isinstance(v, _View)} if isinstance(tree, dict) else {}
    if not tensors:
        raise UserError(f"{path} holds no state dict: expected a dictionary of tensors.")
    return tensors


def _array(name: str, view: _View, storages: Callable[[_Storage], bytes], path: Path) -> np.ndarray:
    storage, size = view.storage, view.storage.dtype.itemsize
    flat = np.frombuffer(storages(storage), storage.dtype)
    last = view.offset + sum((n - 1) * s for n, s in zip(view.shape, view.strides, strict=True))
    inside = min((view.offset, *view.shape, *view.strides)) >= 0 and last < len(flat)
    if not inside and 0 not in view.shape:
        raise UserError(f"{path} is damaged: tensor {name!r} lies outside its storage.")
    strides = [size * stride for stride in view.strides]
    return np.lib.stride_tricks.as_strided(flat[view.offset :], view.shape, strides, writeable=False)


# --- the two containers --------------------------------------------------------------------------


def _read_zip(path: Path) -> tuple[Any, Callable[[_Storage], bytes]]:
    archive = zipfile.ZipFile(path)
    pickles = [name for name in archive.namelist() if name == "data.pkl" or name.endswith("/data.pkl")]
    if len(pickles) != 1:
        raise ValueError("the archive has no data.pkl")
    root = pickles[0].removesuffix("data.pkl")
    if f"{root}byteorder" in archive.namelist() and archive.read(f"{root}byteorder") != b"little":
        raise ValueError("its numbers are not little-endian")
    with archive.open(pickles[0]) as file:
        tree = _run(file)

    def storage_bytes(storage: _Storage) -> bytes:
        entry = archive.getinfo(f"{root}data/{storage.key}")
        if entry.file_size < storage.length * storage.dtype.itemsize:
            raise UserError(f"{path} is damaged: storage {storage.key} is shorter than it should be.")
        return archive.read(entry)

    return tree, storage_bytes


def _read_legacy(path: Path) -> tuple[Any, Callable[[_Storage], bytes]]:
    with open(path, "rb") as file:
        if file.read(1) != b"\x80":
            raise ValueError("neither a zip archive nor a pickle")
        file.seek(0)
        if (_run(file), _run(file)) != (LEGACY_MAGIC, LEGACY_PROTOCOL):
            raise ValueError("an unknown kind of pickle")
        _run(file)  # sizes of C types on the machine that wrote it
        tree, keys = _run(file), _run(file)
        sizes = {view.storage.key: view.storage.dtype.itemsize for view in _views(tree)}
        parts: dict[str, bytes] = {}
        for key in keys:
            (length,) = struct.unpack("<q", file.read(8))
            if key not in sizes:
                raise ValueError(f"storage {key} belongs to no tensor")
            if not 0 <= length * sizes[key] <= path.stat().st_size - file.tell():
                raise ValueError("it ends early")
            parts[key] = file.read(length * sizes[key])
    return tree, lambda storage: parts[storage.key]


def _views(tree: Any) -> Iterator[_View]:
    if isinstance(tree, _View):
        yield tree
    elif isinstance(tree, (list, tuple, dict)):
        for value in tree.values() if isinstance(tree, dict) else tree:
            yield from _views(value)


# --- the machine ---------------------------------------------------------------------------------

_MARK = object()
_EMPTY = {"EMPTY_DICT": dict, "EMPTY_LIST": list, "EMPTY_TUPLE": tuple}
_CONSTANT = {"NONE": None, "NEWTRUE": True, "NEWFALSE": False}
_LITERAL = {
    "BINUNICODE", "SHORT_BINUNICODE", "UNICODE", "BINSTRING", "SHORT_BINSTRING", "BININT", "BININT1",
    "BININT2", "INT", "LONG", "LONG1", "LONG4", "BINFLOAT", "FLOAT", "SHORT_BINBYTES", "BINBYTES",
}  # fmt: skip
_TUPLES = {"TUPLE1": 1, "TUPLE2": 2, "TUPLE3": 3}


def _run(file: Any) -> Any:
    """The value that one pickle describes, from the binary file's current position to just behind its end."""
    stack: list[Any] = []
    memo: dict[int, Any] = {}
    argument: Any
    for opcode, argument, _ in pickletools.genops(file):
        name = opcode.name
        if name in ("PROTO", "FRAME"):
            continue
        if name == "STOP":
            return stack.pop()
        if name in _LITERAL:
            stack.append(argument)
        elif name in _CONSTANT:
            stack.append(_CONSTANT[name])
        elif name in _EMPTY:
            stack.append(_EMPTY[name]())
        elif name == "MARK":
            stack.append(_MARK)
        elif name in ("BINPUT", "LONG_BINPUT", "PUT"):
            memo[int(argument)] = stack[-1]
        elif name == "MEMOIZE":
            memo[len(memo)] = stack[-1]
        elif name in ("BINGET", "LONG_BINGET", "GET"):
            stack.append(memo[int(argument)])
        elif name in _TUPLES or name == "TUPLE":
            count = _TUPLES.get(name, 0)
            items = [stack.pop() for _ in range(count)][::-1] if count else _since_mark(stack)
            stack.append(tuple(items))
        elif name in ("SETITEM", "SETITEMS"):
            items = _since_mark(stack) if name == "SETITEMS" else [stack.pop(), stack.pop()][::-1]
            stack[-1].update(zip(items[::2], items[1::2], strict=True))
        elif name in ("APPEND", "APPENDS"):
            items = _since_mark(stack) if name == "APPENDS" else [stack.pop()]
            stack[-1].extend(items)
        elif name == "GLOBAL":
            stack.append(_Name(argument))
        elif name == "STACK_GLOBAL":
            member, module = stack.pop(), stack.pop()
            stack.append(_Name(f"{module} {member}"))
        elif name == "BINPERSID":
            stack.append(_storage(stack.pop()))
        elif name == "REDUCE":
            arguments, function = stack.pop(), stack.pop()
            stack.append(_build(function, arguments))
        elif name == "BUILD":
            stack.pop()  # attributes of a dictionary (its `_metadata`): not used
        else:
            raise UserError(f"The checkpoint pickles more than tensors (instruction {name}): it is not read.")
    raise ValueError("its pickle has no end")


def _since_mark(stack: list[Any]) -> list[Any]:
    items = []
    while (item := stack.pop()) is not _MARK:
        items.append(item)
    return items[::-1]


def _storage(reference: Any) -> _Storage:
    """("storage", class, key, device, length[, view]), as PyTorch refers to a flat array."""
    kind, cls, key, _, length = reference[:5]
    if kind != "storage" or not isinstance(cls, _Name) or len(reference) > 5 and reference[5] is not None:
        raise ValueError("it refers to something that is no plain storage")
    module, _, name = cls.text.partition(" ")
    if module != "torch" or name not in DTYPES:
        raise UserError(f"The checkpoint stores numbers as {cls.text!r}; known: {', '.join(DTYPES)}.")
    return _Storage(str(key), DTYPES[name], int(length))


def _build(function: Any, arguments: Any) -> Any:
    """What the calls that occur in state dicts stand for."""
    text = function.text if isinstance(function, _Name) else repr(function)
    if text == "collections OrderedDict":
        return dict(*arguments)
    if text in ("torch._utils _rebuild_tensor", "torch._utils _rebuild_tensor_v2"):
        storage, offset, shape, strides = arguments[:4]
        return _View(storage, offset, tuple(shape), tuple(strides))
    if text in ("torch._utils _rebuild_parameter", "torch._utils _rebuild_parameter_with_state"):
        return arguments[0]
    raise UserError(f"The checkpoint wants to call {text!r} when loaded: it is not read.")
