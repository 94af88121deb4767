"""Robots and cameras by name, and which of them go together.

A new device is a file beside this one with its class and a `make`, and a line here. The file is imported when
its device is made: a robot's computer needs no simulator.
"""

from collections.abc import Callable, Mapping
from importlib import import_module
from typing import Any

from ddgrasp.errors import UserError, unknown_name
from deploy.devices.options import SIMULATION, SessionOptions, Setup
from deploy.interfaces import Camera, Imager, Robot


def _from(file: str, make: str = "make") -> Callable[..., Any]:
    """`make` of the file beside this one, imported when it is called."""
    return lambda *arguments: getattr(import_module(f"{__package__}.{file}"), make)(*arguments)


ROBOTS: Mapping[str, Callable[[Setup], Robot]] = {
    SIMULATION: _from("rig_robot"),
    "franka": _from("franka_robot"),
}
CAMERAS: Mapping[str, Callable[[Setup, Robot], Camera]] = {
    "stereo": _from("rig_camera"),
    "realsense": _from("realsense_camera"),
    "replay": _from("replay_camera"),
    "rig": _from("fr3_camera"),
    "rig-ideal": _from("fr3_camera", "make_ideal"),
}
IMAGERS: Mapping[str, Callable[[Setup], Imager]] = {
    "realsense": _from("realsense_imager"),
    "rig": _from("fr3_imager"),
}
"""What calibration looks through, by the camera's name."""
REFUSED: Mapping[tuple[str, str], str] = {
    ("franka", "stereo"): "camera 'stereo' sees the simulated rig alone, not robot {robot!r}: "
    "use --camera realsense.",
    ("franka", "replay"): "camera 'replay' shows the past: robot {robot!r} would move blindly; "
    "use --camera realsense.",
    (SIMULATION, "rig"): "camera 'rig' sees the FR3 rig, not robot 'sim': "
    "use --camera stereo, or --robot franka.",
    (SIMULATION, "rig-ideal"): "camera 'rig-ideal' sees the FR3 rig, not robot 'sim': use --camera stereo.",
}
"""(robot, camera) that make no sense together, and why; all others do. What holds for 'franka' does for every
robot that is no simulation."""


def check_devices(options: SessionOptions) -> None:
    """UserError for an unknown name, a pair that makes no sense, or a replay without a recording."""
    if options.robot not in ROBOTS:
        raise unknown_name("robot", options.robot, ROBOTS)
    if options.camera not in CAMERAS:
        raise unknown_name("camera", options.camera, CAMERAS)
    kind = "franka" if options.real else SIMULATION
    if reason := REFUSED.get((kind, options.camera)):
        raise UserError(reason.format(robot=options.robot))
    if options.camera == "replay" and options.recording is None:
        raise UserError("camera 'replay' needs --recording DIR (one recording, as `ddgrasp record` writes).")


def make_devices(setup: Setup) -> tuple[Robot, Camera]:
    """The chosen robot and camera, not started; UserError if a driver or a recording is absent."""
    robot = ROBOTS[setup.options.robot](setup)
    return robot, CAMERAS[setup.options.camera](setup, robot)
