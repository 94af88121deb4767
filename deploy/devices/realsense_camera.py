"""A RealSense D4xx through pyrealsense2 (`pip install -e '.[realsense]'`).

Written against pyrealsense2 2.59's documented API and tried through librealsense's own playback of
a synthetic stream; it has not been run on a camera by us.
"""

import time
from typing import Any

import numpy as np

from ddgrasp import contract, depth
from ddgrasp.errors import UserError
from deploy.devices.options import Setup
from deploy.interfaces import CameraError, Clock, Frame, Robot
from sensors.recordings.realsense import load_pyrealsense2

STREAM_WIDTH_PX, STREAM_HEIGHT_PX = 1280, 720
FOCAL_TOLERANCE = 0.1
"""A focal length further than this (relative) from the policy's is another camera."""


def make(setup: Setup, robot: Robot) -> "RealSenseCamera":
    """At the policy's picture size; UserError for a policy that takes no millimetres."""
    info = setup.info
    if info.depth_dtype != "uint16_mm":
        raise UserError(
            f"camera 'realsense' gives uint16 millimetres, the policy takes {info.depth_dtype}: export it "
            "with export.depth_dtype uint16_mm."
        )
    profile = contract.D455.scaled(info.depth_width / contract.D455.width_px)
    return RealSenseCamera(setup.clock, profile, serial=setup.config.deploy.realsense.serial)


class RealSenseCamera:
    """Raw depth of the newest frame at a fraction of 1280 x 720, uint16 millimetres, no post-processing.

    The smaller picture takes one pixel of every block (its centre): a mean or median would already
    be a refinement that the policy was not trained on.
    """

    def __init__(
        self,
        clock: Clock,
        profile: contract.CameraProfile,
        *,
        serial: str = "",
        stream_hz: int = 30,
        timeout_ms: int = 200,
    ):
        """`profile` is the policy's camera; its size must divide 1280 x 720 evenly."""
        self._stride = STREAM_WIDTH_PX // profile.width_px
        fits = (profile.width_px * self._stride, profile.height_px * self._stride)
        if fits != (STREAM_WIDTH_PX, STREAM_HEIGHT_PX):
            raise UserError(
                f"the policy takes {profile.width_px}x{profile.height_px} depth, no whole fraction of "
                f"{STREAM_WIDTH_PX}x{STREAM_HEIGHT_PX}: export it with world.camera_scale 1, 0.5 or 0.25."
            )
        self._clock, self._profile, self._serial = clock, profile, serial
        self._stream_hz, self._timeout_ms = stream_hz, timeout_ms
        self._pipeline: Any = None
        self._unit_m = contract.DEPTH_UNIT_M
        self._number: int | None = None
        self._frame: Frame | None = None

    def start(self) -> None:
        """Open the stream and check its focal length. Raises UserError."""
        rs = load_pyrealsense2()
        self._rs, pipeline, config = rs, rs.pipeline(), rs.config()
        if self._serial:
            config.enable_device(self._serial)
        config.enable_stream(
            rs.stream.depth, STREAM_WIDTH_PX, STREAM_HEIGHT_PX, rs.format.z16, self._stream_hz
        )
        try:
            active = pipeline.start(config)
        except RuntimeError as error:
            raise UserError(
                f"no RealSense depth stream {STREAM_WIDTH_PX}x{STREAM_HEIGHT_PX} at {self._stream_hz} Hz "
                f"({error}); check the USB 3 cable and camera.serial {self._serial!r}."
            ) from error
        self._pipeline = pipeline
        self._unit_m = active.get_device().first_depth_sensor().get_depth_scale()
        intrinsics = active.get_stream(rs.stream.depth).as_video_stream_profile().get_intrinsics()
        self._check_focal(intrinsics.fx / self._stride)

    def read(self) -> Frame:
        """The newest frame; waits for one only at the very start, or when the stream has paused."""
        try:
            frames = self._pipeline.poll_for_frames()
            if not frames and self._frame is None:
                frames = self._pipeline.wait_for_frames(self._timeout_ms)
        except RuntimeError as error:
            raise CameraError(str(error)) from error
        taken = frames.get_depth_frame() if frames else None
        if taken and taken.get_frame_number() != self._number:
            self._number = taken.get_frame_number()
            self._frame = Frame(self._convert(np.asanyarray(taken.get_data())), self._exposed_s(taken))
        if self._frame is None:
            raise CameraError("the stream has started, but no frame has come yet")
        return self._frame

    def stop(self) -> None:
        """Close the stream, if it is open."""
        if self._pipeline is not None:
            self._pipeline.stop()
            self._pipeline = None

    def _convert(self, counts: np.ndarray) -> np.ndarray:
        """(H, W) uint16 millimetres from the full picture in the device's own unit.

        A new array: librealsense reuses its buffer.
        """
        size = (self._profile.height_px, self._profile.width_px)
        return depth.from_counts(depth.resize_nearest(counts, size), self._unit_m)

    def _exposed_s(self, taken: Any) -> float:
        """When the frame was exposed, on the loop's clock: the host's time of day tells its age."""
        now_s = self._clock.now()
        if taken.get_frame_timestamp_domain() == self._rs.timestamp_domain.hardware_clock:
            return now_s  # the device's own clock cannot be compared: the arrival has to do
        age_s = time.time() - taken.get_timestamp() * 1e-3
        return now_s - max(age_s, 0.0)

    def _check_focal(self, fx_px: float) -> None:
        wanted = self._profile.fx_px
        if abs(fx_px - wanted) > FOCAL_TOLERANCE * wanted:
            self.stop()
            raise UserError(
                f"the camera's focal length is {fx_px:.1f} px at this scale, the policy was trained for "
                f"{wanted:.1f} px: use a D455, or train with your camera's profile."
            )
