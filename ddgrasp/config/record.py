"""Recordings from the development rig."""

from dataclasses import dataclass, field
from typing import Annotated

from ddgrasp.config.checks import Count, Range, Section
from ddgrasp.config.sensors import StereoConfig


@dataclass(frozen=True)
class RecordConfig(Section, name="record"):
    """RGB-D recordings from the development rig, and the rig's stereo camera."""

    trajectories: Count = 24
    """Recorded episodes of the teacher, objects in turn."""
    frames: Annotated[int, Range(1, 10000)] = 60
    """Frames per trajectory, at the control rate."""
    camera_position_jitter_m: Annotated[float, Range(0, 0.3)] = 0.05
    """Half width of the camera's uniform displacement per trajectory."""
    camera_aim_jitter_m: Annotated[float, Range(0, 0.3)] = 0.04
    """Half width of the uniform displacement of the point it looks at."""
    camera_roll_jitter_rad: Annotated[float, Range(0, 3.15)] = 0.05
    """Half width of its uniform roll."""
    other_tables: bool = False
    """Every recording, every trial on a rig and every episode of training behind the development rig's camera
    (student.depth_source rig) is before a table that is light and dark elsewhere; off: all before one and the
    same, whose brightest place is a hole that most of the development rig's frames share."""
    stereo: StereoConfig = field(default_factory=StereoConfig)
    """The camera itself."""
