"""The FR3 rig's left infrared imager as calibration looks through it: one sharp picture, no projector."""

from typing import TYPE_CHECKING

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from ddgrasp import contract
from deploy.devices.options import Setup
from deploy.interfaces import CameraError, Lens
from mjx_envs.camera import Camera

if TYPE_CHECKING:
    from rig.fr3.channel import Channel
    from rig.fr3.picture import ScenePicture

Pose = Float[np.ndarray, "4 4"]
FINER = 2
"""Pixels drawn per side of one that is seen."""
BLUR_PX, NOISE_GRAY = 0.5, 2.0
"""Standard deviations: of the optics, of the imager."""


def make(setup: Setup) -> "Fr3Imager":
    """Where `--camera rig` stands."""
    from rig.camera import standing_pose

    pose = standing_pose(setup.config)
    return Fr3Imager(setup.config.deploy.franka.host, pose, setup.config.seed)


class Fr3Imager:
    """Brightness of the rig's mesh scene at 1280x720, in place of infrared by daylight."""

    def __init__(self, host: str, T_world_cam: Pose, seed: int = 0):
        """`T_world_cam` (4, 4) is where the camera stands; `seed` draws the imager's noise."""
        self._host, self._T_world_cam = host, T_world_cam
        self._rng = np.random.default_rng((seed, 2))
        self._channel: Channel | None = None
        self._picture: ScenePicture | None = None

    def start(self) -> None:
        """Connect and build the scene. Raises UserError if no rig runs at the host."""
        from rig.fr3.channel import Channel
        from rig.fr3.picture import of_scene

        self._channel = Channel(self._host)
        self._picture = of_scene(self._channel.scene()["xml"], FINER * contract.D455.width_px)

    def lens(self) -> Lens:
        """Without distortion, as a D4xx's rectified imagers are."""
        return nominal_lens()

    def picture(self) -> UInt8[np.ndarray, "720 1280"]:
        """(720, 1280) the scene as it is now. Raises CameraError if the rig does not answer."""
        from rig.fr3.channel import ChannelLost

        assert self._channel is not None and self._picture is not None
        with self._channel.time_held():
            try:
                state = self._channel.ask("state")
            except ChannelLost as error:
                raise CameraError(str(error)) from error
            self._picture.pose(np.array(state["qpos"], float))
            return look(self._picture, self._T_world_cam, self._rng)

    def truth(self) -> Pose:
        """(4, 4) where the camera stands, in the robot's base frame."""
        return self._T_world_cam

    def stop(self) -> None:
        """Disconnect."""
        if self._picture is not None:
            self._picture.close()
        if self._channel is not None:
            self._channel.close()
        self._picture = self._channel = None


def look(
    picture: "ScenePicture", T_world_cam: Pose, rng: np.random.Generator
) -> UInt8[np.ndarray, "720 1280"]:
    """(720, 1280) uint8 brightness as an imager at `T_world_cam` takes it."""
    fine = picture.rgb(Camera.of(contract.D455.scaled(FINER), T_world_cam))
    size = (contract.D455.width_px, contract.D455.height_px)
    gray = cv2.resize(cv2.cvtColor(fine, cv2.COLOR_RGB2GRAY), size, interpolation=cv2.INTER_AREA)
    gray = cv2.GaussianBlur(gray.astype(np.float32), (0, 0), BLUR_PX)
    gray += NOISE_GRAY * rng.standard_normal(gray.shape, np.float32)
    return np.clip(np.rint(gray), 0, 255).astype(np.uint8)


def nominal_lens() -> Lens:
    """A D455's imager at 1280x720; the contract's pixel centres lie half a pixel further than OpenCV's."""
    p = contract.D455
    matrix = np.array([[p.fx_px, 0, p.cx_px - 0.5], [0, p.fy_px, p.cy_px - 0.5], [0, 0, 1.0]])
    return Lens(matrix, np.zeros(5), p.width_px, p.height_px)
