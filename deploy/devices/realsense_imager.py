"""A RealSense D4xx's left infrared imager, projector off, for calibration: depth is measured from its place.

Written against pyrealsense2 2.59's documented API; it has not been run on a camera by us.
"""

import contextlib
from typing import Any

import numpy as np
from jaxtyping import UInt8

from ddgrasp import contract
from ddgrasp.errors import Trouble, UserError
from deploy.devices.options import Setup
from deploy.interfaces import CameraError, Lens
from sensors.recordings.realsense import load_pyrealsense2, project

LEFT = 1
"""librealsense's number of the left infrared stream."""
STREAM_HZ = 15
SKIPPED = 3
"""Frames that may have been exposed before they were asked for."""
_TIMEOUT_MS = 3000
_COEFFICIENTS = 5


def make(setup: Setup) -> "RealSenseImager":
    """The configured camera, not open yet."""
    return RealSenseImager(setup.config.deploy.realsense.serial)


class RealSenseImager:
    """Brightness at 1280x720, where a pixel is smallest; intrinsics as the camera reports them."""

    def __init__(self, serial: str = ""):
        """`serial` empty takes the first camera found."""
        self._serial = serial
        self._rs: Any = None
        self._pipeline: Any = None
        self._active: Any = None
        self._lens: Lens | None = None

    def start(self) -> None:
        """Open the stream and switch the projector off. Raises UserError."""
        rs = self._rs = load_pyrealsense2()
        pipeline, config = rs.pipeline(), rs.config()
        if self._serial:
            config.enable_device(self._serial)
        size = contract.D455.width_px, contract.D455.height_px
        config.enable_stream(rs.stream.infrared, LEFT, *size, rs.format.y8, STREAM_HZ)
        try:
            active = pipeline.start(config)
        except RuntimeError as error:
            raise UserError(
                f"no RealSense infrared stream {size[0]}x{size[1]} at {STREAM_HZ} Hz ({error}); check the "
                f"USB 3 cable and deploy.realsense.serial {self._serial!r}."
            ) from error
        self._pipeline, self._active = pipeline, active
        try:
            project(rs, active, on=False)  # its dots would lie on the board
            stream = active.get_stream(rs.stream.infrared, LEFT).as_video_stream_profile()
            self._lens = lens_of(stream.get_intrinsics())
            self._serial = active.get_device().get_info(rs.camera_info.serial_number)
        except RuntimeError as error:
            self.stop()
            raise Trouble(
                f"the RealSense streams, and does not answer ({error}): plug it in anew."
            ) from error

    def lens(self) -> Lens:
        """The imager's own."""
        assert self._lens is not None
        return self._lens

    def serial(self) -> str:
        """See Numbered."""
        return self._serial

    def picture(self) -> UInt8[np.ndarray, "H W"]:
        """(720, 1280), exposed after the call. Raises CameraError."""
        try:
            for _ in range(SKIPPED):
                self._pipeline.wait_for_frames(_TIMEOUT_MS)
            frame = self._pipeline.wait_for_frames(_TIMEOUT_MS).get_infrared_frame(LEFT)
            return np.asanyarray(frame.get_data()).copy()  # a set without the frame fails here
        except RuntimeError as error:
            raise CameraError(str(error)) from error

    def stop(self) -> None:
        """Switch the projector on again and close the stream, if it is open."""
        pipeline, self._pipeline = self._pipeline, None
        if pipeline is not None:
            with contextlib.suppress(RuntimeError):  # a camera that has been unplugged
                project(self._rs, self._active)
            with contextlib.suppress(RuntimeError):
                pipeline.stop()


def lens_of(intrinsics: Any) -> Lens:
    """librealsense's intrinsics, whose pixel centres are whole numbers as OpenCV's are."""
    i = intrinsics
    matrix = np.array([[i.fx, 0.0, i.ppx], [0.0, i.fy, i.ppy], [0.0, 0.0, 1.0]])
    return Lens(matrix, np.array(i.coeffs[:_COEFFICIENTS], float), int(i.width), int(i.height))
