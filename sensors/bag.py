"""Frames of a RealSense `.bag` through pyrealsense2 (`pip install -e '.[realsense]'`), depth unaligned.

Written against the documented API of pyrealsense2 2.56; no `.bag` was at hand to run it on.
"""

import importlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from ddgrasp.errors import UserError
from sensors.importers import RawFrame, Source

TIMEOUT_MS = 2000


def bag_source(file: Path) -> Source:
    """The depth and colour streams of `file`, depth in the device's own unit.

    Raises:
        UserError: pyrealsense2 is not installed, or `file` has no such streams.
    """
    rs = _pyrealsense2()
    pipeline, active = _start(rs, file)
    try:
        device = active.get_device()
        depth = active.get_stream(rs.stream.depth).as_video_stream_profile()
        sensor = device.first_depth_sensor()
        meta = {
            "sensor": device.get_info(rs.camera_info.name),
            "color_aligned_to_depth": False,
            "consecutive_frames": True,
            "hz": depth.fps(),
            "fx_px": depth.get_intrinsics().fx,
        }
        if sensor.supports(rs.option.stereo_baseline):
            meta["baseline_m"] = abs(sensor.get_option(rs.option.stereo_baseline)) / 1000.0
        unit_m = sensor.get_depth_scale()
    finally:
        pipeline.stop()
    return Source(file, lambda: _frames(rs, file), unit_m, meta)


def _frames(rs: Any, file: Path) -> Iterator[RawFrame]:
    pipeline, active = _start(rs, file)
    active.get_device().as_playback().set_real_time(False)
    try:
        while True:
            arrived, frames = pipeline.try_wait_for_frames(TIMEOUT_MS)
            if not arrived:
                return
            depth, color = frames.get_depth_frame(), frames.get_color_frame()
            # librealsense reuses its buffers, hence the copies.
            yield RawFrame(
                f"frame {frames.get_frame_number()}",
                np.array(depth.get_data()) if depth else None,
                np.array(color.get_data()) if color else None,
            )
    finally:
        pipeline.stop()


def _start(rs: Any, file: Path) -> tuple[Any, Any]:
    pipeline, config = rs.pipeline(), rs.config()
    try:
        config.enable_device_from_file(str(file), repeat_playback=False)
        config.enable_stream(rs.stream.depth, rs.format.z16)
        config.enable_stream(rs.stream.color, rs.format.rgb8)
        return pipeline, pipeline.start(config)
    except RuntimeError as error:
        raise UserError(
            f"{file}: no depth and colour streams of a RealSense can be read ({error}); record both."
        ) from error


def _pyrealsense2() -> Any:
    try:
        return importlib.import_module("pyrealsense2")
    except ImportError as error:
        raise UserError(f"A .bag needs pyrealsense2 ({error}): pip install -e '.[realsense]'.") from error
