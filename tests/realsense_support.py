"""librealsense without a camera: its software device fed with synthetic frames, and a stand-in."""

import threading
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

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

    def write(self, file: Path, frames: int) -> None:
        """Records `frames` frames with librealsense's recorder. RuntimeError: it writes no such files."""
        recorder = self._rs.recorder(str(file), self.device)
        queue, sensors = self._rs.frame_queue(2 * frames), recorder.query_sensors()
        for sensor in sensors:
            sensor.open(sensor.get_stream_profiles()[0])
            sensor.start(queue)
        for number in range(1, frames + 1):
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


class ScriptedLibrary:
    """What recording needs of pyrealsense2; the pipeline delivers `numbers`, or raises what is among them."""

    camera_info = SimpleNamespace(name="name", serial_number="serial_number")
    stream = SimpleNamespace(depth="depth", color="color")
    format = SimpleNamespace(z16="z16", rgb8="rgb8")
    option = SimpleNamespace(stereo_baseline="baseline", emitter_enabled="emitter")

    def __init__(self, numbers, *, start_error: str = "", serials: tuple[str, ...] = (SERIAL,)):
        self._numbers, self._start_error, self._serials = iter(numbers), start_error, serials
        self.asked: list[tuple] = []
        self.stopped = False

    def pipeline(self) -> "ScriptedLibrary":
        return self

    def config(self) -> Any:
        def ask(*values):
            self.asked.append(values)

        return SimpleNamespace(enable_device=ask, enable_stream=ask)

    def context(self) -> Any:
        devices = [SimpleNamespace(get_info=lambda what, serial=serial: serial) for serial in self._serials]
        return SimpleNamespace(query_devices=lambda: devices)

    def start(self, config) -> Any:
        if self._start_error:
            raise RuntimeError(self._start_error)
        sensor = SimpleNamespace(
            supports=lambda what: True, get_option=lambda what: -BASELINE_MM, get_depth_scale=lambda: 0.0001,
            set_option=lambda what, value: self.asked.append((what, value)),
        )  # fmt: skip
        device = SimpleNamespace(get_info=lambda what: NAME, first_depth_sensor=lambda: sensor)
        stream = SimpleNamespace(fps=lambda: 30, get_intrinsics=lambda: SimpleNamespace(fx=FX_PX))
        video = SimpleNamespace(as_video_stream_profile=lambda: stream)
        return SimpleNamespace(get_device=lambda: device, get_stream=lambda kind: video)

    def stop(self) -> None:
        self.stopped = True

    def wait_for_frames(self, timeout_ms: int) -> Any:
        number = next(self._numbers)
        if callable(number):
            number = number()
        if isinstance(number, Exception):
            raise number
        depth = SimpleNamespace(get_data=lambda: 10 * depth_mm(number), get_frame_number=lambda: number)
        color = SimpleNamespace(get_data=lambda: rgb(number))
        return SimpleNamespace(
            get_depth_frame=lambda: depth, get_color_frame=lambda: color, get_frame_number=lambda: number
        )
