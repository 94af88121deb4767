"""librealsense without a camera: its software device fed with synthetic frames, and a stand-in."""

import sys
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

SIZE = (48, 64)
NAME, SERIAL = "Synthetic D455", "000123"
FX_PX, BASELINE_MM = 40.0, 95.0


def depth_mm(number: int) -> np.ndarray:
    """(48, 64) uint16: 600 + `number` everywhere but in the two left columns, which are holes."""
    depth = np.full(SIZE, 600 + number, np.uint16)
    depth[:, :2] = 0
    return depth


def rgb(number: int) -> np.ndarray:
    """(48, 64, 3) uint8 whose red says which frame it is."""
    return np.full((*SIZE, 3), (8 * number % 256, 40, 90), np.uint8)


def full_after(write: Callable[..., None], files: int) -> Callable[..., None]:
    """`write`(path, data, sync) of a recording on a disk that takes that many files, and a short one."""
    taken = []

    def writing(path: Path, data: bytes, sync: bool = False) -> None:
        taken.append(path)
        if len(taken) > files and path.suffix != ".json":
            path.write_bytes(data[:10])
            raise OSError(28, "No space left on device")
        write(path, data, sync)

    return writing


class SoftwareCamera:
    """librealsense's software device with a depth and a colour stream of 64x48 at 30 Hz."""

    def __init__(self, rs: Any):
        self._rs, self.device = rs, rs.software_device()
        self.device.register_info(rs.camera_info.name, NAME)
        self.device.register_info(rs.camera_info.serial_number, SERIAL)
        depth, color = (self.device.add_sensor(name) for name in ("Stereo Module", "RGB Camera"))
        depth.add_read_only_option(rs.option.depth_units, 0.001)
        depth.add_read_only_option(rs.option.stereo_baseline, BASELINE_MM)
        self._streams = (
            (depth, depth.add_video_stream(self._stream(rs.stream.depth, rs.format.z16, 2)), depth_mm),
            (color, color.add_video_stream(self._stream(rs.stream.color, rs.format.rgb8, 3)), rgb),
        )
        self.device.create_matcher(rs.matchers.dlr_c)
        self._kept_alive: list[np.ndarray] = []  # the library does not copy what it is given

    def give(self, number: int) -> None:
        """Delivers frame `number`, from 1."""
        rs = self._rs
        for sensor, profile, picture in self._streams:
            frame, pixels = rs.software_video_frame(), picture(number)
            self._kept_alive.append(pixels)
            frame.pixels, frame.bpp = pixels, pixels.itemsize * (1 if pixels.ndim == 2 else 3)
            frame.stride = frame.bpp * SIZE[1]
            frame.timestamp, frame.domain = number * 1000 / 30, rs.timestamp_domain.system_time
            frame.frame_number, frame.depth_units = number, 0.001
            frame.profile = profile.as_video_stream_profile()
            sensor.on_video_frame(frame)

    def write(self, file: Path, numbers: Sequence[int]) -> None:
        """Records frames of these numbers with librealsense's recorder. RuntimeError: it writes no such
        files."""
        recorder = self._rs.recorder(str(file), self.device)
        queue, sensors = self._rs.frame_queue(2 * len(numbers)), recorder.query_sensors()
        for sensor in sensors:
            sensor.open(sensor.get_stream_profiles()[0])
            sensor.start(queue)
        for number in numbers:
            self.give(number)
            time.sleep(0.01)
        time.sleep(0.3)  # a thread of its own writes
        for sensor in sensors:
            sensor.stop()
            sensor.close()

    def streaming(self) -> "Streaming":
        return Streaming(self.give)

    def _stream(self, kind: Any, pixel_format: Any, bytes_per_pixel: int) -> Any:
        rs = self._rs
        intrinsics, stream = rs.intrinsics(), rs.video_stream()
        intrinsics.height, intrinsics.width = stream.height, stream.width = SIZE
        intrinsics.fx = intrinsics.fy = FX_PX
        intrinsics.ppx, intrinsics.ppy = SIZE[1] / 2, SIZE[0] / 2
        intrinsics.model, intrinsics.coeffs = rs.distortion.none, [0.0] * 5
        stream.type, stream.fmt, stream.bpp, stream.fps = kind, pixel_format, bytes_per_pixel, 30
        stream.index, stream.uid, stream.intrinsics = 0, int(kind), intrinsics
        return stream


class Streaming:
    """Context in which frames arrive at 30 Hz."""

    def __init__(self, give: Callable[[int], None]):
        self._give, self._end = give, threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def __enter__(self) -> None:
        self._thread.start()

    def __exit__(self, *error) -> None:
        self._end.set()
        self._thread.join()

    def _run(self) -> None:
        number = 0
        while not self._end.wait(1 / 30):
            number += 1
            self._give(number)


class Nothing:
    """A set of frames without one, and the frame that is not in it: false, and without pixels."""

    def __bool__(self) -> bool:
        return False

    def get_depth_frame(self) -> "Nothing":
        return self

    def get_infrared_frame(self, index: int) -> "Nothing":
        return self

    def get_data(self) -> Any:
        raise RuntimeError('null pointer passed for argument "frame_ref"')


class ScriptedLibrary:
    """What recording, a camera and an imager need of pyrealsense2; buffers are reused, as the library's are.

    Every poll and every wait takes the next of `numbers`: a frame's, what is raised, or None, which is a set
    without frames. `said` lists what was asked, every poll and every wait, in order.
    """

    camera_info = SimpleNamespace(name="name", serial_number="serial_number")
    stream = SimpleNamespace(depth="depth", color="color", infrared="infrared")
    format = SimpleNamespace(z16="z16", rgb8="rgb8", y8="y8")
    option = SimpleNamespace(stereo_baseline="baseline", emitter_enabled="emitter")
    timestamp_domain = SimpleNamespace(hardware_clock="hardware_clock")
    intrinsics = SimpleNamespace(
        fx=FX_PX, fy=FX_PX, ppx=SIZE[1] / 2 - 0.5, ppy=SIZE[0] / 2 - 0.5, width=SIZE[1], height=SIZE[0],
        coeffs=[0.1, 0.2, 0.3, 0.4, 0.5],
    )  # fmt: skip

    def __init__(
        self, numbers: Iterable[Any], *, start_error: str = "", serials: tuple[str, ...] = (SERIAL,),
        unit_m: float = 0.0001, silent: str = "", stop_error: str = "",
    ):  # fmt: skip
        self._numbers, self._start_error, self._serials = iter(numbers), start_error, serials
        self._unit_m = unit_m
        self._depth, self._rgb, self._gray = depth_mm(0), rgb(0), np.zeros(SIZE, np.uint8)
        self.said: list[Any] = []
        self.silent = silent
        """What switching the projector raises, if not empty: it streams, and does not answer."""
        self._stop_error = stop_error
        self.stopped = False

    @property
    def asked(self) -> list[tuple]:
        """What was asked of the configuration and of the projector."""
        return [said for said in self.said if isinstance(said, tuple)]

    def pipeline(self) -> "ScriptedLibrary":
        return self

    def config(self) -> Any:
        def ask(*values):
            self.said.append(values)

        return SimpleNamespace(enable_device=ask, enable_stream=ask)

    def context(self) -> Any:
        devices = [SimpleNamespace(get_info=lambda what, serial=serial: serial) for serial in self._serials]
        return SimpleNamespace(query_devices=lambda: devices)

    def start(self, config) -> Any:
        if self._start_error:
            raise RuntimeError(self._start_error)
        sensor = SimpleNamespace(
            supports=lambda what: True, get_option=lambda what: -BASELINE_MM, set_option=self._set_option,
            get_depth_scale=lambda: self._unit_m,
        )  # fmt: skip
        told = {self.camera_info.name: NAME, self.camera_info.serial_number: self._serials[0]}
        device = SimpleNamespace(get_info=told.__getitem__, first_depth_sensor=lambda: sensor)
        stream = SimpleNamespace(fps=lambda: 30, get_intrinsics=lambda: self.intrinsics)
        video = SimpleNamespace(as_video_stream_profile=lambda: stream)
        return SimpleNamespace(get_device=lambda: device, get_stream=lambda *kind: video)

    def stop(self) -> None:
        self.said.append("stop")
        self.stopped = True
        if self._stop_error:
            raise RuntimeError(self._stop_error)

    def poll_for_frames(self) -> Any:
        self.said.append("poll")
        return self._next()

    def wait_for_frames(self, timeout_ms: int) -> Any:
        self.said.append("wait")
        return self._next()

    def _set_option(self, what: str, value: float) -> None:
        if self.silent:
            raise RuntimeError(self.silent)
        self.said.append((what, value))

    def _next(self) -> Any:
        item = next(self._numbers)
        number: Any = item() if callable(item) else item
        if isinstance(number, Exception):
            raise number
        if number is None:
            return Nothing()
        np.copyto(self._depth, depth_mm(number) * round(0.001 / self._unit_m))
        np.copyto(self._rgb, rgb(number))
        self._gray[:] = number % 256
        return SimpleNamespace(
            get_depth_frame=lambda: self._frame(number, self._depth), get_frame_number=lambda: number,
            get_color_frame=lambda: self._frame(number, self._rgb),
            get_infrared_frame=lambda index: self._frame(number, self._gray),
        )  # fmt: skip

    def _frame(self, number: int, pixels: np.ndarray) -> Any:
        return SimpleNamespace(
            get_data=lambda: pixels, get_frame_number=lambda: number,
            get_frame_timestamp_domain=lambda: self.timestamp_domain.hardware_clock,
        )  # fmt: skip


def scripted(monkeypatch: pytest.MonkeyPatch, numbers: Iterable[Any], **how: Any) -> ScriptedLibrary:
    """The library that drivers load from now on."""
    library = ScriptedLibrary(numbers, **how)
    monkeypatch.setitem(sys.modules, "pyrealsense2", library)
    return library
