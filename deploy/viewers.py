"""What a person watches a trial with: a film (deploy/video.py), Rerun, or MuJoCo's own viewer."""

import contextlib
import socket
import sys
import time
import warnings
from collections.abc import Callable
from contextlib import ExitStack, suppress
from importlib import import_module
from pathlib import Path
from typing import Any, Protocol
from urllib.parse import quote

from ddgrasp import contract
from ddgrasp.errors import UserError
from ddgrasp.files import atomic_path
from ddgrasp.install import pip_install
from deploy.interfaces import Filmed, Staged
from deploy.loop_report import Step
from deploy.video import BrokenOff, millimetres

WEB_PORT, GRPC_PORT = 9090, 9876
"""Rerun's own, of its web viewer and of what that is fed from."""


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

    def watched(self) -> bool:
        """Whether it is still looked at: a window may have been closed."""
        ...

    def close(self, whole: bool = True) -> None:
        """There are no more trials; `whole` unless something broke them off."""
        ...


class Rerun:
    """Rerun's viewer: pictures, joints and gripper against time."""

    def __init__(self, browser: bool, file: Path | None = None):
        """A window, or the viewer in a `browser`; with `file` (.rrd) neither. UserError without Rerun."""
        try:
            rerun = import_module("rerun")
        except ImportError as error:
            raise UserError(f"Rerun is not installed ({error}): {pip_install('view')}.") from error
        self._rr: Any = rerun
        self._files = ExitStack()
        self.url = ""
        """Where a browser finds it."""
        rerun.init("ddgrasp play")
        if file is not None:
            rerun.save(self._files.enter_context(atomic_path(file)))
        elif browser:
            address, port = rerun.serve_grpc(grpc_port=_free_port(GRPC_PORT)), _free_port(WEB_PORT)
            rerun.serve_web_viewer(web_port=port, open_browser=False, connect_to=address)
            self.url = f"http://localhost:{port}/?url={quote(address, safe='')}"
        else:
            rerun.spawn()
        rerun.send_blueprint(_layout())
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
            rr.log("camera/depth", rr.DepthImage(millimetres(depth), meter=1000.0))
        rr.log("robot/joints_rad", rr.Scalars(step.state.q_rad))
        rr.log("robot/width_mm", rr.Scalars(1e3 * step.state.width_m))
        if step.action is not None:
            rr.log(f"action/{step.by}", rr.Scalars(step.action))

    def end(self, verdict: str) -> None:
        """See `Viewer`."""
        self._note(verdict)

    def watched(self) -> bool:
        """See `Viewer`: who looks is not known."""
        return True

    def close(self, whole: bool = True) -> None:
        """What was shown has been sent or is in the file, what was broken off as well; where nothing was
        shown a file of that name stays as it was."""
        self._rr.disconnect()
        with suppress(BrokenOff), self._files:
            if not self._steps:
                raise BrokenOff

    def _note(self, text: str) -> None:
        self._rr.set_time("step", sequence=self._steps)
        self._rr.log("trials", self._rr.TextLog(text))


def _layout() -> Any:
    """Colour beside depth, what robot and policy do below, and how trials end."""
    show = import_module("rerun.blueprint")
    pictures = [show.Spatial2DView(origin=f"camera/{name}", name=name) for name in ("colour", "depth")]
    curves = [
        show.TimeSeriesView(origin=origin, name=name)
        for origin, name in (
            ("robot/joints_rad", "joints (rad)"),
            ("robot/width_mm", "hand's width (mm)"),
            ("action", "action, of policy or retry"),
        )
    ]
    trials = show.TextLogView(origin="trials", name="trials")
    rows = show.Vertical(show.Horizontal(*pictures), show.Horizontal(*curves, trials), row_shares=[3, 2])
    return show.Blueprint(rows, show.TimePanel(state="collapsed", timeline="step"), collapse_panels=True)


def _free_port(wanted: int) -> int:
    """`wanted`, or another one if somebody has it."""
    for port in (wanted, 0):
        with socket.socket() as probe, contextlib.suppress(OSError):
            probe.bind(("", port))
            return probe.getsockname()[1]
    raise UserError("--viewer web: no port is free for it here.")


class MujocoWindow:
    """MuJoCo's passive viewer: the scene from wherever the mouse looks, no faster than it happens."""

    def __init__(self, key: Callable[[int], None] | None = None):
        """`key` is told GLFW's code of every key. UserError where no window can be opened."""
        if sys.platform == "linux" and not _can_open():
            raise UserError("--viewer mujoco: no window can be opened on this display: choose web, or film.")
        self._key = key
        self._handle: Any = None
        self._model: Any = None
        self._closed = False
        self._next_s = 0.0

    def begin(self, title: str) -> None:
        """See `Viewer`; the title goes to the terminal alone."""

    def look(self, step: Step, camera: Filmed) -> None:
        """See `Viewer`. UserError if the camera's scene cannot be shown, or the window not opened."""
        if self._closed:
            return
        if not isinstance(camera, Staged):
            raise UserError("--viewer mujoco shows rigs alone: choose another viewer.")
        model, data = camera.scene()
        if model is not self._model:
            self._open(model, data)
        self._closed = not self._handle.is_running()
        if not self._closed:
            self._handle.sync()
            self._keep_pace()

    def end(self, verdict: str) -> None:
        """See `Viewer`."""

    def watched(self) -> bool:
        """See `Viewer`."""
        self._closed = self._closed or (self._handle is not None and not self._handle.is_running())
        return not self._closed

    def close(self, whole: bool = True) -> None:
        """The window goes."""
        if self._handle is not None:
            self._handle.close()

    def _open(self, model: Any, data: Any) -> None:
        self.close()
        viewer = import_module("mujoco.viewer")
        try:
            self._handle = viewer.launch_passive(
                model, data, key_callback=self._key, show_left_ui=False, show_right_ui=False
            )
        except RuntimeError as error:  # on macOS it wants mjpython
            raise UserError(f"--viewer mujoco: {error}: choose web or film.") from error
        self._model = model
        with self._handle.lock():
            self._handle.cam.lookat[:] = _LOOK_AT_M
            self._handle.cam.distance, self._handle.cam.azimuth, self._handle.cam.elevation = _FROM

    def _keep_pace(self) -> None:
        now_s = time.monotonic()
        time.sleep(max(0.0, self._next_s - now_s))
        self._next_s = max(now_s, self._next_s) + contract.CONTROL_DT_S


def _can_open() -> bool:
    """MuJoCo ends the whole process where GLFW cannot start."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return bool(import_module("glfw").init())


_LOOK_AT_M, _FROM = (0.4, 0.0, 0.25), (1.6, 140.0, -20.0)
"""Where the window looks at first: a point, and metres, azimuth and elevation (degrees) from it."""
