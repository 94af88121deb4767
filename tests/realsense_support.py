"""librealsense without a camera: its software device, fed with synthetic frames."""

import time
from pathlib import Path
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
