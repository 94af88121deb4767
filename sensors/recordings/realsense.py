"""RealSense D4xx frames through pyrealsense2 (extra `realsense`), depth unaligned, no filters.

Here the recorded file (`.bag`, or `.db3` as pyrealsense2 2.59 writes) and what it shares with a camera; the
camera is in `realsense_live.py`. Run on files of synthetic frames that pyrealsense2 2.56 (`.bag`) and 2.59
(`.db3`) wrote; no file of a real camera was at hand.
"""

import contextlib
import importlib
import math
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from ddgrasp.errors import UserError
from ddgrasp.install import pip_install
from sensors.recordings.sources import RawFrame, Source

END_OF_FILE_MS = 2000
"""A file that gives no frame for so long has ended."""


def file_source(file: Path) -> Source:
    """The depth and colour streams of `file`, depth in the device's own unit.

    Raises:
        UserError: pyrealsense2 is not installed, or `file` has no such streams.
    """
    rs = load_pyrealsense2()
    with _readable(file):
        _, _, profile = _opened(rs, file)
        meta, unit_m = describe(rs, profile)
    gaps = Gaps()
    return Source(
        file, lambda: _frames(rs, file, gaps), unit_m, meta, unit_is_certain=True, closing_meta=gaps.meta
    )


class Gaps:
    """Whether frames are missing between those of a file, by the camera's own counter."""

    def __init__(self):
        self._last, self._found = 0, False

    def count(self, number: int) -> None:
        """Frame `number` comes next."""
        self._found |= bool(self._last) and number != self._last + 1
        self._last = number

    def meta(self) -> dict[str, Any]:
        """Fields of meta.json."""
        return {"consecutive_frames": False} if self._found else {}


def describe(rs: Any, profile: Any) -> tuple[dict[str, Any], float]:
    """(fields of meta.json, metres per count of depth) of a pipeline's `profile`."""
    device = profile.get_device()
    depth = profile.get_stream(rs.stream.depth).as_video_stream_profile()
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
    return meta, sensor.get_depth_scale()


def project(rs: Any, profile: Any, on: bool = True) -> None:
    """Switches the projector of a pipeline that runs; a calibration that was killed leaves it off."""
    sensor = profile.get_device().first_depth_sensor()
    if sensor.supports(rs.option.emitter_enabled):
        sensor.set_option(rs.option.emitter_enabled, float(on))


def raw_frame(frames: Any) -> RawFrame:
    """Depth and colour of a set of frames, copied: librealsense reuses its buffers."""
    depth, color = frames.get_depth_frame(), frames.get_color_frame()
    return RawFrame(
        f"frame {frames.get_frame_number()}",
        np.array(depth.get_data()) if depth else None,
        np.array(color.get_data()) if color else None,
    )


def load_pyrealsense2() -> Any:
    """The module. Raises UserError if it, or a library of the system that it needs, is missing."""
    try:
        return importlib.import_module("pyrealsense2")
    except ModuleNotFoundError as error:
        remedy = pip_install("realsense")
        if sys.platform == "darwin":
            remedy = "it has no build for macOS; `ddgrasp record import` takes folders of pictures"
        raise UserError(f"RealSense needs pyrealsense2 ({error}): {remedy}.") from error
    except ImportError as error:
        raise UserError(
            f"pyrealsense2 cannot be loaded ({error}): install the library it names, for libusb on Debian or "
            "Ubuntu apt install libusb-1.0-0."
        ) from error


def _frames(rs: Any, file: Path, gaps: Gaps) -> Iterator[RawFrame]:
    with _readable(file):
        pipeline, config, profile = _opened(rs, file)
        playback = profile.get_device().as_playback()
        # Before the start: what is played in real time until then is lost to a slow reader.
        playback.set_real_time(False)
        # Else one stream may be at the file's end, or well into it, before the other has started: of 246
        # readings of a file of 20 frames 8 lacked 1 to 19. To resume takes the library up to 10 s.
        playback.pause()
        pipeline.start(config)
    try:
        with _readable(file):
            playback.resume()
        for number, frame in once(_sets(pipeline, file)):
            if number is not None:
                gaps.count(number)
            yield frame
    finally:
        with contextlib.suppress(RuntimeError):
            pipeline.stop()


@contextlib.contextmanager
def _readable(file: Path) -> Iterator[None]:
    """UserError in the place of what librealsense raises inside."""
    try:
        yield
    except RuntimeError as error:
        raise UserError(f"{file}: cannot be read ({error}); copy it again, or record it anew.") from error


def _sets(pipeline: Any, file: Path) -> Iterator[tuple[int | None, float, RawFrame]]:
    """(number of its depth or None, milliseconds between its pictures, frame) of every set of a file."""
    while True:
        with _readable(file):
            arrived, frames = pipeline.try_wait_for_frames(END_OF_FILE_MS)
        if not arrived:
            return
        depth, color = frames.get_depth_frame(), frames.get_color_frame()
        apart_ms = abs(depth.get_timestamp() - color.get_timestamp()) if depth and color else math.inf
        yield depth.get_frame_number() if depth else None, apart_ms, raw_frame(frames)


def once(
    sets: Iterable[tuple[int | None, float, RawFrame]],
) -> Iterator[tuple[int | None, RawFrame]]:
    """(number, frame) of every depth picture once, with the colour that is nearest to it in time.

    While one stream of a file is ahead, librealsense gives its last picture again with each of the other's.
    """
    number, nearest_ms, nearest = None, math.inf, None
    for now, apart_ms, frame in sets:
        again = nearest is not None and now is not None and now == number
        if nearest is not None and not again:
            yield number, nearest
        if not again or apart_ms < nearest_ms:
            number, nearest_ms, nearest = now, apart_ms, frame
    if nearest is not None:
        yield number, nearest


def _opened(rs: Any, file: Path) -> tuple[Any, Any, Any]:
    """(pipeline, config, profile) of `file`, not started."""
    pipeline, config = rs.pipeline(), rs.config()
    try:
        config.enable_device_from_file(str(file), repeat_playback=False)
        # Without a rate (0: any), the binding takes the format for a stream's index and finds none.
        config.enable_stream(rs.stream.depth, rs.format.z16, 0)
        config.enable_stream(rs.stream.color, rs.format.rgb8, 0)
        return pipeline, config, config.resolve(rs.pipeline_wrapper(pipeline))
    except RuntimeError as error:
        raise UserError(
            f"{file}: no depth (z16) and colour (rgb8) of a RealSense can be read ({error}); record both, or "
            "update pyrealsense2 if a newer one wrote the file."
        ) from error
