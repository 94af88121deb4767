"""Stage `record`: RGB-D recordings from the development rig, as someone with a camera would make them.

The teacher moves the rig's robot, the active-stereo camera looks on from a slightly different place in
every trajectory. Only pictures are kept: no pose, no CAD model, no clean depth.
"""

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from ddgrasp import contract
from ddgrasp.artifacts import Artifact
from ddgrasp.config import Config
from ddgrasp.contract import CameraProfile
from ddgrasp.job import Job
from ddgrasp.layout import CONTROLS, closes
from ddgrasp.progress import Progress
from ddgrasp.workers import spread, worth
from mjx_envs.camera import nominal_camera
from mjx_envs.grasp_math import controls
from rig.camera import RigCamera, jittered_pose, make_camera
from rig.world import RigWorld, make_world
from sensors.recordings.recording import Recording, is_recording
from sensors.recordings.writer import RecordingWriter
from sensors.statistics import stats

FRAMES_A_PROCESS = 240
"""So many are worth a process: they take ten times as long as it takes to begin."""
STATIC_FRAMES = 10
"""Frames of a standing scene behind the temporal statistics."""

Policy = Callable[[Float[np.ndarray, "40"]], Float[np.ndarray, "8"]]
"""Observation (40,) to action (8,)."""


def run(job: Job) -> Artifact:
    """Record `config.record.trajectories` episodes; finished recordings are kept on resume."""
    config, directory, progress = job.config, job.directory, job.progress
    paths = [directory / f"rig_{index:04d}" for index in range(config.record.trajectories)]
    missing = [(index, path) for index, path in enumerate(paths) if not is_recording(path)]
    with progress.task("trajectories", len(paths)) as task:
        task.start_at(len(paths) - len(missing))
        for _ in record_all(config, job.parents["teacher"].directory, missing):
            task.advance()
    recordings = [Recording.open(path) for path in paths]
    _show(recordings, progress)
    return job.finish({**_summary(recordings), "static": _static_statistics(config)})


def record_all(config: Config, teacher: Path, trajectories: Sequence[tuple[int, Path]]) -> Iterator[None]:
    """Records trajectories, each by its number into a folder, on all cores where that is worth it; comes back
    after each. `teacher` is the folder of the stage."""
    started = partial(Recorder, config, teacher)
    count = len(trajectories)
    return spread(started, trajectories, worth(count * config.record.frames // FRAMES_A_PROCESS, count))


class Recorder:
    """World and camera, made once, and the teacher that moves one episode after the other before them."""

    def __init__(self, config: Config, teacher: Path):
        from ppo import policy as teacher_policy

        self._config, self._policy = config, teacher_policy.load(teacher)
        self._world = make_world(config.world)
        self._camera = make_camera(config, self._world)

    def run(self, trajectory: tuple[int, Path]) -> None:
        """Records one by its number, into a folder."""
        index, path = trajectory
        record_trajectory(self._config, index, path, self._world, self._camera, self._policy)

    def close(self) -> None:
        """See `ddgrasp.workers.Worker`."""
        self._camera.close()


def record_trajectory(
    config: Config, index: int, path: Path, world: RigWorld, camera: RigCamera, policy: Policy
) -> None:
    """One episode of the teacher, one frame per control step, written to `path` when complete."""
    rng = np.random.default_rng([config.seed, index])
    name = config.world.objects[index % len(config.world.objects)]
    world.reset(int(rng.integers(2**31)), name)
    T_world_cam = jittered_pose(config.record, rng)
    profile = config.world.profile
    sensor = f"pseudo-real rig, active stereo, D455 profile at scale {config.world.camera_scale:g}"
    with RecordingWriter(path, describe_recording(profile, sensor, name)) as writer:
        for _ in range(config.record.frames):
            writer.add(
                camera.rgb(world.data, T_world_cam), camera.depth_mm(world.data, T_world_cam, rng, name)
            )
            act(world, policy(world.observation()))


def act(world: RigWorld, action: Float[np.ndarray, "8"]) -> None:
    """Execute one (8,) action for one control period."""
    q, _ = world.state()
    world.command(controls(q, action)[CONTROLS.arm], bool(closes(action)))
    world.step(contract.CONTROL_DT_S)


def describe_recording(profile: CameraProfile, sensor: str, object_name: str) -> dict[str, Any]:
    """What meta.json says of a rig's recording: frames of `profile`, one per control step."""
    return {
        "sensor": sensor,
        "object": object_name,
        "color_aligned_to_depth": True,
        "consecutive_frames": True,
        "hz": contract.CONTROL_HZ,
        "fx_px": profile.fx_px,
        "fy_px": profile.fy_px,
        "cx_px": profile.cx_px,
        "cy_px": profile.cy_px,
        "baseline_m": profile.baseline_m,
    }


def _summary(recordings: list[Recording]) -> dict[str, Any]:
    # Every fifth frame says as much about holes as all of them.
    frames = [recording.depth_mm(i) for recording in recordings for i in range(0, len(recording), 5)]
    return {
        "trajectories": len(recordings),
        "frames": sum(len(recording) for recording in recordings),
        "skipped_frames": sum(len(recording.skipped) for recording in recordings),
        "invalid_fraction": float(np.mean([np.mean(frame == 0) for frame in frames])),
        "hole_components": float(np.mean([len(stats.hole_sizes_px(frame)) for frame in frames])),
    }


def _static_statistics(config: Config) -> dict[str, float]:
    """Noise over time needs a scene that stands still: the robot at rest, the nominal camera."""
    rng = np.random.default_rng([config.seed, config.record.trajectories])
    name = config.world.objects[0]
    world = make_world(config.world)
    world.reset(config.seed, name)
    camera = make_camera(config, world)
    T_world_cam = nominal_camera(config.world.profile).T_world_cam
    frames = [camera.depth_mm(world.data, T_world_cam, rng, name) for _ in range(STATIC_FRAMES)]
    return stats.measure(np.stack(frames)).as_dict()


def _show(recordings: list[Recording], progress: Progress) -> None:
    """A film strip of the first recording for the report."""
    recording = recordings[0]
    chosen = np.linspace(0, len(recording) - 1, 4).astype(int)
    progress.picture(
        "recorded",
        rgb=np.stack([recording.rgb(i) for i in chosen]),
        depth=np.stack([recording.depth_mm(i) for i in chosen]),
    )
