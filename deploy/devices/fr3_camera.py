"""The FR3 rig's cameras as camera drivers: a D455 as it is run, and one that makes no errors."""

from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, UInt8, UInt16

from ddgrasp import contract
from ddgrasp.config import RecordConfig, StereoConfig
from ddgrasp.depth import to_millimetres
from deploy.devices.options import Setup
from deploy.devices.realsense_camera import RealSenseCamera
from deploy.interfaces import CameraError, Clock, Depth, Frame, Robot
from mjx_envs.camera import Camera
from mjx_envs.grasp_math import at_lift_target

if TYPE_CHECKING:
    import mujoco

    from rig.fr3.channel import Channel
    from rig.fr3.picture import ScenePicture

Pose = Float[np.ndarray, "4 4"]
Sense = Callable[["ScenePicture", Pose, str], Depth]
"""From the scene as it stands, where the camera is, and the object's name: (H, W) uint16 millimetres."""


def make(setup: Setup, robot: Robot) -> "Fr3Camera":
    """A D455 before the rig that runs at the robot's host, at its nominal place within its error."""
    profile, rng = setup.info.profile, np.random.default_rng(setup.config.seed)
    return _at_place(setup, profile, configured(setup.config.record, profile, setup.clock, rng))


def make_ideal(setup: Setup, robot: Robot) -> "Fr3Camera":
    """A camera without errors at the same place."""
    profile = setup.info.profile
    return _at_place(setup, profile, ideal(profile))


def configured(
    record: RecordConfig, profile: contract.CameraProfile, clock: Clock, rng: np.random.Generator
) -> Sense:
    """The configured D455 as it is run, before the rig's own table or one that follows from `rng`."""
    return stereo(record.stereo, profile, clock, rng, other_tables=record.other_tables)


def stereo(
    config: StereoConfig,
    profile: contract.CameraProfile,
    clock: Clock,
    rng: np.random.Generator,
    stream: contract.CameraProfile = contract.D455_STREAM,
    other_tables: bool = False,
) -> Sense:
    """Matching at the size of `stream`, then what the RealSense driver does to a frame.

    Args:
      config: the camera.
      profile: the policy's picture.
      clock: the driver's.
      rng: draws the noise.
      stream: the picture in which it matches.
      other_tables: whether the table's light and dark places follow from `rng` (`record.other_tables`).
    """
    from sensors.models.active_stereo import of_scale
    from sensors.models.materials import rig_materials

    camera, driver = of_scale(config, stream), RealSenseCamera(clock, profile, stream=stream)
    if other_tables:
        camera.paint_for(rng)

    def sense(picture: "ScenePicture", T_world_cam: Pose, name: str) -> Depth:
        materials = rig_materials(picture.model, name)
        return driver.convert(camera.sense(picture.buffers, T_world_cam, rng, materials, picture.depth_m))

    return sense


def ideal(profile: contract.CameraProfile) -> Sense:
    """Rendered depth of the policy's picture."""

    def sense(picture: "ScenePicture", T_world_cam: Pose, name: str) -> Depth:
        return to_millimetres(picture.depth_m(Camera.of(profile, T_world_cam)))

    return sense


class Fr3Camera:
    """Asks the rig where everything is and pictures it: uint16 millimetres, 0 = invalid.

    Time nearly stands still in the rig while a picture is made, which may take longer than a control step.
    """

    def __init__(
        self,
        host: str,
        clock: Clock,
        sense: Sense,
        profile: contract.CameraProfile,
        T_world_cam: Pose,
        in_colour: bool = False,
    ):
        """`T_world_cam` (4, 4) is where the camera stands, `profile` the picture for people, which comes
        with every frame if `in_colour`."""
        self._in_colour, self._held_steps = in_colour, 0
        self._host, self._clock, self._sense = host, clock, sense
        self._profile, self._T_world_cam = profile, T_world_cam
        self._channel: Channel | None = None
        self._picture: ScenePicture | None = None
        self._object, self._object_pos_m = "", np.full(3, np.nan)

    def start(self) -> None:
        """Connect and build the scene. Raises UserError if no rig runs at the host."""
        from rig.fr3.channel import Channel
        from rig.fr3.picture import of_scene

        self._channel = Channel(self._host)
        scene = self._channel.scene()
        self._picture, self._object = of_scene(scene["xml"]), scene["object"]

    def read(self) -> Frame:
        """The scene as it is now. Raises CameraError if the rig does not answer."""
        from rig.fr3.channel import ChannelLost

        assert self._channel is not None and self._picture is not None
        with self._channel.time_held():
            try:
                asked_s = self._clock.now()
                state = self._channel.ask("state")
            except ChannelLost as error:
                raise CameraError(str(error)) from error
            self._judge(np.array(state["object_position_m"], float))
            self._picture.pose(np.array(state["qpos"], float))
            depth = self._sense(self._picture, self._T_world_cam, self._object)
            return Frame(depth, asked_s, self._colour() if self._in_colour else None)

    def object_name(self) -> str:
        """See KnowsObject."""
        return self._object

    def time_held(self) -> AbstractContextManager[None]:
        """See Pausing."""
        assert self._channel is not None
        return self._channel.time_held()

    def stop(self) -> None:
        """Disconnect."""
        if self._picture is not None:
            self._picture.close()
        if self._channel is not None:
            self._channel.close()
        self._picture = self._channel = None

    def success(self) -> bool:
        """See Judge; as of the last `read`, one for every control step."""
        return self._held_steps >= contract.HOLD_STEPS

    def object_pos_m(self) -> Float[np.ndarray, "3"]:
        """See TrialCamera; as of the last `read`."""
        return self._object_pos_m

    def _colour(self) -> UInt8[np.ndarray, "H W 3"]:
        assert self._picture is not None
        return self._picture.rgb(Camera.of(self._profile, self._T_world_cam))

    def _judge(self, object_pos_m: np.ndarray) -> None:
        self._object_pos_m = object_pos_m
        self._held_steps = self._held_steps + 1 if at_lift_target(object_pos_m) else 0

    def picture(self) -> UInt8[np.ndarray, "H W 3"]:
        """(H, W, 3) uint8 colour of the scene as it was last read, from the same place (for people)."""
        assert self._channel is not None
        with self._channel.time_held():
            return self._colour()

    def clean_mm(self) -> UInt16[np.ndarray, "H W"]:
        """See Simulated; as of the last `read`."""
        assert self._channel is not None and self._picture is not None
        with self._channel.time_held():
            return to_millimetres(self._picture.depth_m(Camera.of(self._profile, self._T_world_cam)))

    def scene(self) -> "tuple[mujoco.MjModel, mujoco.MjData]":
        """See Staged; as of the last `read`."""
        assert self._picture is not None
        return self._picture.model, self._picture.data


def _at_place(setup: Setup, profile: contract.CameraProfile, sense: Sense) -> Fr3Camera:
    from rig.camera import standing_pose

    config = setup.config
    pose = standing_pose(config)
    return Fr3Camera(config.deploy.franka.host, setup.clock, sense, profile, pose, in_colour=True)
