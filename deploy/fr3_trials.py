"""Trials of an exported policy on the FR3 rig: the driver, loop and safety filter of a lab's arm."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float

from ddgrasp import contract
from ddgrasp.config import Config
from ddgrasp.layout import QPOS
from deploy.clock import RobotClock
from deploy.devices import fr3_camera
from deploy.devices.franka_robot import LOST
from deploy.fr3_lab import Fr3Lab, PlacingRobot, Shapes, lab_config
from deploy.interfaces import RobotError
from deploy.loop import ControlLoop
from deploy.loop_report import LoopReport
from deploy.policy import OnnxPolicy
from deploy.setup import loop_settings, safety_filter
from deploy.treatment import Replacement, Treatment, treated
from deploy.trials import Filming, Trial, TrialResult, Watch, drawn, result
from mjx_envs.kinematics import yaw_of
from rig.camera import camera_pose
from rig.film import Film
from rig.fr3 import scene

Sight = Literal["stereo", "coarse", "ideal"]
_STREAM = 0x467233
"""Keeps these trials' random numbers apart from every other stage's ("Fr3")."""


@dataclass(frozen=True)
class Fr3Bench:
    """What the trials have in common; makes an `Fr3Runner` in every worker."""

    shapes: Shapes = "mesh"
    """Mesh objects, or the primitives of the development rig."""
    sight: Sight = "stereo"
    """A D455 in the mode that it is run in, the same matching at the policy's size, or no errors at all."""
    treatment: Treatment | Replacement | None = None
    """What is done to depth before the policy sees it."""
    bare: bool = False
    """Without table, wall and clutter: on the ground, as the development rig."""
    paired: bool = False
    """Object and camera stand where the development rig's trial of the same number has them."""
    other_tables: bool = False
    """Every trial with sight stereo is before a table that is light and dark elsewhere, as with
    `record.other_tables` on."""

    def __call__(self, config: Config, policy_path: Path) -> "Fr3Runner":
        return Fr3Runner(config, policy_path, self)


@dataclass(frozen=True)
class PlacedDraw:
    """What chance decides about a trial."""

    place: dict[str, float]
    """Where the object is put: x_m, y_m, yaw_rad."""
    policy_seed: int
    T_world_cam: Float[np.ndarray, "4 4"]
    rng: np.random.Generator
    """Draws the camera's noise."""


class Fr3Runner:
    """One trial after the other; a rig runs as long as the object stays the same."""

    def __init__(self, config: Config, policy_path: Path, bench: Fr3Bench):
        import cv2

        cv2.setNumThreads(1)  # a rig for every core is the faster way to use them
        self._bench = bench
        self._policy = OnnxPolicy(
            policy_path, noise=config.deploy.noise, execute_steps=config.deploy.execute_steps or None
        )
        self._config = config
        self.lab = Fr3Lab(bench.shapes, bench.bare)

    def run(self, trial: Trial, watch: Watch | None = None) -> tuple[TrialResult, Film]:
        """Puts the object down where the trial says, runs the policy, and judges by where the object is.

        Raises UserError if the connection is lost again and again (`Fr3Lab.repeated`).
        """
        report, success, filming = self.lab.repeated(lambda: self._attempt(trial, watch))
        return result(trial, success, report, filming.object_pos_m), filming.film()

    def close(self) -> None:
        """Ends the rig."""
        self.lab.close()

    def _attempt(self, trial: Trial, watch: Watch | None) -> tuple[LoopReport, bool, Filming]:
        """Raises RobotError if the connection is lost; any other fault is in the report."""
        config, draw = self._config, self.draw(trial)
        rig = self.lab.with_object(trial.object_name, config.seed)
        self._policy.reset(draw.policy_seed)
        settings = lab_config(config.deploy, rig.host)
        clock = RobotClock()
        robot = PlacingRobot(settings.franka, clock, rig.channel, draw.place)
        info = self._policy.info
        sense = self._sense(info.profile, clock, draw.rng)
        camera = fr3_camera.Fr3Camera(rig.host, clock, sense, info.profile, draw.T_world_cam)
        safety = safety_filter(settings, info, "franka")
        seen = treated(camera, self._bench.treatment)
        loop = ControlLoop(seen, robot, self._policy, safety, clock, loop_settings(settings, info))
        filming = Filming(camera, config.deploy.film_every, watch)
        report = loop.run(config.world.episode_steps, filming.look)
        if report.interrupted:
            raise KeyboardInterrupt
        if report.fault.startswith(LOST) and not filming.succeeded:
            raise RobotError(report.fault)
        return report, filming.succeeded, filming

    def draw(self, trial: Trial) -> PlacedDraw:
        """What chance decides about `trial`."""
        if self._bench.paired:
            return _as_in_development(self._config, trial)
        rng = np.random.default_rng([self._config.seed, _STREAM, trial.index])
        (x_m, y_m), yaw_rad = scene.start_pose(rng)
        policy_seed = int(rng.integers(2**31))
        place = {"x_m": x_m, "y_m": y_m, "yaw_rad": yaw_rad}
        return PlacedDraw(place, policy_seed, camera_pose(self._config, rng), rng)

    def _sense(self, profile: contract.CameraProfile, clock: RobotClock, rng: np.random.Generator):
        if self._bench.sight == "ideal":
            return fr3_camera.ideal(profile)
        record = self._config.record
        if self._bench.sight == "coarse":
            return fr3_camera.stereo(record.stereo, profile, clock, rng, stream=profile)
        if self._bench.other_tables:
            record = replace(record, other_tables=True)
        return fr3_camera.configured(record, profile, clock, rng)


def _as_in_development(config: Config, trial: Trial) -> PlacedDraw:
    """Where the development rig's trial of the same number has everything."""
    from rig.world import make_world

    draw = drawn(config, trial)
    world = make_world(replace(config.world, objects=(trial.object_name,)))
    world.reset(draw.world_seed, trial.object_name)
    x_m, y_m, _ = (float(m) for m in world.data.qpos[QPOS.object_pos])
    yaw_rad = float(yaw_of(world.data.qpos[QPOS.object_quat]))
    place = {"x_m": x_m, "y_m": y_m, "yaw_rad": yaw_rad}
    return PlacedDraw(place, draw.policy_seed, draw.T_world_cam, draw.rng)
