"""Trials of an exported policy on the FR3 rig: the driver, loop and safety filter of a lab's arm."""

import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from ddgrasp import contract
from ddgrasp.config import Config
from ddgrasp.config.deploy import FrankaConfig
from ddgrasp.errors import UserError
from deploy.clock import RobotClock
from deploy.devices import fr3_camera
from deploy.devices.franka_robot import LOST, FrankaRobot
from deploy.loop import ControlLoop, LoopReport
from deploy.policy import OnnxPolicy
from deploy.setup import loop_settings, safety_filter
from deploy.treatment import Replacement, Treatment, treated
from deploy.trials import Filming, Trial, TrialResult, Watch, result
from rig.camera import camera_pose
from rig.film import Film
from rig.fr3 import scene
from rig.fr3.channel import Channel
from rig.fr3.process import Fr3Rig, check_ports

Shapes = Literal["mesh", "primitive"]
Sight = Literal["stereo", "coarse", "ideal"]
DYNAMICS, START_DYNAMICS = 0.46, 0.3
"""Shares of the arm's limits: enough for every step that a policy may ask for, and a start of seconds."""
AWAY_M = (1.05, 0.0)
"""Where the object waits, on the table beyond the camera, while the arm goes to its start."""
SETTLE_S = 0.3
"""From when the object is put down to the first step."""
ATTEMPTS = 3
_STREAM = 0x467233
"""Keeps these trials' random numbers apart from every other stage's ("Fr3")."""


@dataclass(frozen=True)
class Fr3Bench:
    """What the trials have in common; makes an `Fr3Runner` in every worker."""

    shapes: Shapes = "mesh"
    """Mesh objects, or the primitives of the development rig."""
    sight: Sight = "stereo"
    """A D455 in the mode that it is run in, the same matching at the policy's size, or no errors at all."""
    contact: float = 100.0
    """Newtons at the hand, and newton metres at it and at the joints, at which the arm stops itself."""
    treatment: Treatment | Replacement | None = None
    """What is done to depth before the policy sees it."""

    def __call__(self, config: Config, policy_path: Path) -> "Fr3Runner":
        return Fr3Runner(config, policy_path, self)


class Fr3Runner:
    """One trial after the other; a rig runs as long as the object stays the same."""

    def __init__(self, config: Config, policy_path: Path, bench: Fr3Bench):
        import cv2

        cv2.setNumThreads(1)  # a rig for every core is the faster way to use them
        self._bench = bench
        self._policy = OnnxPolicy(
            policy_path, noise=config.deploy.noise, execute_steps=config.deploy.execute_steps or None
        )
        self._config = replace(config, deploy=replace(config.deploy, clock="robot"))
        self._rig: Fr3Rig | None = None
        self._name = ""

    def run(self, trial: Trial, watch: Watch | None = None) -> tuple[TrialResult, Film]:
        """Puts the object down where the trial says, runs the policy, and judges by where the object is.

        A connection that is lost says that this machine was too busy to keep it, and nothing of the policy:
        the trial is run again on a fresh rig. Raises UserError if it is lost `ATTEMPTS` times.
        """
        for _ in range(ATTEMPTS):
            report, success, film = self._attempt(trial, watch)
            if not report.fault.startswith(LOST):
                return result(trial, success, report), film
            self.close()
        raise UserError(
            f"{report.fault} ({ATTEMPTS} times): use fewer --workers, or end what else runs here."
        )

    def _attempt(self, trial: Trial, watch: Watch | None) -> tuple[LoopReport, bool, Film]:
        config = self._config
        rig = self._rig_with(trial.object_name)
        rng = np.random.default_rng([config.seed, _STREAM, trial.index])
        (x_m, y_m), yaw_rad = scene.start_pose(rng)
        self._policy.reset(int(rng.integers(2**31)))
        franka = replace(
            config.deploy.franka, host=rig.host, model="fr3", kernel="any",
            dynamics=DYNAMICS, start_dynamics=START_DYNAMICS,
            contact_force_n=self._bench.contact, contact_torque_nm=self._bench.contact,
        )  # fmt: skip
        settings = replace(config.deploy, franka=franka)
        clock = RobotClock()
        robot = _PlacingRobot(franka, clock, rig.channel, {"x_m": x_m, "y_m": y_m, "yaw_rad": yaw_rad})
        clock.follow(robot.time_s)
        info = self._policy.info
        profile = contract.D455.scaled(info.depth_width / contract.D455.width_px)
        pose = camera_pose(config, rng)
        camera = fr3_camera.Fr3Camera(rig.host, clock, self._sense(profile, clock, rng), profile, pose)
        safety = safety_filter(settings, info, "franka")
        seen = treated(camera, self._bench.treatment)
        loop = ControlLoop(seen, robot, self._policy, safety, clock, loop_settings(settings, info))
        filming = Filming(camera, config.deploy.film_every, watch)
        report = loop.run(config.world.episode_steps, filming.look)
        if report.interrupted:
            raise KeyboardInterrupt
        return report, camera.success() and not report.fault, filming.film()

    def close(self) -> None:
        """Ends the rig."""
        if self._rig is not None:
            self._rig.close()
        self._rig = None

    def _rig_with(self, name: str) -> Fr3Rig:
        """A rig with that object on its table."""
        if self._rig is not None and self._name == name and self._rig.running():
            return self._rig
        self.close()
        thing = scene.meshed(name) if self._bench.shapes == "mesh" else scene.primitive(name)
        self._rig, self._name = Fr3Rig(free_host(), thing, seed=self._config.seed), name
        return self._rig.__enter__()

    def _sense(self, profile: contract.CameraProfile, clock: RobotClock, rng: np.random.Generator):
        if self._bench.sight == "ideal":
            return fr3_camera.ideal(profile)
        stream = profile if self._bench.sight == "coarse" else contract.D455_STREAM
        return fr3_camera.stereo(self._config.record.stereo, profile, clock, rng, stream)


class _PlacingRobot(FrankaRobot):
    """Goes to its start with the object out of the way, which is then put down."""

    def __init__(self, config: FrankaConfig, clock: RobotClock, channel: Channel, place: dict[str, Any]):
        super().__init__(config, clock, confirm=lambda question: None)
        self._channel, self._place, self._ticks = channel, place, clock

    def start(self) -> None:
        """See FrankaRobot."""
        x_m, y_m = AWAY_M
        self._channel.ask("place", x_m=x_m, y_m=y_m, yaw_rad=0.0)
        super().start()
        self._channel.ask("place", **self._place)
        self._ticks.sleep_until(self._ticks.now() + SETTLE_S)


def free_host() -> str:
    """A loopback address at which no rig runs. Raises UserError if there is none."""
    for offset in range(200):
        host = f"127.0.{1 + os.getpid() % 200}.{2 + offset}"
        try:
            check_ports(host)
        except UserError:
            continue
        return host
    raise UserError("no loopback address is free for an FR3 rig: end the others.")
