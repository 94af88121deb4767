"""What a person watches a trial with: a video file, or Rerun, in a window or in the browser."""

from collections.abc import Callable
from contextlib import ExitStack
from importlib import import_module
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from jaxtyping import UInt8, UInt16

from ddgrasp import contract
from ddgrasp.depth import to_millimetres
from ddgrasp.errors import UserError
from ddgrasp.files import atomic_path
from deploy.interfaces import Depth, Filmed, Simulated
from deploy.loop import Step
from rig.film import colored

VIDEO_CODECS = {".mp4": "mp4v", ".webm": "VP90"}
"""By the file's ending; browsers play WebM, and mp4v only players do."""
PANEL_PX = 640
"""Width of one picture in a video."""
NEAR_MM, FAR_MM = 350.0, 1100.0
"""Ends of the depth pictures' colour scale."""
VERDICT_S = 1.0
"""How long a video stays at the last picture."""
_LINE_PX = 30


class Viewer(Protocol):
    """Somebody who watches trials, one after the other."""

    def begin(self, title: str) -> None:
        """A trial begins."""
        ...

    def look(self, step: Step, camera: Filmed) -> None:
        """What `Bench.run` calls after every step."""
        ...

    def end(self, verdict: str) -> None:
        """The trial has ended like this."""
        ...

    def close(self) -> None:
        """There are no more trials."""
        ...


Noise = Callable[[UInt16[np.ndarray, "H W"]], UInt16[np.ndarray, "H W"]]
"""Clean depth -> depth with a camera's errors, millimetres."""


class Video:
    """Colour beside the depth that the policy sees, a picture for every control step; with `noise` also what
    that makes of clean depth, before cameras that know it."""

    def __init__(self, path: Path, noise: Noise | None = None):
        """UserError for another ending than .mp4 or .webm, or if OpenCV has no such encoder."""
        import cv2

        if path.suffix not in VIDEO_CODECS:
            raise UserError(f"--out {path}: a film ends with {' or '.join(VIDEO_CODECS)}.")
        self._files, self._path, self._cv2, self._noise = ExitStack(), path, cv2, noise
        self._writer: Any = None
        self._title, self._last = "", np.zeros((0, 0, 3), np.uint8)

    def begin(self, title: str) -> None:
        """See `Viewer`."""
        self._title = title

    def look(self, step: Step, camera: Filmed) -> None:
        """See `Viewer`."""
        if step.frame is None:
            return
        panels = [self._panel("colour", camera.picture(), exact=False)]
        panels.append(self._panel("camera's depth", depth_picture(step.frame.depth)))
        if self._noise is not None and isinstance(camera, Simulated):
            panels.append(self._panel("generator's depth", depth_picture(self._noise(camera.clean_mm()))))
        self._last = np.concatenate(panels, axis=1)
        text = f"{self._title}   step {step.index}   hand {1e3 * step.state.width_m:.0f} mm"
        self._write(self._labelled(text))

    def end(self, verdict: str) -> None:
        """See `Viewer`."""
        for _ in range(round(VERDICT_S * contract.CONTROL_HZ)):
            self._write(self._labelled(f"{self._title}   {verdict}"))

    def close(self) -> None:
        """The film takes its name."""
        if self._writer is not None:
            self._writer.release()
        self._files.close()

    def _panel(
        self, caption: str, picture: UInt8[np.ndarray, "H W 3"], exact: bool = True
    ) -> UInt8[np.ndarray, "h w 3"]:
        height, width = picture.shape[:2]
        size = PANEL_PX, 2 * round(PANEL_PX * height / width / 2)
        how = self._cv2.INTER_NEAREST if exact else self._cv2.INTER_CUBIC
        panel = self._cv2.resize(picture, size, interpolation=how)
        self._say(panel, caption, (255, 255, 255), size[1] - 10)
        return panel

    def _say(self, picture: UInt8[np.ndarray, "h w 3"], text: str, rgb: tuple[int, ...], y: int) -> None:
        font = self._cv2.FONT_HERSHEY_SIMPLEX
        self._cv2.putText(picture, text, (8, y), font, 0.5, rgb, 1, self._cv2.LINE_AA)

    def _labelled(self, text: str) -> UInt8[np.ndarray, "h w 3"]:
        bar = np.full((_LINE_PX, self._last.shape[1], 3), 255, np.uint8)
        self._say(bar, text, (0, 0, 0), _LINE_PX - 10)
        return np.concatenate([bar, self._last])

    def _write(self, picture: UInt8[np.ndarray, "h w 3"]) -> None:
        if self._writer is None:
            self._writer = self._opened(picture.shape[1], picture.shape[0])
        self._writer.write(picture[..., ::-1])

    def _opened(self, width: int, height: int) -> Any:
        temporary = self._files.enter_context(atomic_path(self._path))
        code = self._cv2.VideoWriter.fourcc(*VIDEO_CODECS[self._path.suffix])
        writer = self._cv2.VideoWriter(str(temporary), code, contract.CONTROL_HZ, (width, height))
        if not writer.isOpened():
            raise UserError(f"This OpenCV cannot write {self._path.suffix} films: try another ending.")
        return writer


class Rerun:
    """Rerun's viewer: pictures, joints and gripper against time."""

    def __init__(self, browser: bool, file: Path | None = None):
        """A window, or the viewer in a `browser`; with `file` (.rrd) neither. UserError without Rerun."""
        try:
            rerun = import_module("rerun")
        except ImportError as error:
            raise UserError(f"Rerun is not installed ({error}): pip install 'ddgrasp[view]'.") from error
        self._rr: Any = rerun
        self.address = ""
        rerun.init("ddgrasp play")
        if file is not None:
            file.parent.mkdir(parents=True, exist_ok=True)
            rerun.save(file)
        elif browser:
            self.address = rerun.serve_grpc()
            rerun.serve_web_viewer(open_browser=False, connect_to=self.address)
        else:
            rerun.spawn()
        self._steps = 0

    def begin(self, title: str) -> None:
        """See `Viewer`."""
        self._note(title)

    def look(self, step: Step, camera: Filmed) -> None:
        """See `Viewer`."""
        rr = self._rr
        self._steps += 1
        rr.set_time("step", sequence=self._steps)
        if step.frame is not None:
            depth = step.frame.depth
            rr.log("camera/colour", rr.Image(camera.picture()))
            rr.log("camera/depth", rr.DepthImage(_millimetres(depth), meter=1000.0))
        rr.log("robot/joints_rad", rr.Scalars(step.state.q_rad))
        rr.log("robot/width_mm", rr.Scalars(1e3 * step.state.width_m))
        if step.action is not None:
            rr.log("policy/action", rr.Scalars(step.action))

    def end(self, verdict: str) -> None:
        """See `Viewer`."""
        self._note(verdict)

    def close(self) -> None:
        """What was shown has been sent or is in the file."""
        self._rr.disconnect()

    def _note(self, text: str) -> None:
        self._rr.set_time("step", sequence=self._steps)
        self._rr.log("trials", self._rr.TextLog(text))


def depth_picture(depth: Depth) -> UInt8[np.ndarray, "H W 3"]:
    """(H, W, 3) uint8 of (H, W) depth on one scale for all frames; magenta where there is none."""
    return colored(_millimetres(depth), NEAR_MM, FAR_MM)


def _millimetres(depth: Depth) -> np.ndarray:
    return depth if depth.dtype == np.uint16 else to_millimetres(depth)
