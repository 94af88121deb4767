"""Standing table scenes before the rig's camera: what its defects are measured on. JAX-free."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from jaxtyping import Bool, UInt16

from ddgrasp.config import RecordConfig
from ddgrasp.contract import CameraProfile
from mjx_envs.render.raycast_numpy import render
from rig.camera import FAR_M, RigCamera, jittered_pose
from rig.world import RigWorld


@dataclass(frozen=True)
class StandingScene:
    """Frames of one scene in which nothing moves."""

    object_name: str
    depth_mm: UInt16[np.ndarray, "T H W"]
    """(T, H, W) uint16, as the camera reports it."""
    object_px: Bool[np.ndarray, "H W"]
    """(H, W) bool: pixels that show the object, from the renderer; no method sees this."""


def standing_scenes(
    config: RecordConfig,
    profile: CameraProfile,
    objects: Sequence[str],
    per_object: int,
    frames: int,
    seed: int,
) -> Iterator[StandingScene]:
    """`per_object` scenes of every object: the robot at home, the object and the camera somewhere else each.

    Scene i is the same whatever the camera's configuration: cameras are compared on the same scenes.
    """
    world = RigWorld(objects)
    camera = RigCamera(world.model, config.stereo, profile)
    camera.other_tables = config.other_tables
    body = mujoco.mj_name2id(world.model, mujoco.mjtObj.mjOBJ_BODY, "object")
    for index in range(per_object * len(objects)):
        name = objects[index % len(objects)]
        rng = np.random.default_rng([seed, index])
        world.reset(int(rng.integers(2**31)), name)
        T_world_cam = jittered_pose(config, rng)
        depth = np.stack([camera.depth_mm(world.data, T_world_cam, rng, name) for _ in range(frames)])
        seen = render(world.model, world.data, camera.stereo.camera(T_world_cam), FAR_M).segmentation
        yield StandingScene(name, depth, (seen >= 0) & (world.model.geom_bodyid[seen] == body))
