"""The rig's active-stereo camera as a camera driver."""

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, UInt8, UInt16

from ddgrasp.layout import QPOS
from deploy.devices.options import Setup
from deploy.devices.rig_robot import SimRobot
from deploy.interfaces import Frame, Robot

if TYPE_CHECKING:
    import mujoco

    import rig.camera
    import rig.world


def make(setup: Setup, robot: Robot) -> "StereoCamera":
    """Before the simulated robot's world, within the calibration error."""
    from rig.camera import camera_pose, make_camera

    assert isinstance(robot, SimRobot)  # `registry.REFUSED` sees to it
    config, world = setup.config, robot.world
    rng = np.random.default_rng(config.seed)
    camera, pose = make_camera(config, world), camera_pose(config, rng)
    return StereoCamera(world, camera, pose, rng, robot.catch_up, next(iter(world.objects)))


class StereoCamera:
    """Looks at a `RigWorld` through a simulated active-stereo camera: uint16 millimetres, 0 = invalid."""

    def __init__(
        self,
        world: "rig.world.RigWorld",
        camera: "rig.camera.RigCamera",
        T_world_cam: Float[np.ndarray, "4 4"],
        rng: np.random.Generator,
        catch_up: Callable[[], float],
        object_name: str = "",
    ):
        """`catch_up` moves the world to now and returns the moment it shows (`SimRobot.catch_up`)."""
        self._world, self._camera, self._T_world_cam = world, camera, T_world_cam
        self._rng, self._catch_up, self._object_name = rng, catch_up, object_name
        self._frame: Frame | None = None

    def start(self) -> None:
        """Nothing to open."""

    def read(self) -> Frame:
        """The world as it is now; the same frame again within a control period."""
        timestamp_s = self._catch_up()
        if self._frame is None or timestamp_s > self._frame.timestamp_s:
            depth = self._camera.depth_mm(self._world.data, self._T_world_cam, self._rng, self._object_name)
            self._frame = Frame(depth, timestamp_s)
        return self._frame

    def stop(self) -> None:
        """Nothing to close."""

    def success(self) -> bool:
        """See Judge."""
        self._catch_up()
        return self._world.success()

    def object_pos_m(self) -> Float[np.ndarray, "3"]:
        """See TrialCamera."""
        return self._world.data.qpos[QPOS.object_pos].copy()

    def picture(self) -> UInt8[np.ndarray, "H W 3"]:
        """(H, W, 3) uint8 colour picture of the scene as it stands, from the same place (for people)."""
        return self._camera.rgb(self._world.data, self._T_world_cam)

    def clean_mm(self) -> UInt16[np.ndarray, "H W"]:
        """See Simulated."""
        return self._camera.clean_mm(self._world.data, self._T_world_cam)

    def scene(self) -> "tuple[mujoco.MjModel, mujoco.MjData]":
        """See Staged."""
        return self._world.model, self._world.data
