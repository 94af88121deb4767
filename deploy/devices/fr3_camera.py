"""The FR3 rig's camera as a camera driver: an ideal depth camera before the simulated scene."""

from typing import TYPE_CHECKING

import numpy as np

from ddgrasp import contract
from deploy.devices.options import Setup
from deploy.interfaces import CameraError, Clock, Frame, Robot

if TYPE_CHECKING:
    from rig.fr3.channel import Channel
    from rig.fr3.picture import ScenePicture


def make(setup: Setup, robot: Robot) -> "Fr3Camera":
    """Looks at the rig that runs at the robot's host, from its nominal place within the calibration error."""
    from rig.camera import camera_pose

    config = setup.config
    pose = camera_pose(config, np.random.default_rng(config.seed))
    return Fr3Camera(config.deploy.franka.host, setup.clock, config.world.profile, pose)


class Fr3Camera:
    """Asks the rig where everything is and draws it: uint16 millimetres, 0 = nothing there."""

    def __init__(self, host: str, clock: Clock, profile: contract.CameraProfile, T_world_cam: np.ndarray):
        """`T_world_cam` (4, 4) is where the camera stands."""
        self._host, self._clock = host, clock
        self._profile, self._T_world_cam = profile, T_world_cam
        self._channel: Channel | None = None
        self._picture: ScenePicture | None = None

    def start(self) -> None:
        """Connect and build the scene. Raises UserError if no rig runs at the host."""
        from rig.fr3.channel import Channel
        from rig.fr3.picture import ScenePicture

        self._channel = Channel(self._host)
        scene_xml = self._channel.ask("scene")["xml"]
        self._picture = ScenePicture(scene_xml, self._profile, self._T_world_cam)

    def read(self) -> Frame:
        """The scene as it is now. Raises CameraError if the rig does not answer."""
        from rig.fr3.channel import ChannelLost

        assert self._channel is not None and self._picture is not None
        asked_s = self._clock.now()
        try:
            state = self._channel.ask("state")
        except ChannelLost as error:
            raise CameraError(str(error)) from error
        return Frame(self._picture.depth_mm(np.array(state["qpos"])), asked_s)

    def stop(self) -> None:
        """Disconnect."""
        if self._picture is not None:
            self._picture.close()
        if self._channel is not None:
            self._channel.close()
        self._picture = self._channel = None
