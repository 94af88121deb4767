"""A RealSense D4xx through pyrealsense2 (`pip install 'ddgrasp[realsense]'`).

Written against pyrealsense2 2.59's documented API and tried through librealsense's own playback of
a synthetic stream; it has not been run on a camera by us.
"""

import contextlib
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from ddgrasp import contract, depth
from ddgrasp.errors import Trouble, UserError
from deploy.devices.options import Setup
from deploy.interfaces import CameraError, Clock, Frame, Robot
from sensors.recordings.realsense import load_pyrealsense2, project

STREAM_HZ = 30
_TIMEOUT_MS = 200
INTRINSICS_TOLERANCE = 0.1
"""A focal length or a principal point further than this share of the focal length from the stream's nominal
one is another camera, or another mode."""

_TRAINED_FOR = "D455"
_OTHER = (
    f"whose noise is not that of the {_TRAINED_FOR} that shipped policies know: docs/hardware.md says how to "
    "train for it"
)


def make(setup: Setup, robot: Robot) -> "RealSenseCamera":
    """At the policy's picture size."""
    serial = setup.config.deploy.realsense.serial
    return RealSenseCamera(setup.clock, setup.info.profile, serial=serial, say=setup.say)


class RealSenseCamera:
    """Raw depth of the newest frame at the policy's intrinsics, uint16 millimetres, no post-processing.

    Each pixel of the smaller picture takes the stream's pixel on its ray, by the intrinsics that the camera
    itself reports: a mean or median would already be a refinement that the policy was not trained on.
    """

    def __init__(
        self,
        clock: Clock,
        profile: contract.CameraProfile,
        *,
        serial: str = "",
        stream: contract.CameraProfile = contract.D455_STREAM,
        say: Callable[[str], None] = lambda text: None,
    ):
        """`profile` is the policy's camera, no larger than `stream`, the mode that the camera is run in;
        `say` is told which camera it is."""
        if profile.width_px > stream.width_px or profile.height_px > stream.height_px:
            raise UserError(
                f"the policy takes {profile.width_px}x{profile.height_px} depth, more than the stream's "
                f"{stream.width_px}x{stream.height_px}: take a policy that was trained at "
                "world.camera_scale 0.66 or less."
            )
        self._clock, self._profile, self._serial, self._say = clock, profile, serial, say
        self._pipeline: Any = None
        self._name = ""
        self._unit_m, self._mode, self._stream = contract.DEPTH_UNIT_M, stream, stream
        self._number: int | None = None
        self._frame: Frame | None = None

    def start(self) -> None:
        """Open the stream and check its intrinsics. Raises UserError."""
        rs = load_pyrealsense2()
        self._rs, pipeline, config = rs, rs.pipeline(), rs.config()
        self._number = self._frame = None  # of the stream before, whose counter begins anew
        if self._serial:
            config.enable_device(self._serial)
        size = self._mode.width_px, self._mode.height_px
        config.enable_stream(rs.stream.depth, *size, rs.format.z16, STREAM_HZ)
        config.enable_stream(rs.stream.color, *size, rs.format.rgb8, STREAM_HZ)
        try:
            active = pipeline.start(config)
        except RuntimeError as error:
            raise UserError(
                f"no RealSense depth and colour streams {size[0]}x{size[1]} at {STREAM_HZ} Hz "
                f"({error}); check the USB 3 cable and deploy.realsense.serial {self._serial!r}."
            ) from error
        self._pipeline = pipeline
        try:
            project(rs, active)
            name = active.get_device().get_info(rs.camera_info.name)
            self._unit_m = active.get_device().first_depth_sensor().get_depth_scale()
            intrinsics = active.get_stream(rs.stream.depth).as_video_stream_profile().get_intrinsics()
        except RuntimeError as error:
            self.stop()
            raise Trouble(
                f"the RealSense streams, and does not answer ({error}): plug it in anew."
            ) from error
        self._stream = self._checked(intrinsics)
        self._name = name
        known = _TRAINED_FOR in name
        self._say(f"camera: {name}" if known else f"camera: {name}, {_OTHER}")

    def device_name(self) -> str:
        """See Device."""
        return self._name

    def read(self) -> Frame:
        """The newest frame; waits for the first alone. A stream that pauses leaves its last one, whose time
        tells its age."""
        try:
            frames = self._pipeline.poll_for_frames()
            if not frames and self._frame is None:
                frames = self._pipeline.wait_for_frames(_TIMEOUT_MS)
        except RuntimeError as error:
            raise CameraError(str(error)) from error
        taken = frames.get_depth_frame() if frames else None
        if taken and taken.get_frame_number() != self._number:
            self._number = taken.get_frame_number()
            color = frames.get_color_frame()
            rgb = np.asanyarray(color.get_data()).copy() if color else None
            self._frame = Frame(self.convert(np.asanyarray(taken.get_data())), self._exposed_s(taken), rgb)
        if self._frame is None:
            raise CameraError("the stream has started, but no frame has come yet")
        return self._frame

    def convert(self, counts: np.ndarray) -> np.ndarray:
        """(H, W) uint16 millimetres at the policy's size from the stream's picture, in the device's own unit.

        A new array: librealsense reuses its buffer.
        """
        return depth.from_counts(depth.at_profile(counts, self._stream, self._profile), self._unit_m)

    def stop(self) -> None:
        """Close the stream, if it is open."""
        pipeline, self._pipeline = self._pipeline, None
        if pipeline is not None:
            with contextlib.suppress(RuntimeError):  # one that was unplugged
                pipeline.stop()

    def _exposed_s(self, taken: Any) -> float:
        """When the frame was exposed, on the loop's clock: the host's time of day tells its age."""
        now_s = self._clock.now()
        if taken.get_frame_timestamp_domain() == self._rs.timestamp_domain.hardware_clock:
            return now_s  # the device's own clock cannot be compared: the arrival has to do
        age_s = time.time() - taken.get_timestamp() * 1e-3
        return now_s - max(age_s, 0.0)

    def _checked(self, intrinsics: Any) -> contract.CameraProfile:
        """The stream as the camera reports it. Raises UserError if it is not the mode that was asked for.

        Its pixel centres are whole numbers, the contract's lie half a pixel further.
        """
        had = self._mode
        reported = {
            "fx": (intrinsics.fx, had.fx_px, had.fx_px),
            "fy": (intrinsics.fy, had.fy_px, had.fy_px),
            "cx": (intrinsics.ppx + 0.5, had.cx_px, had.fx_px),
            "cy": (intrinsics.ppy + 0.5, had.cy_px, had.fy_px),
        }
        for name, (value, nominal, focal) in reported.items():
            if abs(value - nominal) > INTRINSICS_TOLERANCE * focal:
                self.stop()
                raise UserError(
                    f"the camera's {name} is {value:.1f} px, a D455's at {had.width_px}x"
                    f"{had.height_px} is {nominal:.1f} px: use a D455, or a camera whose depth is like it."
                )
        fx, fy, cx, cy = (value for value, _, _ in reported.values())
        return replace(had, fx_px=fx, fy_px=fy, cx_px=cx, cy_px=cy)
