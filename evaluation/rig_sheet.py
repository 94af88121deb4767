"""Pictures of the FR3 rig for whoever sets up an arm: the camera's place, what it sees, the board. JAX-free.

Drawn by MuJoCo's OpenGL renderer; lines in the pictures are not hidden by what stands before them.
"""

import xml.etree.ElementTree as ET
from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
from franky_sim.mujoco_simulator import MujocoSimulator
from jaxtyping import Float, UInt8

from ddgrasp import contract, policy_metadata
from ddgrasp.config import DeployConfig
from ddgrasp.contract import HOME_RAD
from ddgrasp.presets import get_preset
from deploy import kinematics
from deploy.calibration import poses
from deploy.devices.fr3_imager import nominal_lens
from deploy.setup import safety_filter
from mjx_envs.camera import Camera, look_at, nominal_camera
from rig.film import colored
from rig.fr3 import scene
from rig.fr3.board import held_pose, hold
from rig.fr3.picture import ScenePicture, of_scene
from sensors.charuco_board import CharucoBoard

WIDTH_PX, HEIGHT_PX, FOCAL_PX = 480, 360, 420.0
FROM_M, TO_M = (1.75, -1.35, 1.15), (0.42, 0.0, 0.28)
"""Where somebody stands who looks at the rig, and at what."""
FINER = 3
"""Pixels drawn per side of one that is kept."""
FRUSTUM_M, AXIS_M = 0.28, 0.20
NEAR_MM, FAR_MM = 500.0, 1300.0
_AXES = ((220, 40, 40), (30, 170, 60), (40, 80, 230))
"""RGB of x, y, z."""
_CAMERA_RGB, _BOX_RGB, _TEXT_RGB = (255, 140, 0), (120, 120, 130), (20, 20, 20)
_SEED, _POSE_SEED = 3, 1

Pose = Float[np.ndarray, "4 4"]
Image = UInt8[np.ndarray, "H W 3"]
Joints = Float[np.ndarray, "7"]


def draw(object_name: str = "apple") -> bytes:
    """PNG of four panels: the rig with camera and boxes, its camera's colour and depth, the board held up."""
    T_world_cam = nominal_camera(contract.D455).T_world_cam
    shown_rad = _showing(T_world_cam)
    plain, board = _picture(object_name, HOME_RAD, None), _picture(object_name, shown_rad, CharucoBoard())
    panels = [
        _titled(_mounting(plain, T_world_cam), "mounting: camera, its aim, where the grip may go"),
        _titled(_depth(plain, T_world_cam), "what it sees: depth (magenta: nothing, here too far)"),
        _titled(
            _board(board, shown_rad, _overview()),
            "the board in the hand; axes of board and base",
        ),
        _titled(_board(board, shown_rad, _view(T_world_cam)), "what the camera sees then"),
    ]
    for picture in (plain, board):
        picture.close()
    sheet = np.vstack([np.hstack(panels[:2]), np.hstack(panels[2:])])
    ok, png = cv2.imencode(".png", sheet[..., ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 9])
    assert ok
    return png.tobytes()


def _picture(name: str, q_rad: Joints | Sequence[float], board: CharucoBoard | None) -> ScenePicture:
    """The furnished scene with the arm there."""
    sim = MujocoSimulator()
    sim.add_robot(initial_q=list(q_rad), initial_hand_width=0.0 if board else 0.08)
    scene.furnish(sim.scene, scene.meshed(name), _SEED)
    if board is not None:
        hold(sim.scene, board, _SEED)
    picture = of_scene(ET.tostring(sim.scene, encoding="unicode"))
    qpos = picture.model.qpos0.copy()
    qpos[:7] = q_rad
    qpos[7:9] = 0.0 if board else 0.04
    picture.pose(qpos)
    return picture


def _showing(T_world_cam: Pose) -> Joints:
    """(7,) joints with which the camera sees the board, as `ddgrasp calibrate` plans them."""
    preset = get_preset("demo")
    info = policy_metadata.describe(preset.student, preset.export, preset.world.profile)
    limits = safety_filter(preset.deploy, info, "franka").limits
    bench = poses.Bench(limits, nominal_lens(), T_world_cam, CharucoBoard())
    return poses.plan(bench, 1, np.array(HOME_RAD), np.random.default_rng(_POSE_SEED))[0]


def _overview() -> Camera:
    return Camera(FOCAL_PX, FOCAL_PX, WIDTH_PX / 2, HEIGHT_PX / 2, HEIGHT_PX, WIDTH_PX, look_at(FROM_M, TO_M))


def _view(T_world_cam: Pose) -> Camera:
    """The depth camera's, at the panels' width."""
    return Camera.of(contract.D455.scaled(WIDTH_PX / contract.D455.width_px), T_world_cam)


def _mounting(picture: ScenePicture, T_world_cam: Pose) -> Image:
    camera, limits = _overview(), DeployConfig()
    image = _rendered(picture, camera)
    _draw_box(image, camera, limits.workspace_lower_m, limits.workspace_upper_m)
    _draw_axes(image, camera, np.eye(4), AXIS_M)
    view = _view(T_world_cam)
    half = np.array([view.width_px / 2 / view.fx_px, view.height_px / 2 / view.fy_px])
    corners = [(x, y) for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    ends = [_moved(T_world_cam, FRUSTUM_M * np.append(half * corner, 1.0)) for corner in corners]
    eye = T_world_cam[:3, 3]
    for here, there in zip(ends, [*ends[1:], ends[0]], strict=True):
        _draw_line(image, camera, here, there, _CAMERA_RGB)
        _draw_line(image, camera, eye, here, _CAMERA_RGB)
    _draw_line(image, camera, eye, np.array(contract.CAMERA_LOOK_AT_M), _CAMERA_RGB)
    _write(image, camera, eye, f"camera {_place(contract.CAMERA_POSITION_M)}")
    _write(image, camera, np.array(contract.CAMERA_LOOK_AT_M), f"aim {_place(contract.CAMERA_LOOK_AT_M)}", 26)
    _write(image, camera, np.zeros(3), "base")
    return image


def _depth(picture: ScenePicture, T_world_cam: Pose) -> Image:
    """The camera's colour above its depth."""
    view = _view(T_world_cam)
    depth_mm = np.rint(1000 * picture.depth_m(view)).astype(np.uint16)
    seen = np.where(depth_mm < 2 * FAR_MM, depth_mm, np.uint16(0))
    stacked = np.vstack([_rendered(picture, view), colored(seen, NEAR_MM, FAR_MM)])
    width = round(WIDTH_PX * HEIGHT_PX / stacked.shape[0])
    small = cv2.resize(stacked, (width, HEIGHT_PX), interpolation=cv2.INTER_AREA)
    panel = np.full((HEIGHT_PX, WIDTH_PX, 3), 255, np.uint8)
    left = (WIDTH_PX - width) // 2
    panel[:, left : left + width] = small
    return panel


def _board(picture: ScenePicture, q_rad: Joints, camera: Camera) -> Image:
    image = _rendered(picture, camera)
    T_base_board = kinematics.grip_pose(q_rad) @ held_pose(CharucoBoard(), _SEED)
    for T, length_m in ((T_base_board, AXIS_M / 2), (np.eye(4), AXIS_M)):
        _draw_axes(image, camera, T, length_m)
    panel = np.full((HEIGHT_PX, WIDTH_PX, 3), 255, np.uint8)
    top = (HEIGHT_PX - image.shape[0]) // 2
    panel[top : top + image.shape[0]] = image
    return panel


def _rendered(picture: ScenePicture, camera: Camera) -> Image:
    """Drawn finer and made smaller: the renderer's own edges are not smoothed."""
    fine = Camera(
        FINER * camera.fx_px, FINER * camera.fy_px, FINER * camera.cx_px, FINER * camera.cy_px,
        FINER * camera.height_px, FINER * camera.width_px, camera.T_world_cam,
    )  # fmt: skip
    size = (camera.width_px, camera.height_px)
    return np.ascontiguousarray(cv2.resize(picture.rgb(fine), size, interpolation=cv2.INTER_AREA))


def _draw_box(image: Image, camera: Camera, lower_m: Sequence[float], upper_m: Sequence[float]) -> None:
    """The twelve edges."""
    ends = np.array([lower_m, upper_m])
    for axis in range(3):
        others = [i for i in range(3) if i != axis]
        for first in (0, 1):
            for second in (0, 1):
                here = np.empty(3)
                here[others] = ends[first, others[0]], ends[second, others[1]]
                there = here.copy()
                here[axis], there[axis] = ends[:, axis]
                _draw_line(image, camera, here, there, _BOX_RGB, 1)


def _draw_axes(image: Image, camera: Camera, T_world_frame: Pose, length_m: float) -> None:
    for axis, rgb in enumerate(_AXES):
        end = _moved(T_world_frame, length_m * np.eye(3)[axis])
        _draw_line(image, camera, T_world_frame[:3, 3], end, rgb, 3)


def _draw_line(image: Image, camera: Camera, here, there, rgb: tuple[int, int, int], width: int = 2) -> None:
    a, b = _pixel(camera, here), _pixel(camera, there)
    if a is not None and b is not None:
        cv2.line(image, a, b, rgb, width, cv2.LINE_AA)


def _write(image: Image, camera: Camera, where: Any, text: str, down_px: int = -8) -> None:
    pixel = _pixel(camera, where)
    assert pixel is not None
    (width, _), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, 0.4, 1)
    x, y = min(pixel[0] + 6, image.shape[1] - width - 4), max(pixel[1] + down_px, 12)
    cv2.rectangle(image, (x - 2, y - 11), (x + width + 2, y + 4), (255, 255, 255), -1)
    cv2.putText(image, text, (x, y), cv2.FONT_HERSHEY_SIMPLEX, 0.4, _TEXT_RGB, 1, cv2.LINE_AA)


def _pixel(camera: Camera, point_w: Any) -> tuple[int, int] | None:
    """Where a point of the world is in the picture; None behind the camera."""
    T = np.asarray(camera.T_world_cam)
    x, y, z = T[:3, :3].T @ (np.asarray(point_w, float) - T[:3, 3])
    if z < 0.02:
        return None
    return round(camera.fx_px * x / z + camera.cx_px), round(camera.fy_px * y / z + camera.cy_px)


def _moved(T_world_frame: Pose, point_m: Any) -> np.ndarray:
    return T_world_frame[:3, :3] @ point_m + T_world_frame[:3, 3]


def _titled(image: Image, title: str) -> Image:
    head = np.full((22, image.shape[1], 3), 255, np.uint8)
    cv2.putText(head, title, (4, 15), cv2.FONT_HERSHEY_SIMPLEX, 0.42, _TEXT_RGB, 1, cv2.LINE_AA)
    return np.vstack([head, image])


def _place(position_m: Sequence[float]) -> str:
    return "(" + ", ".join(f"{metres:.2f}" for metres in position_m) + ") m"
