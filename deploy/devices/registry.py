"""Robots and cameras by name, and which of them go together.

A new device is a file beside this one with its class and a `make`, and a line here.
"""

from collections.abc import Callable, Mapping

from ddgrasp.errors import UserError, unknown_name
from deploy.devices import (
    fr3_camera,
    fr3_imager,
    franka_robot,
    realsense_camera,
    realsense_imager,
    replay_camera,
    rig_camera,
    rig_robot,
)
from deploy.devices.options import SessionOptions, Setup
from deploy.interfaces import Camera, Imager, Robot

ROBOTS: Mapping[str, Callable[[Setup], Robot]] = {"sim": rig_robot.make, "franka": franka_robot.make}
CAMERAS: Mapping[str, Callable[[Setup, Robot], Camera]] = {
    "stereo": rig_camera.make,
    "realsense": realsense_camera.make,
    "replay": replay_camera.make,
    "rig": fr3_camera.make,
    "rig-ideal": fr3_camera.make_ideal,
}
IMAGERS: Mapping[str, Callable[[Setup], Imager]] = {
    "realsense": realsense_imager.make,
    "rig": fr3_imager.make,
}
"""What calibration looks through, by the camera's name."""
REFUSED: Mapping[tuple[str, str], str] = {
    ("franka", "stereo"): "camera 'stereo' sees the simulated rig alone, not robot 'franka': "
    "use --camera realsense.",
    ("franka", "replay"): "camera 'replay' shows the past: robot 'franka' would move blindly; "
    "use --camera realsense.",
    ("sim", "rig"): "camera 'rig' sees the FR3 rig, not robot 'sim': use --camera stereo, or --robot franka.",
    ("sim", "rig-ideal"): "camera 'rig-ideal' sees the FR3 rig, not robot 'sim': use --camera stereo.",
}
"""(robot, camera) that make no sense together, and why; all others do."""


def check_devices(options: SessionOptions) -> None:
    """UserError for an unknown name, a pair that makes no sense, or a replay without a recording."""
    if options.robot not in ROBOTS:
        raise unknown_name("robot", options.robot, ROBOTS)
    if options.camera not in CAMERAS:
        raise unknown_name("camera", options.camera, CAMERAS)
    if reason := REFUSED.get((options.robot, options.camera)):
        raise UserError(reason)
    if options.camera == "replay" and options.recording is None:
        raise UserError("camera 'replay' needs --recording DIR (one recording, as `ddgrasp record` writes).")


def make_devices(setup: Setup) -> tuple[Robot, Camera]:
    """The chosen robot and camera, not started; UserError if a driver or a recording is absent."""
    robot = ROBOTS[setup.options.robot](setup)
    return robot, CAMERAS[setup.options.camera](setup, robot)
