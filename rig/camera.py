"""The development rig's camera: colour and active-stereo depth of a MuJoCo state. JAX-free."""

from dataclasses import replace
from functools import partial

import mujoco
import numpy as np
from jaxtyping import Float, Float64, UInt8, UInt16

from ddgrasp import contract
from ddgrasp.config import Config, RandomConfig, RecordConfig, StereoConfig
from ddgrasp.depth import to_millimetres
from mjx_envs import draws, kinematics
from mjx_envs.camera import Buffers, Camera, look_at, nominal_camera
from mjx_envs.render.raycast_numpy import render, render_depth
from rig.world import RigWorld
from sensors.models.active_stereo import of_scale
from sensors.models.materials import rig_materials

FAR_M = 10.0
"""Beyond the matcher's range, so that range limits come from the camera alone."""
_STANDS = 0
"""Seed of `standing_pose`."""


class RigCamera:
    """Looks at `data` of `model`; reads both anew for every frame, so they may change in place."""

    def __init__(
        self,
        model: mujoco.MjModel,
        config: StereoConfig,
        profile: contract.CameraProfile,
        ideal: bool = False,
    ):
        """`ideal` depth is as rendered."""
        self.model, self._ideal = model, ideal
        self.stereo = of_scale(config, profile)
        self.other_tables = False
        """Whether every scene is before a table whose light and dark places are others. The rig's own has one
        that is so bright under the middle of the projector that the infrared picture is clipped there and
        nothing is matched: a hole in the bare table at the same place in nearly all trials."""
        self._scene: np.random.Generator | None = None

    def close(self) -> None:
        """Lets go of what it draws with."""

    def depth_mm(
        self,
        data: mujoco.MjData,
        T_world_cam: Float[np.ndarray, "4 4"],
        rng: np.random.Generator,
        object_name: str = "",
    ) -> UInt16[np.ndarray, "H W"]:
        """(H, W) uint16 millimetres as the camera reports them, 0 = invalid.

        Another `rng` is another scene.
        """
        if rng is not self._scene:
            self._scene = rng
            self._begin(rng)
        return self._sense(data, T_world_cam, rng, object_name)

    def _begin(self, rng: np.random.Generator) -> None:
        """Draws what a scene keeps, without a number of `rng`'s own."""
        if self.other_tables:
            self.stereo.paint_for(rng)

    def _sense(
        self,
        data: mujoco.MjData,
        T_world_cam: Float[np.ndarray, "4 4"],
        rng: np.random.Generator,
        object_name: str,
    ) -> UInt16[np.ndarray, "H W"]:
        """See `depth_mm`."""
        if self._ideal:
            return self.clean_mm(data, T_world_cam)
        draw, draw_depth = partial(self._draw, data), partial(self._draw_depth, data)
        return self.stereo.sense(draw, T_world_cam, rng, rig_materials(self.model, object_name), draw_depth)

    def clean_mm(
        self, data: mujoco.MjData, T_world_cam: Float[np.ndarray, "4 4"]
    ) -> UInt16[np.ndarray, "H W"]:
        """(H, W) uint16 millimetres as a camera without errors would report them."""
        return to_millimetres(self._draw_depth(data, self.pinhole(T_world_cam)))

    def rgb(self, data: mujoco.MjData, T_world_cam: Float[np.ndarray, "4 4"]) -> UInt8[np.ndarray, "H W 3"]:
        """(H, W, 3) uint8 colour, aligned to depth."""
        buffers = self._draw(data, self.pinhole(T_world_cam))
        return np.rint(np.clip(buffers.rgb, 0.0, 1.0) * 255.0).astype(np.uint8)

    def pinhole(self, T_world_cam: Float[np.ndarray, "4 4"]) -> Camera:
        """The camera of the pictures that it gives."""
        return self.stereo.camera(T_world_cam)

    def _draw(self, data: mujoco.MjData, camera: Camera) -> Buffers:
        return render(self.model, data, camera, far_m=FAR_M)

    def _draw_depth(self, data: mujoco.MjData, camera: Camera) -> Float[np.ndarray, "H W"]:
        return render_depth(self.model, data, camera, far_m=FAR_M)


def make_camera(config: Config, world: RigWorld, ideal: bool = False) -> RigCamera:
    """The configured camera, before `world`; `ideal` makes no errors."""
    camera = RigCamera(world.model, config.record.stereo, config.world.profile, ideal)
    camera.other_tables = config.record.other_tables
    return camera


def jittered_pose(config: RecordConfig, rng: np.random.Generator) -> Float64[np.ndarray, "4 4"]:
    """(4, 4) T_world_cam near the nominal extrinsics: position, aim and roll drawn uniformly."""
    position = np.array(contract.CAMERA_POSITION_M)
    aim = np.array(contract.CAMERA_LOOK_AT_M)
    position += rng.uniform(-1, 1, 3) * config.camera_position_jitter_m
    aim += rng.uniform(-1, 1, 3) * config.camera_aim_jitter_m
    roll = rng.uniform(-1, 1) * config.camera_roll_jitter_rad
    T_world_cam = look_at(position, aim)
    c, s = np.cos(roll), np.sin(roll)
    T_world_cam[:3, :3] = T_world_cam[:3, :3] @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return T_world_cam


def standing_pose(config: Config) -> Float64[np.ndarray, "4 4"]:
    """(4, 4) T_world_cam of the test rig's camera while nobody draws trials: one place, whatever seed or
    spread the configuration has, so that a calibration of it holds for every policy."""
    usual = replace(config, world=replace(config.world, random=RandomConfig()))
    return camera_pose(usual, np.random.default_rng(_STANDS))


def camera_pose(config: Config, rng: np.random.Generator) -> Float64[np.ndarray, "4 4"]:
    """(4, 4) T_world_cam of one trial: the nominal place within the calibration error trained for."""
    spread = config.world.random
    shift_m = rng.uniform(-1, 1, 3) * spread.camera_position_m
    turn = kinematics.quat_from_rotation_vector(rng.uniform(-1, 1, 3) * spread.camera_angle_rad)
    return draws.displaced(nominal_camera(config.world.profile).T_world_cam, shift_m, turn)
