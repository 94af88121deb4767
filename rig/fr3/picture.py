"""Pictures of the FR3 rig's scene by MuJoCo's own renderer (software OpenGL will do)."""

import math
import os
import sys
import xml.etree.ElementTree as ET

import mujoco
import numpy as np
from jaxtyping import Float, Float64, UInt8, UInt16

from ddgrasp import contract, depth
from ddgrasp.errors import UserError

CAMERA = "depth_camera"
_T_OPENCV_OPENGL = np.diag([1.0, -1.0, -1.0])
"""MuJoCo's cameras look along -z with y up, OpenCV's along z with y down."""


class ScenePicture:
    """The scene seen by a pinhole camera that has no errors.

    Args:
      scene_xml: what the rig's side channel answers to `scene`, visual meshes included.
      profile: size and intrinsics; the principal point must be the middle.
      T_world_cam: (4, 4) OpenCV axes.
    """

    def __init__(
        self, scene_xml: str, profile: contract.CameraProfile, T_world_cam: Float[np.ndarray, "4 4"]
    ):
        root = ET.fromstring(scene_xml)
        world = root.find("worldbody")
        assert world is not None
        world.append(_camera(profile, T_world_cam))
        self._model = mujoco.MjModel.from_xml_string(ET.tostring(root, encoding="unicode"))
        self._data = mujoco.MjData(self._model)
        _without_display()
        self._renderer = mujoco.Renderer(self._model, profile.height_px, profile.width_px)

    def depth_mm(self, qpos: Float64[np.ndarray, " nq"]) -> UInt16[np.ndarray, "H W"]:
        """(H, W) uint16 planar depth in millimetres with the scene in `qpos`."""
        self._renderer.enable_depth_rendering()
        metres = self._render(qpos)
        self._renderer.disable_depth_rendering()
        return depth.to_millimetres(metres)

    def rgb(self, qpos: Float64[np.ndarray, " nq"]) -> UInt8[np.ndarray, "H W 3"]:
        """(H, W, 3) uint8 colour with the scene in `qpos`."""
        return self._render(qpos)

    def close(self) -> None:
        """Lets go of the OpenGL context."""
        self._renderer.close()

    def _render(self, qpos: np.ndarray) -> np.ndarray:
        self._data.qpos[:] = qpos
        mujoco.mj_kinematics(self._model, self._data)
        mujoco.mj_camlight(self._model, self._data)
        self._renderer.update_scene(self._data, CAMERA)
        return self._renderer.render().copy()


def _without_display() -> None:
    """Lets mujoco.Renderer draw through EGL on a machine without a screen. Raises UserError without EGL."""
    if sys.platform != "linux" or os.environ.get("MUJOCO_GL") or os.environ.get("DISPLAY"):
        return
    from mujoco.rendering.classic import gl_context

    try:
        from mujoco.egl import GLContext
    except Exception as error:  # its loaders raise what they like
        raise UserError(f"camera 'rig' draws with OpenGL, and EGL is absent ({error}): add it.") from error
    gl_context.GLContext = GLContext


def _camera(profile: contract.CameraProfile, T_world_cam: np.ndarray) -> ET.Element:
    quat = np.zeros(4)
    mujoco.mju_mat2Quat(quat, (T_world_cam[:3, :3] @ _T_OPENCV_OPENGL).ravel())
    fovy = math.degrees(2 * math.atan(profile.height_px / 2 / profile.fy_px))
    numbers = {"pos": T_world_cam[:3, 3], "quat": quat, "fovy": [fovy]}
    attributes = {name: " ".join(f"{value:.9g}" for value in values) for name, values in numbers.items()}
    return ET.Element("camera", {"name": CAMERA, **attributes})
