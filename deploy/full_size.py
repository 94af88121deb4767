"""The development rig's camera at a D455's own size, and what its driver does to a frame."""

import mujoco
import numpy as np
from jaxtyping import Float, UInt16

from ddgrasp import contract
from ddgrasp.config import StereoConfig
from deploy.clock import SimClock
from deploy.devices.realsense_camera import RealSenseCamera
from mjx_envs.camera import Camera
from rig.camera import RigCamera
from sensors.models.active_stereo import of_scale

Pose = Float[np.ndarray, "4 4"]


class FullSizeCamera(RigCamera):
    """Matched at the size of the camera's stream, handed out at the policy's."""

    def __init__(self, model: mujoco.MjModel, config: StereoConfig, profile: contract.CameraProfile):
        """`profile` is the policy's picture."""
        super().__init__(model, config, profile)
        self._profile = profile
        self.stereo = of_scale(config, contract.D455_STREAM)
        self._driver = RealSenseCamera(SimClock(), profile, stream=contract.D455_STREAM)

    def _sense(
        self, data: mujoco.MjData, T_world_cam: Pose, rng: np.random.Generator, object_name: str
    ) -> UInt16[np.ndarray, "H W"]:
        return self._driver.convert(super()._sense(data, T_world_cam, rng, object_name))

    def pinhole(self, T_world_cam: Pose) -> Camera:
        """See RigCamera: of the pictures that it hands out."""
        return Camera.of(self._profile, T_world_cam)
