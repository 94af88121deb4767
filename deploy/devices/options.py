"""What a session asks for, and what every device is made from."""

from dataclasses import dataclass
from pathlib import Path

from ddgrasp.config import Config
from ddgrasp.policy_metadata import PolicyMetadata
from deploy.interfaces import Clock


@dataclass(frozen=True)
class SessionOptions:
    """What to drive, what to look through, for how long."""

    robot: str = "sim"
    """sim (the pseudo-real rig) or franka."""
    camera: str = "stereo"
    """stereo (the rig's own camera), realsense, or replay (a recording; the robot acts on old pictures)."""
    recording: Path | None = None
    """Recording for camera replay."""
    object_name: str = ""
    """Object on the rig's table; empty takes the first configured one."""
    seconds: float = 6.0
    """How long to run; inf runs until Ctrl-C."""


@dataclass(frozen=True)
class Setup:
    """Made once for a session; each device file's `make` takes what it needs."""

    config: Config
    options: SessionOptions
    info: PolicyMetadata
    """The policy's: rate, picture size, depth type."""
    clock: Clock
