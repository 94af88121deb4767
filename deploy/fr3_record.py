"""RGB-D recordings of the FR3 rig, as someone with an arm and a depth camera makes them.

In a lab the arm is moved by hand or by whatever drives it; here a script leads it over the table, to the
object and away with it, through the same driver and safety filter as a policy. The camera stands somewhere
else in every trajectory. What is kept is what the development rig's recordings have: pictures, no poses.
"""

from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float

from ddgrasp import contract, policy_metadata
from ddgrasp.config import Config
from ddgrasp.config_hash import differences
from ddgrasp.errors import UserError, unknown_name
from ddgrasp.files import atomic_write_json, read_json, to_json
from ddgrasp.progress import Progress
from deploy.clock import RobotClock
from deploy.devices import fr3_camera
from deploy.devices.franka_robot import LOST
from deploy.fr3_lab import Fr3Lab, PlacingRobot, Shapes, lab_config, stopping_at
from deploy.guided_path import GuidedPath, plan
from deploy.interfaces import Camera, Frame, Robot, RobotError
from deploy.safety import SafetyFilter
from deploy.setup import safety_filter
from rig.camera import jittered_pose
from rig.fr3 import scene
from rig.stage import describe_recording
from sensors.recordings.recording import Recording, is_recording
from sensors.recordings.writer import RecordingWriter, check_place

SETTINGS_FILE = "record.json"
CONTACT = 100.0
"""Newtons at the hand at which the arm stops itself (`stopping_at`)."""
_STREAM = 0x526563
"""Keeps these random numbers apart from every other stage's ("Rec")."""


@dataclass(frozen=True)
class Takes:
    """What to record."""

    seed: int
    objects: tuple[str, ...] = ()
    """Names, in turn from trajectory to trajectory; none takes the six that a student trains on."""
    shapes: Shapes = "mesh"
    """Mesh objects, or the development rig's primitives."""

    def names(self) -> tuple[str, ...]:
        """The objects. UserError for an unknown one."""
        trained = (*contract.SEEN_OBJECTS, *contract.UNSEEN_OBJECTS)
        known = trained if self.shapes == "primitive" else _meshes()
        for name in self.objects:
            if name not in known:
                raise unknown_name("object", name, known)
        return self.objects or contract.SEEN_OBJECTS


def record(config: Config, takes: Takes, out: Path, progress: Progress) -> list[Recording]:
    """`config.record.trajectories` recordings in `out`; those that are there are kept.

    UserError if `out` has recordings that were made otherwise, or something else where one is to be.
    """
    takes.names()
    paths = [out / f"fr3_{index:04d}" for index in range(config.record.trajectories)]
    for path in paths:
        check_place(path)
    _begin(config, takes, out)
    lab = Fr3Lab(takes.shapes)
    try:
        with progress.task("trajectories", len(paths)) as task:
            for index, path in enumerate(paths):
                if is_recording(path):
                    task.start_at(index + 1)
                    continue
                lab.repeated(partial(_take, config, takes, lab, index, path))
                task.advance()
    finally:
        lab.close()
    return [Recording.open(path) for path in paths]


def describe(recordings: list[Recording], out: Path) -> str:
    """A line for a terminal, and what to do next."""
    frames = sum(len(recording) for recording in recordings)
    invalid = np.mean([recording.meta["invalid_fraction_mean"] for recording in recordings])
    counts = f"{len(recordings)} recordings, {frames} frames, {invalid:.1%} of pixels invalid"
    return f"{out}: {counts}\nFit the generator to them: ddgrasp ddg fit --data {out} --out runs/fr3"


def _begin(config: Config, takes: Takes, out: Path) -> None:
    """Writes down what is recorded, or compares it with what was. More trajectories may come."""
    camera = {**asdict(config.record), "trajectories": None}
    if not config.record.other_tables:
        del camera["other_tables"]  # as in recordings that were begun before there was a choice
    made = to_json({"takes": takes, "record": camera, "camera_scale": config.world.camera_scale})
    file = out / SETTINGS_FILE
    if file.exists() and (other := next(differences(read_json(file), made), "")):
        raise UserError(f"{out} has recordings that were made otherwise ({other}): choose another --out.")
    out.mkdir(parents=True, exist_ok=True)
    atomic_write_json(file, made)


@dataclass(frozen=True)
class _Draw:
    """What chance decides about a trajectory."""

    clutter_seed: int
    place: dict[str, float]
    """Where the object is put: x_m, y_m, yaw_rad."""
    T_world_cam: Float[np.ndarray, "4 4"]
    rng: np.random.Generator
    """Draws the way and the camera's noise."""


def _draw(config: Config, takes: Takes, index: int) -> _Draw:
    rng = np.random.default_rng([takes.seed, _STREAM, index])
    clutter_seed = int(rng.integers(2**31))
    (x_m, y_m), yaw_rad = scene.start_pose(rng)
    place = {"x_m": x_m, "y_m": y_m, "yaw_rad": yaw_rad}
    return _Draw(clutter_seed, place, jittered_pose(config.record, rng), rng)


def _take(config: Config, takes: Takes, lab: Fr3Lab, index: int, path: Path) -> None:
    """One trajectory, written to `path` when complete; shorter if the arm stops itself. Raises RobotError."""
    names, draw = takes.names(), _draw(config, takes, index)
    name, profile = names[index % len(names)], config.world.profile
    rig = lab.with_object(name, draw.clutter_seed)
    settings, clock = lab_config(stopping_at(config.deploy, CONTACT), rig.host), RobotClock()
    known_way = replace(settings.franka, approach_below_m=0.0, give_way=1.0)
    settings = replace(settings, franka=known_way)
    robot = PlacingRobot(settings.franka, clock, rig.channel, draw.place)
    info = policy_metadata.describe(config.student, config.export, profile)
    safety = safety_filter(settings, info, "franka")
    way = GuidedPath(plan(lab.thing(name), draw.place, safety.limits, draw.rng))
    sense = fr3_camera.configured(config.record, profile, clock, draw.rng)
    camera = fr3_camera.Fr3Camera(rig.host, clock, sense, profile, draw.T_world_cam, in_colour=True)
    meta = describe_recording(profile, "FR3 rig, D455 at 848x480", name)
    with RecordingWriter(path, meta) as writer:
        for frame in _led(camera, robot, safety, clock, way, config.record.frames):
            assert frame.rgb is not None and frame.depth.dtype == np.uint16
            writer.add(frame.rgb, frame.depth)


def _led(
    camera: Camera, robot: Robot, safety: SafetyFilter, clock: RobotClock, way: GuidedPath, frames: int
) -> Iterator[Frame]:
    """A frame of every control period while the arm is led along `way`; fewer if it stops itself.

    Raises RobotError if the connection is lost, CameraError if the rig does not answer.
    """
    try:
        camera.start()
        robot.start()
        due_s = clock.now()
        for _ in range(frames):
            clock.sleep_until(due_s)
            yield camera.read()
            q_rad = robot.read_state().q_rad
            target, close, _ = safety.target(q_rad, way.action(q_rad))
            robot.command(target, close)
            due_s += contract.CONTROL_DT_S
    except RobotError as error:
        if str(error).startswith(LOST):
            raise
    finally:
        try:
            _stop(robot)
        finally:
            camera.stop()


def _stop(robot: Robot) -> None:
    """An arm that stops itself as it is to stop costs none of the frames. Raises RobotError if it is lost."""
    try:
        robot.stop()
    except RobotError as error:
        if str(error).startswith(LOST):
            raise


def _meshes() -> tuple[str, ...]:
    from rig.meshes.objects import MESH_OBJECTS

    return tuple(MESH_OBJECTS)
