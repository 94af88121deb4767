"""`ddgrasp deploy`: an exported policy on a robot and a camera chosen by name."""

import math
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ddgrasp import contract
from ddgrasp.config import Config
from ddgrasp.errors import UserError, unknown_name
from ddgrasp.policy_metadata import PolicyMetadata
from deploy.clock import RealClock
from deploy.interfaces import Camera, Clock, Robot
from deploy.loop import ControlLoop, LoopReport
from deploy.policy import OnnxPolicy
from deploy.setup import loop_settings, safety_filter

ROBOTS = ("sim", "franka")
CAMERAS = ("stereo", "realsense", "replay")


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


def deploy(
    config: Config, policy_path: Path, options: SessionOptions, say: Callable[[str], None] = print
) -> LoopReport:
    """Run the loop on the machine's clock; events go to `say` as they happen.

    SIGTERM ends it as Ctrl-C does: the robot holds, both devices are stopped, the report comes back.

    Raises UserError for an unknown name, a combination that cannot work, or a device that is absent.
    """
    _check(options)
    with _terminable():
        return _run(config, policy_path, options, say)


def _run(
    config: Config, policy_path: Path, options: SessionOptions, say: Callable[[str], None]
) -> LoopReport:
    policy = OnnxPolicy(
        policy_path,
        noise=config.deploy.noise,
        seed=config.seed,
        execute_steps=config.deploy.execute_steps or None,
    )
    clock = RealClock()
    robot, camera = _devices(config, options, policy.info, clock)
    settings = loop_settings(config.deploy, policy.info)
    loop = ControlLoop(camera, robot, policy, safety_filter(config.deploy, policy.info), clock, settings, say)
    steps = round(options.seconds * policy.info.control_hz) if math.isfinite(options.seconds) else None
    return loop.run(steps)


@contextmanager
def _terminable() -> Iterator[None]:
    """Turns the first SIGTERM into KeyboardInterrupt; a second one does not cut the stopping short."""

    def interrupt(signum, frame):
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        raise KeyboardInterrupt

    if threading.current_thread() is not threading.main_thread():  # signals are someone else's
        yield
        return
    previous = signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, previous)


def describe(report: LoopReport) -> str:
    """A few lines for a terminal."""
    values = report.as_dict()
    rows = [
        f"{'':<9}{'p50':>9}{'p99':>9}",
        *(
            _row(name, values[f"{name}_ms"])
            for name in ("sense", "infer", "act", "latency", "period", "jitter")
        ),
    ]
    safety = ", ".join(f"{name} {count}" for name, count in values["safety"].items())
    return "\n".join([
        *rows,
        f"{report.steps} steps, {report.timings.missed_deadlines} missed deadlines, {report.holds} holds",
        f"safety filter: {safety}",
    ])  # fmt: skip


def _row(name: str, percentiles: dict[str, float | None]) -> str:
    cells = ("-" if percentiles[p] is None else f"{percentiles[p]:.2f}" for p in ("p50", "p99"))
    return f"{name:<9}" + "".join(f"{cell:>9}" for cell in cells) + " ms"


def _check(options: SessionOptions) -> None:
    if options.robot not in ROBOTS:
        raise unknown_name("robot", options.robot, ROBOTS)
    if options.camera not in CAMERAS:
        raise unknown_name("camera", options.camera, CAMERAS)
    if options.robot == "franka" and options.camera == "stereo":
        raise UserError(
            "camera 'stereo' sees the simulated rig alone, not robot 'franka': use --camera realsense."
        )
    if options.robot == "franka" and options.camera == "replay":
        raise UserError(
            "camera 'replay' shows the past: robot 'franka' would move blindly; use --camera realsense."
        )
    if options.camera == "replay" and options.recording is None:
        raise UserError("camera 'replay' needs --recording DIR (one recording, as `ddgrasp record` writes).")
    if not options.seconds > 0:
        raise UserError(f"--seconds is {options.seconds:g}: choose more than 0, or inf to run until Ctrl-C.")


def _devices(
    config: Config, options: SessionOptions, info: PolicyMetadata, clock: Clock
) -> tuple[Robot, Camera]:
    if options.robot == "franka":
        return _franka(config, clock), _realsense(config, info, clock)
    return _rig(config, options, info, clock)


def _rig(config: Config, options: SessionOptions, info: PolicyMetadata, clock: Clock) -> tuple[Robot, Camera]:
    from deploy.devices.rig_camera import StereoCamera
    from deploy.devices.rig_robot import SimRobot
    from mjx_envs.objects import get_object
    from rig.camera import camera_pose, make_camera
    from rig.world import make_world

    name = get_object(options.object_name or config.world.objects[0]).name
    rng = np.random.default_rng(config.seed)
    world = make_world(config.world, (name,))
    world.reset(config.seed, name)
    robot = SimRobot(world, clock, 1.0 / info.control_hz)
    if options.camera == "realsense":
        return robot, _realsense(config, info, clock)
    if options.camera == "replay":
        from deploy.devices.replay_camera import ReplayCamera

        assert options.recording is not None
        return robot, ReplayCamera.open(options.recording, clock)
    rig_camera = make_camera(config, world)
    return robot, StereoCamera(world, rig_camera, camera_pose(config, rng), rng, robot.catch_up, name)


def _franka(config: Config, clock: Clock) -> Robot:
    from deploy.devices.franka_robot import FrankaRobot

    deploy_config = config.deploy
    return FrankaRobot(
        deploy_config.franka_host,
        clock,
        dynamics=deploy_config.franka_dynamics,
        grip_force_n=deploy_config.franka_grip_force_n,
    )


def _realsense(config: Config, info: PolicyMetadata, clock: Clock) -> Camera:
    from deploy.devices.realsense_camera import RealSenseCamera

    if info.depth_dtype != "uint16_mm":
        raise UserError(
            f"camera 'realsense' gives uint16 millimetres, the policy takes {info.depth_dtype}: export it "
            "with export.depth_dtype uint16_mm."
        )
    profile = contract.D455.scaled(info.depth_width / contract.D455.width_px)
    return RealSenseCamera(clock, profile, serial=config.deploy.realsense_serial)
