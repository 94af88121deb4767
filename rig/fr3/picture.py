"""Pictures of the FR3 rig's scene by MuJoCo's own renderer (software OpenGL will do)."""

import math
import os
import sys
import xml.etree.ElementTree as ET
from collections.abc import Sequence

import mujoco
import numpy as np
from jaxtyping import Float32, Float64, Int32, UInt8

from ddgrasp.errors import UserError
from mjx_envs.camera import Buffers, Camera
from sensors.models.materials import geom_rgb

CAMERA = "depth_camera"
FAR_M = 10.0
"""What is further away counts as nothing."""
_T_OPENCV_OPENGL = np.diag([1.0, -1.0, -1.0])
"""MuJoCo's cameras look along -z with y up, OpenCV's along z with y down."""
_GEOM = int(mujoco.mjtObj.mjOBJ_GEOM)
"""As a number: an array compared with the enumeration itself is compared object by object."""


def prepare(root: ET.Element, largest_px: int = 2048) -> None:
    """Adds to the MJCF in `root` what drawing needs; no picture is wider or higher than `largest_px`."""
    world = root.find("worldbody")
    assert world is not None
    world.append(ET.Element("camera", {"name": CAMERA}))
    visual = ET.SubElement(root, "visual")
    ET.SubElement(visual, "global", {"offwidth": str(largest_px), "offheight": str(largest_px)})
    ET.SubElement(visual, "quality", {"offsamples": "0"})  # a pixel is one surface, not a mixture


def of_scene(scene_xml: str, largest_px: int = 2048) -> "ScenePicture":
    """Pictures of what the rig's side channel answers to `scene`, visual meshes included."""
    root = ET.fromstring(scene_xml)
    prepare(root, largest_px)
    return ScenePicture(mujoco.MjModel.from_xml_string(ET.tostring(root, encoding="unicode")))


class ScenePicture:
    """The scene seen by pinhole cameras that have no errors and look straight ahead."""

    def __init__(self, model: mujoco.MjModel):
        """`model` is of a scene that `prepare` has seen."""
        self.model = model
        self.data = mujoco.MjData(self.model)
        self._rgb = np.concatenate(
            [geom_rgb(self.model), np.zeros((1, 3), np.float32)]
        )  # black where none is
        self._renderers: dict[tuple[int, int], mujoco.Renderer] = {}
        _without_display()

    def pose(self, qpos: Float64[np.ndarray, " nq"]) -> None:
        """The scene from now on."""
        self.data.qpos[:] = qpos
        mujoco.mj_kinematics(self.model, self.data)

    def depth_m(self, camera: Camera) -> Float32[np.ndarray, "H W"]:
        """(H, W) planar depth, metres; 0 = nothing there."""
        renderer = self._look(camera)
        renderer.enable_depth_rendering()
        depth_m = renderer.render()
        renderer.disable_depth_rendering()
        return np.where(depth_m < FAR_M, depth_m, np.float32(0))

    def rgb(self, camera: Camera) -> UInt8[np.ndarray, "H W 3"]:
        """(H, W, 3) uint8 colour."""
        return self._look(camera).render().copy()

    def buffers(self, camera: Camera) -> Buffers:
        """Depth, geoms, their colours without light, and normals; what `ActiveStereo` draws with."""
        depth_m = self.depth_m(camera)
        renderer = self._look(camera)
        renderer.enable_segmentation_rendering()
        ids, kinds = np.moveaxis(renderer.render(), -1, 0)
        renderer.disable_segmentation_rendering()
        geoms = np.where((kinds == _GEOM) & (depth_m > 0), ids, -1).astype(np.int32)
        return Buffers(depth_m, self._rgb[geoms], geoms, _normals(depth_m, geoms, camera))

    def close(self) -> None:
        """Lets go of the OpenGL contexts."""
        for renderer in self._renderers.values():
            renderer.close()

    def _look(self, camera: Camera) -> mujoco.Renderer:
        assert camera.cx_px == camera.width_px / 2 and camera.cy_px == camera.height_px / 2
        own, T = self.model.camera(CAMERA), np.asarray(camera.T_world_cam)
        own.pos, own.fovy = T[:3, 3], math.degrees(2 * math.atan(camera.height_px / 2 / camera.fy_px))
        mujoco.mju_mat2Quat(own.quat, (T[:3, :3] @ _T_OPENCV_OPENGL).ravel())
        mujoco.mj_camlight(self.model, self.data)
        size = (camera.height_px, camera.width_px)
        if size not in self._renderers:
            self._renderers[size] = mujoco.Renderer(self.model, *size)
        self._renderers[size].update_scene(self.data, CAMERA)
        return self._renderers[size]


def _normals(
    depth_m: Float32[np.ndarray, "H W"], geoms: Int32[np.ndarray, "H W"], camera: Camera
) -> Float32[np.ndarray, "H W 3"]:
    """(H, W, 3) unit normals, world frame, towards the camera: differences of neighbours on one geom."""
    x = ((np.arange(camera.width_px) + 0.5 - camera.cx_px) / camera.fx_px).astype(np.float32)[None, :]
    y = ((np.arange(camera.height_px) + 0.5 - camera.cy_px) / camera.fy_px).astype(np.float32)[:, None]
    points = (x * depth_m, y * depth_m, depth_m)  # planes: arrays whose last axis has three numbers are slow
    (ax, ay, az), (bx, by, bz) = ([_slope(plane, geoms, axis) for plane in points] for axis in (0, 1))
    normal = (ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx)
    length = np.sqrt(_dot(normal, normal))
    nowhere = (geoms < 0) | (length == 0)
    towards = np.copysign(np.maximum(length, np.float32(1e-12)), np.float32(0) - _dot(normal, points))
    towards[nowhere] = np.inf
    unit = np.stack([plane / towards for plane in normal], axis=-1)
    return unit @ np.asarray(camera.T_world_cam)[:3, :3].T.astype(np.float32)


def _dot(
    a: Sequence[Float32[np.ndarray, "H W"]], b: Sequence[Float32[np.ndarray, "H W"]]
) -> Float32[np.ndarray, "H W"]:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _slope(
    plane: Float32[np.ndarray, "H W"], geoms: Int32[np.ndarray, "H W"], axis: int
) -> Float32[np.ndarray, "H W"]:
    """Along an axis of the picture: the sum of the differences to both neighbours, but to other geoms."""
    step = np.diff(plane, axis=axis) * (np.diff(geoms, axis=axis) == 0)
    slope = np.zeros_like(plane)
    here, there = np.moveaxis(slope, axis, 0)[1:], np.moveaxis(slope, axis, 0)[:-1]
    step = np.moveaxis(step, axis, 0)
    here += step
    there += step
    return slope


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
