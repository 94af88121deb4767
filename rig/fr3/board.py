"""The calibration board in the hand of the rig's FR3, held as by a person: not quite straight.

It weighs nothing, and nothing collides with it.
"""

import xml.etree.ElementTree as ET

import cv2
import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

from ddgrasp.files import atomic_write_bytes, user_cache
from mjx_envs.scene import GRIP_POS_M, mjcf
from sensors.charuco_board import CharucoBoard

HAND = "hand"
"""How the name of the hand's body ends."""
SLIP_M, SLIP_RAD = 0.004, np.radians(3.0)
"""Largest deviation from `CharucoBoard.held_pose`, each axis."""
MARGIN_M, HALF_THICK_M = 0.010, 0.0015
_TEXTURE_PX = 200
"""Pixels per square."""
_NAME = "calibration_board"


def held_pose(board: CharucoBoard, seed: int) -> Float64[np.ndarray, "4 4"]:
    """(4, 4) T_grip_board as the board happens to be held."""
    rng = np.random.default_rng((seed, 1))
    slip = np.eye(4)
    slip[:3, :3] = Rotation.from_rotvec(rng.uniform(-SLIP_RAD, SLIP_RAD, 3)).as_matrix()
    slip[:3, 3] = rng.uniform(-SLIP_M, SLIP_M, 3)
    return board.held_pose() @ slip


def hold(scene: ET.Element, board: CharucoBoard, seed: int) -> None:
    """Adds `board` to the hand in the MJCF `scene`, before it is compiled; `seed` says how it is held."""
    hand = next(body for body in scene.iter("body") if body.get("name", "").endswith(HAND))
    assets = scene.find("asset")
    assert assets is not None
    T = held_pose(board, seed)
    T[:3, 3] += GRIP_POS_M
    turn = Rotation.from_matrix(T[:3, :3]).as_quat(scalar_first=True)
    place = {"pos": mjcf(T[:3, 3]), "quat": mjcf(turn)}
    body = ET.SubElement(hand, "body", {"name": _NAME, **place})
    width, height = board.size_m
    corners = " ".join(f"{x} {y} 0" for x, y in ((0, 0), (width, 0), (width, height), (0, height)))
    sheet = {"vertex": corners, "texcoord": "0 0 1 0 1 1 0 1", "face": "0 2 1 0 3 2", "inertia": "shell"}
    ET.SubElement(assets, "texture", {"name": _NAME, "type": "2d", "file": _texture(board)})
    ET.SubElement(assets, "material", {"name": _NAME, "texture": _NAME, "specular": "0", "shininess": "0"})
    ET.SubElement(assets, "mesh", {"name": _NAME, **sheet})
    shows = {"class": "visual", "contype": "0", "conaffinity": "0", "mass": "0", "group": "1"}
    front = {"type": "mesh", "mesh": _NAME, "material": _NAME, "rgba": "1 1 1 1"}
    ET.SubElement(body, "geom", front | shows)
    back = {
        "type": "box",
        "size": mjcf((width / 2 + MARGIN_M, height / 2 + MARGIN_M, HALF_THICK_M)),
        "pos": mjcf((width / 2, height / 2, HALF_THICK_M + 2e-4)),
        "rgba": "0.9 0.9 0.9 1",
    }
    ET.SubElement(body, "geom", back | shows)


def _texture(board: CharucoBoard) -> str:
    """Path of the pattern's picture, which is made anew: it takes milliseconds."""
    ok, png = cv2.imencode(".png", cv2.cvtColor(board.picture(_TEXTURE_PX), cv2.COLOR_GRAY2BGR))
    assert ok
    path = user_cache("boards") / f"{board.columns}x{board.rows}-{board.dictionary}.png"
    atomic_write_bytes(path, png.tobytes())
    return str(path.resolve())
