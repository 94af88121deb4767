"""Files written whole or not at all, and plain JSON.

Every file goes to a temporary name in the same directory, reaches the disk (fsync), then takes its name
(os.replace): a crash, a full disk or Ctrl-C leaves the previous file as it was.
"""

import contextlib
import dataclasses
import errno
import io
import json
import os
import secrets
import shutil
import stat
import sys
import tempfile
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeGuard

from ddgrasp.errors import UserError

if TYPE_CHECKING:
    import matplotlib.figure

TEMPORARY = ".tmp-"
"""What the names of half-written files begin with."""


@contextlib.contextmanager
def atomic_path(path: Path | str) -> Iterator[Path]:
    """Yields a temporary path beside `path`; on success it becomes `path`, on any error it goes away.

    The temporary name keeps the suffix, since some writers (NumPy, ONNX, OpenCV) look at it.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = _temporary(path)
    try:
        yield temporary
        _fsync(temporary)
        os.replace(temporary, path)
        _fsync(path.parent)
    except BaseException as error:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)
        _name(error, temporary, path)
        raise


@contextlib.contextmanager
def new_folder(path: Path | str) -> Iterator[Path]:
    """Yields the name of a folder to make beside `path`; on success it becomes `path`, else it goes away.

    Raises OSError if `path` has come to exist and is no empty folder.
    """
    with _folder_beside(Path(path)) as temporary:
        yield temporary
        os.replace(temporary, path)


@contextlib.contextmanager
def replaced_folder(path: Path | str) -> Iterator[Path]:
    """As `new_folder`; a folder `path` that there is goes away once the new one stands in its place."""
    path = Path(path)
    with _folder_beside(path) as temporary:
        yield temporary
        replace_folder(temporary, path)


def replace_folder(folder: Path, path: Path) -> None:
    """`folder`, beside `path`, takes its name; what was there goes away, or stays if that fails."""
    old = path.with_name(f"{TEMPORARY}{os.getpid()}-old-{path.name}")
    try:
        if path.exists():
            shutil.rmtree(old, ignore_errors=True)  # a killed process of that number may have left it
            os.replace(path, old)
        os.replace(folder, path)
    except BaseException:
        if old.exists() and not path.exists():
            os.replace(old, path)
        raise
    if old.is_symlink():
        old.unlink()
    else:
        shutil.rmtree(old, ignore_errors=True)


@contextlib.contextmanager
def _folder_beside(path: Path) -> Iterator[Path]:
    """A temporary name, which the caller makes a folder of and renames; it goes away on any error."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = _temporary(path)
    try:
        yield temporary
        _fsync(path.parent)
    except BaseException as error:
        shutil.rmtree(temporary, ignore_errors=True)
        _name(error, temporary, path)
        raise


def _temporary(path: Path) -> Path:
    """A name beside `path` that nothing has, whatever a process of the same number left: in a container all
    have one."""
    return path.with_name(f"{TEMPORARY}{os.getpid()}-{secrets.token_hex(4)}-{path.name}")


def _name(error: BaseException, temporary: Path, path: Path) -> None:
    """What could not be written is called by its own name: nobody knows the temporary one."""
    if isinstance(error, OSError) and error.filename == str(temporary):
        error.filename = str(path)
        if error.filename2 is not None:  # 'temporary' -> 'path'
            del error.filename2


def user_cache(name: str) -> Path:
    """Where what can be made again is kept: `name` in DDGRASP_CACHE, or in ddgrasp/ of the user's caches.

    UserError for a user without a home, if others may write to the folder that stands in for one.
    """
    if own := os.environ.get("DDGRASP_CACHE"):
        return Path(own) / name
    if caches := os.environ.get("XDG_CACHE_HOME"):
        return Path(caches) / "ddgrasp" / name
    try:
        return Path.home() / ".cache" / "ddgrasp" / name
    except RuntimeError:  # in a container, for a user whom nobody knows
        return _own(Path(tempfile.gettempdir()) / f"ddgrasp-{os.getuid()}") / name


def _own(folder: Path) -> Path:
    """`folder` of a place that everybody writes to, made if it is not there: compiled programs of others are
    not to be run. UserError if others may write to it."""
    with contextlib.suppress(FileExistsError):
        folder.mkdir(mode=0o700)
    known = folder.lstat()
    if known.st_uid != os.getuid() or known.st_mode & 0o002 or not stat.S_ISDIR(known.st_mode):
        raise UserError(f"{folder} may be written to by others: delete it, or set DDGRASP_CACHE to a folder.")
    return folder


def atomic_write_bytes(path: Path | str, data: bytes) -> None:
    """Writes `data` to `path`; on an error (full disk, Ctrl-C) the previous file survives."""
    with atomic_path(path) as temporary, open(temporary, "wb") as file:
        file.write(data)


def atomic_write_text(path: Path | str, text: str) -> None:
    """`atomic_write_bytes` of `text` in UTF-8; \\udcff for a byte of a file's name that is no UTF-8."""
    atomic_write_bytes(path, text.encode(errors="backslashreplace"))


def atomic_write_json(path: Path | str, value: Any) -> None:
    """Writes `value` (dataclasses, paths and NumPy numbers included) as indented, strictly valid JSON."""
    atomic_write_text(path, json.dumps(to_json(value), indent=2, allow_nan=False) + "\n")


DAMAGED_JSON = (ValueError, RecursionError)
"""What `json.loads` raises: of no JSON, no UTF-8, a number of thousands of digits; of too deep a nesting."""
DAMAGED_NPZ = (OSError, ValueError, EOFError, zipfile.BadZipFile, zlib.error)
"""What `np.load`, and reading the arrays that it gives, raise for a damaged or truncated .npz."""


def read_json(path: Path | str) -> Any:
    """The value in a JSON file; UserError naming the file if it is absent or damaged."""
    path = Path(path)
    try:
        return json.loads(path.read_bytes())
    except FileNotFoundError:
        raise UserError(f"{path} does not exist.") from None
    except DAMAGED_JSON as error:
        raise UserError(
            f"{path} is not valid JSON ({error}): mend it, or delete it and make it again."
        ) from None


def is_number(value: Any) -> TypeGuard[float]:
    """Whether a value that was read from JSON is a number that a float can be: no infinity, true or false."""
    is_one = isinstance(value, int | float) and not isinstance(value, bool)
    return is_one and abs(value) <= sys.float_info.max


def read_npz(path: Path, remedy: str) -> dict[str, Any]:
    """NumPy arrays of an .npz file by name; UserError with the `remedy` if it is damaged or absent."""
    import numpy as np

    try:
        with np.load(path) as arrays:
            return dict(arrays)
    except DAMAGED_NPZ as error:
        raise UserError(f"{path} is damaged ({error}): {remedy}.") from None


def to_json(value: Any) -> Any:
    """`value` as plain JSON types: dataclasses become objects, tuples lists, NumPy numbers and arrays plain.

    Not-a-number and infinities become null: JSON has no name for them.
    """
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {field.name: to_json(getattr(value, field.name)) for field in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {str(key): to_json(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [to_json(item) for item in value]
    if (tolist := getattr(value, "tolist", None)) is not None:  # NumPy and JAX arrays and scalars
        return to_json(tolist())
    if isinstance(value, float):
        return value if value == value and abs(value) != float("inf") else None
    if isinstance(value, Path):
        return str(value)
    return value


def to_png(figure: "matplotlib.figure.Figure", dpi: int = 100) -> bytes:
    """The figure as a PNG file's content."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=dpi)
    return buffer.getvalue()


def to_tuples(value: Any) -> Any:
    """A list that was read from JSON as the tuple that it was, with those in it; anything else as it is."""
    return tuple(to_tuples(item) for item in value) if isinstance(value, list) else value


def _fsync(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    except OSError as error:  # of a folder, on a shared one of a virtual machine
        if error.errno not in (errno.EINVAL, errno.ENOTSUP) or not path.is_dir():
            raise
    finally:
        os.close(descriptor)
