"""A film of trials: colour beside the depth that the policy sees."""

import contextlib
import errno
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from jaxtyping import UInt8, UInt16

from ddgrasp import contract
from ddgrasp.depth import to_millimetres
from ddgrasp.errors import UserError
from ddgrasp.files import atomic_path, atomic_write_bytes
from deploy.interfaces import Depth, Filmed, Simulated
from deploy.loop_report import Step
from rig.film import colored

VIDEO_CODECS = {".mp4": "mp4v", ".webm": "VP90"}
"""By the file's ending; browsers play WebM, and mp4v only players do."""
ANIMATION = ".webp"
"""A moving picture, which pages show like any other; half as wide as a video."""
ENDINGS = (*VIDEO_CODECS, ANIMATION)
PANEL_PX, ANIMATION_PANEL_PX = 640, 320
"""Width of one picture in a video, and in a moving picture."""
ANIMATION_QUALITY = 60
NEAR_MM, FAR_MM = 350.0, 1100.0
"""Ends of the depth pictures' colour scale."""
VERDICT_S = 1.0
"""How long a film stays at the last picture."""
_LINE_PX = 30

NoiseModel = Callable[[UInt16[np.ndarray, "H W"]], UInt16[np.ndarray, "H W"]]
"""Clean depth -> depth with a camera's errors, millimetres."""
Picture = UInt8[np.ndarray, "h w 3"]


class Video:
    """A picture for every control step; with `generator` also what that makes of clean depth, before cameras
    that know it."""

    def __init__(self, path: Path, generator: NoiseModel | None = None):
        """UserError for an ending that is none of `ENDINGS`, or if OpenCV has no such encoder."""
        import cv2

        if path.suffix not in ENDINGS:
            raise UserError(f"--out {path}: a film ends with {' or '.join(ENDINGS)}.")
        self._path, self._cv2, self._generator = path, cv2, generator
        self._width_px = ANIMATION_PANEL_PX if path.suffix == ANIMATION else PANEL_PX
        self._encoder: _Encoder | None = None
        self._title, self._last = "", np.zeros((0, 0, 3), np.uint8)

    def begin(self, title: str) -> None:
        """See `Viewer`."""
        self._title = title

    def look(self, step: Step, camera: Filmed) -> None:
        """See `Viewer`."""
        if step.frame is None:
            return
        panels = [self._panel("colour", camera.picture(), exact=False)]
        panels.append(self._panel("depth that the policy sees", depth_picture(step.frame.depth)))
        if self._generator is not None and isinstance(camera, Simulated):
            panels.append(self._panel("generated depth", depth_picture(self._generator(camera.clean_mm()))))
        self._last = np.concatenate(panels, axis=1)
        text = f"{self._title}   {step.index * contract.CONTROL_DT_S:.1f} s"
        self._write(self._labelled(f"{text}   hand {1e3 * step.state.width_m:.0f} mm"))

    def end(self, verdict: str) -> None:
        """See `Viewer`."""
        if self._last.size:
            for _ in range(round(VERDICT_S * contract.CONTROL_HZ)):
                self._write(self._labelled(f"{self._title}   {verdict}"))

    def close(self, whole: bool = True) -> None:
        """The film takes its name if it is `whole`; else a film of that name stays as it was.

        Raises OSError if pictures are missing in it: encoders do not say that the disk is full.
        """
        if self._encoder is not None:
            self._encoder.close(whole)

    def watched(self) -> bool:
        """See `Viewer`."""
        return True

    def _panel(
        self, caption: str, picture: UInt8[np.ndarray, "H W 3"], exact: bool = True
    ) -> UInt8[np.ndarray, "h w 3"]:
        height, width = picture.shape[:2]
        size = self._width_px, 2 * round(self._width_px * height / width / 2)
        how = self._cv2.INTER_NEAREST if exact else self._cv2.INTER_CUBIC
        panel = self._cv2.resize(picture, size, interpolation=how)
        self._say(panel, caption, (255, 255, 255), size[1] - 10)
        return panel

    def _say(self, picture: Picture, text: str, rgb: tuple[int, ...], y: int) -> None:
        font = self._cv2.FONT_HERSHEY_SIMPLEX
        self._cv2.putText(picture, text, (8, y), font, 0.5, rgb, 1, self._cv2.LINE_AA)

    def _labelled(self, text: str) -> Picture:
        bar = np.full((_LINE_PX, self._last.shape[1], 3), 255, np.uint8)
        self._say(bar, text, (0, 0, 0), _LINE_PX - 10)
        return np.concatenate([bar, self._last])

    def _write(self, picture: Picture) -> None:
        if self._encoder is None:
            make = _Animation if self._path.suffix == ANIMATION else _Codec
            self._encoder = make(self._path, picture.shape[1], picture.shape[0])
        self._encoder.write(picture)


class _Encoder(Protocol):
    def write(self, picture: Picture) -> None: ...

    def close(self, whole: bool) -> None: ...


class _Codec:
    """Pictures go to a temporary file as they come."""

    def __init__(self, path: Path, width: int, height: int):
        import cv2

        self._files, self._path, self._written = ExitStack(), path, 0
        self._temporary = self._files.enter_context(atomic_path(path))
        code = cv2.VideoWriter.fourcc(*VIDEO_CODECS[path.suffix])
        self._writer: Any = cv2.VideoWriter(str(self._temporary), code, contract.CONTROL_HZ, (width, height))
        if not self._writer.isOpened():
            raise UserError(f"This OpenCV cannot write {path.suffix} films: try another ending.")

    def write(self, picture: Picture) -> None:
        self._writer.write(picture[..., ::-1])
        self._written += 1

    def close(self, whole: bool) -> None:
        self._writer.release()
        with contextlib.suppress(BrokenOff), self._files:
            if not whole:
                raise BrokenOff
            if (kept := _frame_count(self._temporary)) < self._written:
                why = f"{kept} of {self._written} pictures were written: is the disk full?"
                raise OSError(errno.EIO, why, str(self._path))


class BrokenOff(Exception):
    """Takes a half-made film away."""


def _frame_count(film: Path) -> int:
    """Pictures that can be read from it."""
    import cv2

    reader, count = cv2.VideoCapture(str(film)), 0
    while reader.grab():
        count += 1
    reader.release()
    return count


class _Animation:
    """Pictures wait for the end."""

    def __init__(self, path: Path, width: int, height: int):
        self._path, self._pictures = path, []

    def write(self, picture: Picture) -> None:
        self._pictures.append(picture[..., ::-1].copy())

    def close(self, whole: bool) -> None:
        import cv2

        if not whole:
            return
        film: Any = cv2.Animation()
        film.frames = self._pictures
        film.durations = [round(1e3 * contract.CONTROL_DT_S)] * len(self._pictures)
        quality = [cv2.IMWRITE_WEBP_QUALITY, ANIMATION_QUALITY]
        ok, data = cv2.imencodeanimation(ANIMATION, film, quality)
        if not ok:
            raise UserError("This OpenCV cannot write .webp films: try another ending.")
        atomic_write_bytes(self._path, data.tobytes())


def depth_picture(depth: Depth) -> UInt8[np.ndarray, "H W 3"]:
    """(H, W, 3) uint8 of (H, W) depth on one scale for all frames; magenta where there is none."""
    return colored(millimetres(depth), NEAR_MM, FAR_MM)


def millimetres(depth: Depth) -> UInt16[np.ndarray, "H W"]:
    """(H, W) uint16 millimetres of a camera's depth in either unit."""
    return depth if depth.dtype == np.uint16 else to_millimetres(depth)
