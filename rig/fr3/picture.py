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
from rig.fr3.canvas import Canvas
from sensors.models.materials import geom_rgb

CAMERA = "depth_camera"
FAR_M = 10.0
"""What is further away counts as nothing."""
_T_OPENCV_OPENGL = np.diag([1.0, -1.0, -1.0])
"""MuJoCo's cameras look along -z with y up, OpenCV's along z with y down."""


def prepare(root: ET.Element, largest_px: int = 2048) -> None:
    """Adds to the MJCF in `root` what drawing needs; no picture is wider or higher than `largest_px`."""
    world = root.find("worldbody")
    assert world is not None
    world.append(ET.Element("camera", {"name": CAMERA}))
    visual = ET.SubElement(root, "visual")
    ET.SubElement(visual, "global", {"offwidth": str(largest_px), "offheight": str(largest_px)})
    ET.SubElement(visual, "quality", {"offsamples": "0"})  # a pixel is one surface, not a mixture


def of_scene(scene_xml: str, largest_px: int = 2048) -> "ScenePicture":
    """Pictures of what the rig's side channel answers to `scene`, visual meshes included.

    Raises UserError for what MuJoCo does not read.
    """
    try:
        model = _model(scene_xml, largest_px)
    except (ET.ParseError, ValueError, RecursionError) as error:
        said = " ".join(str(error).split())
        raise UserError(
            f"the FR3 rig's scene is none that MuJoCo reads ({said}): is it of another version?"
        ) from error
    return ScenePicture(model)


def _model(scene_xml: str, largest_px: int) -> mujoco.MjModel:
    root = ET.fromstring(scene_xml)
    if root.find("worldbody") is None:
        raise ValueError("it has no worldbody")
    prepare(root, largest_px)
    return mujoco.MjModel.from_xml_string(ET.tostring(root, encoding="unicode"))


class ScenePicture:
    """The scene seen by pinhole cameras that have no errors and look straight ahead."""

    def __init__(self, model: mujoco.MjModel):
        """`model` is of a scene that `prepare` has seen."""
        self.model = model
        self.data = mujoco.MjData(self.model)
        self._rgb = np.concatenate(
            [geom_rgb(self.model), np.zeros((1, 3), np.float32)]
        )  # black where none is
        self._canvases: dict[tuple[int, int], Canvas] = {}
        draw_without_display()

    def pose(self, qpos: Float64[np.ndarray, " nq"]) -> None:
        """The scene from now on. Raises UserError for joints of another one."""
        if len(qpos) != self.model.nq:
            raise UserError(
                f"the FR3 rig's state has {len(qpos)} joint values, its scene {self.model.nq}: is it of "
                "another version?"
            )
        self.data.qpos[:] = qpos
        mujoco.mj_kinematics(self.model, self.data)

    def depth_m(self, camera: Camera) -> Float32[np.ndarray, "H W"]:
        """(H, W) planar depth, metres; 0 = nothing there."""
        depth_m = self._look(camera).depth_m()
        return np.where(depth_m < FAR_M, depth_m, np.float32(0))

    def rgb(self, camera: Camera) -> UInt8[np.ndarray, "H W 3"]:
        """(H, W, 3) uint8 colour."""
        return self._look(camera).rgb()

    def buffers(self, camera: Camera) -> Buffers:
        """Depth, geoms, their colours without light, and normals; what `ActiveStereo` draws with."""
        depth_m, geoms = self._look(camera).depth_and_geoms()
        nowhere = depth_m >= FAR_M
        depth_m[nowhere], geoms[nowhere] = 0, -1
        return Buffers(depth_m, self._rgb.take(geoms, axis=0), geoms, _normals(depth_m, geoms, camera))

    def close(self) -> None:
        """Lets go of the OpenGL contexts."""
        for canvas in self._canvases.values():
            canvas.close()
        self._canvases.clear()

    def _look(self, camera: Camera) -> Canvas:
        assert camera.cx_px == camera.width_px / 2 and camera.cy_px == camera.height_px / 2
        own, T = self.model.camera(CAMERA), np.asarray(camera.T_world_cam)
        own.pos, own.fovy = T[:3, 3], math.degrees(2 * math.atan(camera.height_px / 2 / camera.fy_px))
        mujoco.mju_mat2Quat(own.quat, (T[:3, :3] @ _T_OPENCV_OPENGL).ravel())
        mujoco.mj_camlight(self.model, self.data)
        size = (camera.height_px, camera.width_px)
        if size not in self._canvases:
            self._canvases[size] = Canvas(self.model, *size)
        self._canvases[size].look(self.data, own.id)
        return self._canvases[size]


def _normals(
    depth_m: Float32[np.ndarray, "H W"], geoms: Int32[np.ndarray, "H W"], camera: Camera
) -> Float32[np.ndarray, "H W 3"]:
    """(H, W, 3) unit normals, world frame, towards the camera: differences of neighbours on one geom."""
    x = ((np.arange(camera.width_px) + 0.5 - camera.cx_px) / camera.fx_px).astype(np.float32)[None, :]
    y = ((np.arange(camera.height_px) + 0.5 - camera.cy_px) / camera.fy_px).astype(np.float32)[:, None]
    points = (x * depth_m, y * depth_m, depth_m)  # planes: arrays whose last axis has three numbers are slow
    (ax, ay, az), (bx, by, bz) = (_slopes(points, geoms, axis) for axis in (0, 1))
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


def _slopes(
    planes: Sequence[Float32[np.ndarray, "H W"]], geoms: Int32[np.ndarray, "H W"], axis: int
) -> list[Float32[np.ndarray, "H W"]]:
    """Along an axis of the picture: the sums of the differences to both neighbours, but to other geoms."""
    lower, upper = ((slice(None),) * axis + (part,) for part in (slice(-1), slice(1, None)))
    alike = geoms[upper] == geoms[lower]
    slopes = [np.zeros_like(plane) for plane in planes]
    for plane, slope in zip(planes, slopes, strict=True):
        step = plane[upper] - plane[lower]
        step *= alike
        slope[upper] += step
        slope[lower] += step
    return slopes


def draw_without_display() -> None:
    """Lets MuJoCo draw through EGL, where nobody has said how: a display may be absent, or named and gone.

    Raises UserError where there is neither EGL nor a display.
    """
    if sys.platform != "linux" or os.environ.get("MUJOCO_GL"):
        return
    from mujoco.rendering.classic import gl_context

    try:
        from mujoco.egl import GLContext
    except Exception as error:  # its loaders raise what they like
        if os.environ.get("DISPLAY"):
            return
        raise UserError(
            f"without a display this is drawn by OpenGL through EGL, which is absent ({error}): install "
            "libegl1, or set MUJOCO_GL=osmesa with libosmesa6."
        ) from error
    gl_context.GLContext = GLContext
