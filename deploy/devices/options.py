"""What a session asks for, and what every device is made from."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from ddgrasp import contract
from ddgrasp.config import Config
from ddgrasp.policy_metadata import PolicyMetadata
from deploy.interfaces import Clock

SIMULATION = "sim"
"""The robot, as `--robot` names it, that is no arm; whatever else has a driver is one."""
RIG_CAMERAS = ("rig", "rig-ideal")
"""Cameras of the FR3 rig."""
RIG_HOST = "127.0.0.1"
"""Where `ddgrasp rig fr3` serves by default."""


@dataclass(frozen=True)
class SessionOptions:
    """What to drive, what to look through, for how long."""

    robot: str = SIMULATION
    """sim (the development rig) or franka."""
    camera: str = "stereo"
    """stereo (the rig's own camera), realsense, replay (a recording; the robot acts on old pictures), rig (a
    D455 before the FR3 rig that runs at the robot's host), or rig-ideal (the same without errors)."""
    recording: Path | None = None
    """Recording for camera replay."""
    object_name: str = ""
    """Object on the rig's table, empty takes the first configured one; before a real arm it is only noted."""
    seconds: float = contract.TRIAL_S
    """How long to run; inf runs until Ctrl-C."""
    dry_run: bool = False
    """Everything but the motion: what would be sent is said and drawn."""
    yes: bool = False
    """Move without asking first, nor for success at the end."""
    host: str = ""
    """Address of the robot's control unit; empty takes deploy.franka.host, or `RIG_HOST` with its cameras."""
    out: Path = Path("runs/deployments")
    """Folder that every run leaves its report in."""
    calibration: Path | None = None
    """What `ddgrasp calibrate` wrote; without it its usual place is looked at."""

    @property
    def real(self) -> bool:
        """Whether an arm moves, or the rig that runs behind an arm's protocol."""
        return self.robot != SIMULATION


@dataclass(frozen=True)
class Setup:
    """Made once for a session; each device file's `make` takes what it needs."""

    config: Config
    options: SessionOptions
    info: PolicyMetadata
    """The policy's: rate, picture size, depth type."""
    clock: Clock
    confirm: Callable[[str], None] = lambda question: None
    """Called with a question before a device moves by itself; raises UserError if a person says no, and in a
    dry run, in which nothing may move."""
    say: Callable[[str], None] = lambda text: None
    """Told what a device does before the loop begins."""
