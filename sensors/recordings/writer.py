"""Writing a recording (`sensors.recordings.recording`) whole or not at all."""

import contextlib
import json
import os
import shutil
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from ddgrasp.alone import alone_in
from ddgrasp.contract import CONTRACT_VERSION, DEPTH_UNIT_M
from ddgrasp.errors import Trouble, UserError
from ddgrasp.files import replace_folder
from sensors.recordings.recording import META_FILE

BEGUN_FILE = "begun.json"
"""What is known of a recording before it is complete: the meta.json of one that was killed."""
_COMES_ONCE = "frames_come_once"
"""In BEGUN_FILE of a recording whose frames nobody can make again."""
JPEG_QUALITY = 95
PNG_COMPRESSION = 3


def partial_folder(path: Path) -> Path:
    """Where the frames of the recording `path` are until it is complete."""
    return path.parent / f".{path.name}.partial"


def check_left(path: Path, always: bool = False) -> None:
    """UserError if a recording `path` that was killed has left frames that come but once, or, with `always`,
    any."""
    partial = partial_folder(path)
    left = len(list((partial / "depth").glob("*")))
    if left and (always or _comes_once(partial / BEGUN_FILE)):
        raise UserError(
            f"{partial} has {left} frames of a recording that did not end, or has not yet: choose another "
            f"name, keep them by `ddgrasp record import {partial}`, or delete that folder."
        )


def _comes_once(begun: Path) -> bool:
    try:
        known = json.loads(begun.read_bytes())
    except (OSError, ValueError, RecursionError):
        return False
    return isinstance(known, dict) and bool(known.get(_COMES_ONCE))


def check_place(path: Path) -> None:
    """UserError if a recording `path` would take the place of something else."""
    if os.path.lexists(path) and not path.is_dir():
        kind = "a link to nothing" if path.is_symlink() and not path.exists() else "no folder"
        raise UserError(f"{path} is {kind}: delete it, or choose another name.")
    if path.is_dir() and not (path / META_FILE).exists() and any(path.iterdir()):
        raise UserError(f"{path} is no recording ({META_FILE} is missing): move it, or choose another name.")


class RecordingWriter:
    """Writes one recording; it appears under its name only when complete.

    Use as a context manager: frames go to a hidden folder beside the target, `meta.json` is
    written last, then the folder is renamed. Leaving by an exception (or Ctrl-C), or failing at the end,
    removes the hidden folder, unless it is to keep; a previous recording of that name stays as it was.
    Pictures are on the disk before `meta.json` is: a power cut leaves no recording that says it is whole and
    is not.

    With `keep`, for frames that come but once, the hidden folder stays if it has any, but where they are
    refused (UserError). Leaving by an error raises Trouble then, which says where they are.

    Raises UserError on entering if another one is at work under that name, or if frames that come but once
    are left there of one that was killed.
    """

    def __init__(self, path: str | os.PathLike, meta: dict[str, Any], keep: bool = False):
        self.path = Path(path)
        self.meta = dict(meta)
        self._keep = keep
        self._temporary = partial_folder(self.path)
        self._alone = ExitStack()
        self._size: tuple[int, int] | None = None
        self._frames = 0
        self._invalid = 0.0

    def __enter__(self) -> "RecordingWriter":
        self._lock()
        try:
            check_left(self.path)
        except UserError:
            self._alone.close()
            raise
        for folder in ("color", "depth"):  # what a killed process has left goes
            shutil.rmtree(self._temporary / folder, ignore_errors=True)
            (self._temporary / folder).mkdir()
        # What would be lost by a kill; whether frames follow each other is known at the end alone.
        known = {name: value for name, value in self.meta.items() if name != "consecutive_frames"}
        once = {_COMES_ONCE: True} if self._keep else {}
        begun = json.dumps({"depth_unit_m": DEPTH_UNIT_M, **known, **once}, indent=1) + "\n"
        _write(self._temporary / BEGUN_FILE, begun.encode(), sync=True)
        return self

    def __exit__(self, kind, value, traceback) -> None:
        with self._alone:
            try:
                if kind is None:
                    self._finish()
            except BaseException as error:
                self._leave(error)
                raise
            if kind is not None:
                self._leave(value)

    def _leave(self, error: BaseException) -> None:
        if not self._keep or not self._frames or isinstance(error, UserError):
            shutil.rmtree(self._temporary, ignore_errors=True)
            return
        with contextlib.suppress(OSError):  # half of it may be there: BEGUN_FILE says what is known
            (self._temporary / META_FILE).unlink(missing_ok=True)
        if isinstance(error, Exception):  # Ctrl-C says what it is
            raise Trouble(
                f"{self.path} could not be ended ({error}): its {self._frames} frames are in "
                f"{self._temporary}; once that is mended, `ddgrasp record import {self._temporary}`."
            ) from error

    def _lock(self) -> None:
        """Makes the hidden folder and keeps others out of it."""
        while True:
            self._temporary.mkdir(parents=True, exist_ok=True)
            before = self._temporary.stat().st_ino
            try:
                self._alone.enter_context(alone_in(self._temporary))
            except UserError:
                raise UserError(
                    f"{self.path} is being recorded by another process: choose another name."
                ) from None
            except FileNotFoundError:
                continue
            if self._temporary.exists() and self._temporary.stat().st_ino == before:
                return
            self._alone.close()  # another one has ended meanwhile, and that was its folder

    def add(self, rgb: np.ndarray, depth_mm: np.ndarray) -> None:
        """Append a frame.

        Args:
            rgb: (h, w, 3) uint8.
            depth_mm: (H, W) uint16 millimetres, 0 = invalid.

        Raises:
            UserError: another type or shape, or another size of depth than the frames before.
            OSError: a full disk; the frames before are as they were.
        """
        if depth_mm.dtype != np.uint16 or depth_mm.ndim != 2:
            raise UserError(
                f"depth of a recording is (H, W) uint16 millimetres, got {depth_mm.dtype} "
                f"{depth_mm.shape}; convert metres with np.rint(depth_m * 1000).astype(np.uint16)."
            )
        if rgb.dtype != np.uint8 or rgb.ndim != 3 or rgb.shape[2] != 3:
            raise UserError(f"colour of a recording is (h, w, 3) uint8, got {rgb.dtype} {rgb.shape}.")
        if self._size is not None and depth_mm.shape != self._size:
            raise UserError(f"a recording has one depth size: {self._size}, got {depth_mm.shape}.")
        self._size = depth_mm.shape
        name, bgr = f"{self._frames:06d}", cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR)
        files = {
            f"color/{name}.jpg": _encode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY]),
            f"depth/{name}.png": _encode(".png", depth_mm, [cv2.IMWRITE_PNG_COMPRESSION, PNG_COMPRESSION]),
        }
        try:
            for file, data in files.items():
                _write(self._temporary / file, data)
        except OSError:
            for file in files:
                (self._temporary / file).unlink(missing_ok=True)
            raise
        self._frames += 1
        self._invalid += float(np.mean(depth_mm == 0))

    def _finish(self) -> None:
        if self._size is None:
            raise UserError(f"{self.path}: a recording needs at least one frame.")
        meta = {
            "frames": self._frames,
            "width": self._size[1],
            "height": self._size[0],
            "depth_unit_m": DEPTH_UNIT_M,
            "invalid_value": 0,
            "contract_version": CONTRACT_VERSION,
            "invalid_fraction_mean": round(self._invalid / self._frames, 4),
        }
        os.sync()  # once at the end: one awaited with every frame would hold up who records them
        text = json.dumps({**self.meta, **meta}, indent=1) + "\n"
        _write(self._temporary / META_FILE, text.encode(), sync=True)
        (self._temporary / BEGUN_FILE).unlink()
        replace_folder(self._temporary, self.path)


def _encode(extension: str, image: np.ndarray, options: list[int]) -> bytes:
    ok, data = cv2.imencode(extension, image, options)
    if not ok:
        raise RuntimeError(f"OpenCV could not encode a {image.dtype} {image.shape} image as {extension}")
    return data.tobytes()


def _write(path: Path, data: bytes, sync: bool = False) -> None:
    # Not cv2.imwrite: it reports a full disk as False, without saying why.
    with open(path, "wb") as file:
        file.write(data)
        if sync:
            file.flush()
            os.fsync(file.fileno())
