"""What the control loop needs from a camera, a robot and a clock.

All timestamps are seconds on the clock's own monotonic scale, so that ages can be told.
"""

from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float, Float32, Float64, UInt8, UInt16

if TYPE_CHECKING:
    import mujoco

Depth = UInt16[np.ndarray, "H W"] | Float32[np.ndarray, "H W"]


@dataclass(frozen=True)
class Frame:
    """One raw depth picture as the camera gave it."""

    depth: Depth
    """(H, W) planar depth: uint16 millimetres, or float32 metres for a policy that takes those; 0 = invalid.
    Size, focal length and principal point are those of the policy's profile: `ddgrasp.depth.at_profile`
    brings a camera's own there."""
    timestamp_s: float
    """When it was exposed, on the loop's clock."""
    rgb: UInt8[np.ndarray, "h w 3"] | None = None
    """Colour of the same moment, where the camera gives it anyway; without it no frame is recorded."""


@dataclass(frozen=True)
class RobotState:
    """Measured joints."""

    q_rad: Float[np.ndarray, "7"]
    """(7,) arm joint positions."""
    width_m: float
    """Opening between the finger pads."""
    timestamp_s: float
    met: str = ""
    """What the arm pressed on and gave way to since the state before, in words; empty if nothing."""
    felt_nm: Float[np.ndarray, "7"] | None = None
    """(7,) torques on the joints by what pressed on the arm hardest since then (what is done to the arm, not
    what it does); None if it does not say."""

    def vector(self) -> Float32[np.ndarray, "8"]:
        """(8,) float32, the policy's state input: arm joints (rad), then the gripper's width (m)."""
        return np.append(self.q_rad, self.width_m).astype(np.float32)


class CameraError(Exception):
    """A camera gave no frame (unplugged, timed out). A loop that has begun holds position and
    tries again."""


class RobotError(Exception):
    """A robot stopped by itself or fell silent (reflex, lost connection): one line. The run ends with it."""


@runtime_checkable
class Camera(Protocol):
    """A depth camera that always hands out its newest frame."""

    def start(self) -> None:
        """Open the device. Raises CameraError, with which the run ends, or UserError."""
        ...

    def read(self) -> Frame:
        """The newest frame, the same one again if there is no newer. Raises CameraError."""
        ...

    def stop(self) -> None:
        """Close the device; also called where `start` failed or was never reached."""
        ...


@dataclass(frozen=True)
class Lens:
    """Pinhole camera with distortion, in OpenCV's convention: whole numbers are pixel centres."""

    matrix: Float64[np.ndarray, "3 3"]
    """(3, 3) focal lengths and principal point, pixels."""
    distortion: Float64[np.ndarray, " d"]
    """(d,) OpenCV's coefficients; zeros for a rectified imager."""
    width_px: int
    height_px: int


@runtime_checkable
class Imager(Protocol):
    """The picture that calibration looks for a board in, from where depth is measured."""

    def start(self) -> None:
        """Open the device. Raises CameraError or UserError."""
        ...

    def lens(self) -> Lens:
        """As the device reports it; it must be open."""
        ...

    def picture(self) -> UInt8[np.ndarray, "H W"]:
        """(H, W) uint8 brightness of a picture exposed after the call. Raises CameraError."""
        ...

    def stop(self) -> None:
        """Close the device; also called where `start` failed or was never reached."""
        ...


@runtime_checkable
class KnowsItsPlace(Protocol):
    """An imager before a rig, which knows where it stands."""

    def truth(self) -> Float[np.ndarray, "4 4"]:
        """(4, 4) pose in the robot's base frame, metres."""
        ...


@runtime_checkable
class Robot(Protocol):
    """A seven-joint arm with a parallel gripper, position controlled."""

    def start(self) -> None:
        """Connect. Raises RobotError, with which the run ends, or UserError."""
        ...

    def read_state(self) -> RobotState:
        """Measured joints and gripper width. Raises RobotError, as the next two do."""
        ...

    def command(self, q_target_rad: Float[np.ndarray, "7"], close: bool) -> None:
        """Set the (7,) joint target and the gripper, without waiting for the motion to end."""
        ...

    def hold(self) -> None:
        """Stay where the arm is; the gripper keeps what it does."""
        ...

    def stop(self) -> None:
        """Stop any motion and disconnect; also called where `start` failed or was never reached."""
        ...


@runtime_checkable
class TimedRobot(Robot, Protocol):
    """A robot with a clock of its own."""

    def time_s(self) -> float | None:
        """Seconds since it began to answer, None while it does not. Raises RobotError."""
        ...


@runtime_checkable
class Clock(Protocol):
    """Time of the loop."""

    def now(self) -> float:
        """Seconds, monotonic."""
        ...

    def sleep_until(self, deadline_s: float) -> None:
        """Return at `deadline_s` or, where that has passed, at once. Never early."""
        ...


@runtime_checkable
class Filmed(Protocol):
    """A camera that takes pictures for people when it is asked."""

    def picture(self) -> UInt8[np.ndarray, "H W 3"]:
        """(H, W, 3) uint8 colour, from where depth is taken."""
        ...


@runtime_checkable
class Simulated(Protocol):
    """A camera before a simulation, which knows what one without errors would see."""

    def clean_mm(self) -> UInt16[np.ndarray, "H W"]:
        """(H, W) uint16 millimetres of the moment, 0 = nothing in range."""
        ...


@runtime_checkable
class Staged(Protocol):
    """A camera before a simulation that can be looked at from anywhere."""

    def scene(self) -> "tuple[mujoco.MjModel, mujoco.MjData]":
        """What is simulated; both change in place as it goes on."""
        ...


@runtime_checkable
class Pausing(Protocol):
    """A camera before a simulation that keeps its own time: what is done with a frame must not cost any."""

    def time_held(self) -> AbstractContextManager[None]:
        """That time nearly stands still meanwhile."""
        ...


@runtime_checkable
class KnowsObject(Protocol):
    """A camera before a rig, which knows what lies there."""

    def object_name(self) -> str:
        """Its name, once the camera has started."""
        ...


@runtime_checkable
class Device(Protocol):
    """A camera that one can buy."""

    def device_name(self) -> str:
        """As it calls itself, once it has started."""
        ...


@runtime_checkable
class Numbered(Protocol):
    """A camera that can be told from another of its kind."""

    def serial(self) -> str:
        """Its serial number, once it has started."""
        ...


@runtime_checkable
class Replayed(Protocol):
    """A camera that shows what another has recorded."""

    def recorded_as(self) -> dict[str, Any]:
        """What meta.json must say of its frames where they are recorded again, None for what is not known."""
        ...


@runtime_checkable
class Judge(Protocol):
    """A camera before a rig, which knows where the object is."""

    def success(self) -> bool:
        """Whether the object has been at the lift target for the last HOLD_STEPS control steps."""
        ...


class TrialCamera(Filmed, Judge, Protocol):
    """What a trial is filmed with and judged by."""

    def object_pos_m(self) -> Float[np.ndarray, "3"]:
        """(3,) the object's position in the robot's base frame, metres."""
        ...
