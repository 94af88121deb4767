"""A RealSense D4xx into a recording while it streams: `ddgrasp record realsense`.

Run on librealsense's software device (pyrealsense2 2.59, synthetic frames); not on a camera by us.
"""

import contextlib
import math
import os
import signal
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ddgrasp import contract
from ddgrasp.errors import Trouble, UserError, unknown_name
from ddgrasp.progress import Progress, Task
from ddgrasp.signals import ending, forget_terminal
from sensors.recordings.importers import Imported, RawFrame, Source, import_recording
from sensors.recordings.realsense import describe, load_pyrealsense2, project, raw_frame
from sensors.recordings.writer import check_left

STREAM_HZ = 30
"""The camera's own rate; a recording keeps every frame or every n-th."""
SETTLE_S = 0.5
"""Left out at the start, while the exposure settles."""
LONGEST_S = 3600.0
_TIMEOUT_MS = 3000


@dataclass(frozen=True)
class LiveOptions:
    """What to record."""

    frames: int
    hz: int = 10
    """Frames kept per second, a divisor of STREAM_HZ."""
    width_px: int = contract.D455_STREAM.width_px
    height_px: int = contract.D455_STREAM.height_px
    """Size of the depth and of the colour stream; deploy runs the camera at the same."""
    serial: str = ""
    """Serial number of the camera; empty takes the first."""

    def __post_init__(self):
        if self.frames < 1:
            raise UserError(f"{self.frames} frames asked for; expected at least 1.")
        rates = [hz for hz in range(1, STREAM_HZ + 1) if STREAM_HZ % hz == 0]
        if self.hz not in rates:
            raise UserError(
                f"--hz is {self.hz}; expected one of {', '.join(map(str, rates))} (the camera runs at "
                f"{STREAM_HZ})."
            )


class Pace:
    """Which frames of a camera are kept: every `step`-th by the camera's own counter."""

    def __init__(self, step: int):
        self._step = step
        self._last = self._due = 0

    def lost_before(self, number: int) -> int | None:
        """How many frames that were due have been missed, if frame `number` is kept; None if it is not."""
        if not self._due or number < self._last:  # the first, or the counter has started again
            self._due = number
        self._last = number
        if number < self._due:
            return None
        missed = (number - self._due) // self._step
        self._due += self._step * (missed + 1)
        return missed


@dataclass
class Take:
    """What became of a recording besides its pictures."""

    frames: int = 0
    lost: int = 0
    """Frames that were due but gone, because writing was too slow."""
    trouble: str = ""
    """Why it ended before its time, and the remedy; empty if it did not."""
    stopped: bool = False
    """Whether somebody ended it."""

    def meta(self, hz: int) -> dict[str, Any]:
        """Fields of meta.json: the rate that came of `hz`, and whether there are gaps."""
        if not self.lost:
            return {"hz": hz}
        rate = hz * self.frames / (self.frames + self.lost)
        return {"hz": float(f"{rate:.3g}"), "consecutive_frames": False}

    def cut_short(self, error: OSError) -> None:
        """The frame that was given last could not be written."""
        self.trouble = (
            f"a frame could not be written ({error.strerror or error}): those before it are kept; make room "
            "on the disk, or give another --out."
        )


def frame_count(frames: int, seconds: float, hz: int) -> int:
    """Frames to record: `frames`, or if that is 0, as many as `seconds` have. Raises UserError."""
    if frames < 0:
        raise UserError(f"--frames is {frames}; expected at least 1, or 0 for --seconds.")
    if frames:
        return frames
    if not 0 < seconds <= LONGEST_S:
        raise UserError(f"--seconds is {seconds:g}; expected more than 0, up to {LONGEST_S:g}.")
    return max(1, math.ceil(round(seconds * hz, 6)))  # 8.3 s at 30 Hz are 249 frames, not one more


def new_path(out: Path, name: str) -> Path:
    """`out`/`name` if it can become a recording. Raises UserError if it is taken, no plain name, or if frames
    of a recording of that name are left that was killed."""
    if not name or name.startswith(".") or Path(name).name != name:
        raise UserError(f"--name is {name!r}; expected a folder's name, for example desk (--out says where).")
    if not os.path.lexists(out / name):
        check_left(out / name, always=True)
        return out / name
    free = next(i for i in range(2, 10**6) if not (out / f"{name}_{i}").exists())
    raise UserError(f"{out / name} exists already: choose another, for example --name {name}_{free}.")


def record(options: LiveOptions, path: Path, progress: Progress) -> tuple[Imported, Take]:
    """Records the camera to `path`, which appears only when complete.

    Ctrl-C, SIGTERM or a closed terminal end the recording and keep what it has; so do a camera that stops
    after its first frame, and a disk that is full then.

    Raises:
        UserError: pyrealsense2 or the camera is missing, has no such streams, or gives no usable frame.
        Trouble: the camera does not answer, or what it gave could not be ended: says where its frames are.
        OSError: not even the first frame could be written.
        KeyboardInterrupt: stopped before the first frame.
    """
    rs = load_pyrealsense2()
    take = Take()
    with _started(rs, options) as (pipeline, profile), _stoppable() as stop:
        meta, unit_m = _described(rs, profile)
        meta["hz"] = options.hz  # of what is kept, also of a recording that is killed
        progress.note(f"{meta['sensor']}: the first {SETTLE_S:g} s are left out while its exposure settles")
        with progress.task("frames", options.frames) as task:
            source = Source(
                path,
                lambda: _kept(pipeline, options, take, stop, task),
                unit_m,
                meta,
                unit_is_certain=True,
                closing_meta=lambda: take.meta(options.hz),
                cut_short=take.cut_short,
            )
            return import_recording(source, path), take


def summary(imported: Imported, take: Take, frames: int) -> str:
    """What was recorded and what is missing, counts last."""
    lines = imported.lines
    if take.lost:
        lines.append(f"{take.lost} frames were lost, writing them took too long: take a lower --hz or size")
    early = f", stopped before the {frames} asked for" if take.frames < frames else ""
    return "\n".join([*lines, f"{imported.path}: {imported.frames} frames{early}"])


def _kept(
    pipeline: Any, options: LiveOptions, take: Take, stop: threading.Event, task: Task
) -> Iterator[RawFrame]:
    """The frames to record, until there are enough, someone stops it, or the camera does."""
    pace = Pace(STREAM_HZ // options.hz)
    settling = round(SETTLE_S * STREAM_HZ)
    while take.frames < options.frames and not stop.is_set():
        try:
            frames = pipeline.wait_for_frames(_TIMEOUT_MS)
        except RuntimeError as error:
            if not take.frames:
                raise Trouble(
                    f"the camera has started but gives no frames ({error}): check the USB 3 cable and port."
                ) from error
            take.trouble = f"the camera stopped ({error}): what it gave is kept; check the USB 3 cable."
            return
        if settling:
            settling -= 1
            continue
        lost = pace.lost_before((frames.get_depth_frame() or frames).get_frame_number())
        if lost is None:
            continue
        yield raw_frame(frames)
        take.lost += lost  # only now: before a frame that could not be written there is no gap
        take.frames += 1
        task.advance()
    take.stopped = stop.is_set()
    if not take.frames:
        raise KeyboardInterrupt("Stopped before the first frame: nothing was recorded.")


@contextlib.contextmanager
def _started(rs: Any, options: LiveOptions) -> Iterator[tuple[Any, Any]]:
    """(pipeline, profile) of the running camera."""
    pipeline, config = rs.pipeline(), rs.config()
    if options.serial:
        config.enable_device(options.serial)
    size = options.width_px, options.height_px
    config.enable_stream(rs.stream.depth, *size, rs.format.z16, STREAM_HZ)
    config.enable_stream(rs.stream.color, *size, rs.format.rgb8, STREAM_HZ)
    try:
        profile = pipeline.start(config)
    except RuntimeError as error:
        raise _not_started(rs, options, error) from error
    try:
        yield pipeline, profile
    finally:
        with contextlib.suppress(RuntimeError):  # of a camera that was unplugged
            pipeline.stop()


def _described(rs: Any, profile: Any) -> tuple[dict[str, Any], float]:
    """`describe` of a camera whose projector is on."""
    try:
        project(rs, profile)
        return describe(rs, profile)
    except RuntimeError as error:
        raise Trouble(f"the RealSense streams, and does not answer ({error}): plug it in anew.") from error


def _not_started(rs: Any, options: LiveOptions, error: RuntimeError) -> UserError:
    serials = [device.get_info(rs.camera_info.serial_number) for device in rs.context().query_devices()]
    if not serials:
        return UserError(
            f"no RealSense camera is connected ({error}): plug it into a USB 3 port; on Linux it also needs "
            "librealsense's udev rules."
        )
    if options.serial and options.serial not in serials:
        return unknown_name("--serial", options.serial, serials)
    return UserError(
        f"the camera gives no depth and colour of {options.width_px}x{options.height_px} at {STREAM_HZ} Hz "
        f"({error}): choose 848x480, 640x480 or 1280x720 (--width, --height), a USB 3 port, and close other "
        "programs that use it."
    )


@contextlib.contextmanager
def _stoppable() -> Iterator[threading.Event]:
    """Set by Ctrl-C, SIGTERM and a closed terminal, which otherwise do nothing: a frame is written to its
    end."""
    stop = threading.Event()

    def end(number: int, frame: Any) -> None:
        forget_terminal(number)
        stop.set()

    if threading.current_thread() is not threading.main_thread():  # signals are someone else's
        yield stop
        return
    kinds = ending()
    previous = [signal.signal(kind, end) for kind in kinds]
    try:
        yield stop
    finally:
        for kind, handler in zip(kinds, previous, strict=True):
            signal.signal(kind, handler)
