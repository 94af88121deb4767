"""What calibration saw, for people: corners found, corners where they should be, and axes."""

from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import UInt8

from deploy.calibration.hand_eye import HandEye, View, invert, project
from deploy.interfaces import Lens
from sensors.charuco_board import CharucoBoard

COLUMNS, TILES = 2, 4
TILE_WIDTH_PX = 640
BOARD_AXIS_M, BASE_AXIS_M = 0.06, 0.2
_FOUND, _EXPECTED, _TEXT = (80, 220, 80), (40, 40, 255), (255, 255, 255)
"""Blue, green, red."""
_AXES = ((40, 40, 255), (40, 200, 40), (255, 80, 40))
"""x, y, z."""


def sheet(
    pictures: Sequence[UInt8[np.ndarray, "H W"]],
    views: Sequence[View],
    hand_eye: HandEye,
    lens: Lens,
    board: CharucoBoard,
) -> bytes:
    """PNG of a few used views, spread over all of them.

    Green rings: corners as found; red crosses: as the calibration expects them; axes (x red, y green, z blue)
    of the board and of the robot's base, which must stand in the arm's foot if all is well.
    """
    used = np.flatnonzero(hand_eye.used)
    chosen = used[np.unique(np.linspace(0, len(used) - 1, TILES).round().astype(int))]
    tiles = [_tile(pictures[i], views[i], hand_eye, lens, board, int(i)) for i in chosen]
    tiles += [np.zeros_like(tiles[0])] * (-len(tiles) % COLUMNS)
    rows = [np.hstack(tiles[i : i + COLUMNS]) for i in range(0, len(tiles), COLUMNS)]
    return encode(np.vstack(rows))


def encode(picture: UInt8[np.ndarray, "*shape"]) -> bytes:
    """PNG of a grey or a BGR picture."""
    ok, png = cv2.imencode(".png", picture)
    assert ok
    return png.tobytes()


def _tile(
    gray: np.ndarray, view: View, hand_eye: HandEye, lens: Lens, board: CharucoBoard, index: int
) -> np.ndarray:
    """(h, w, 3) one view, drawn on at full size, then made smaller."""
    shown = cv2.cvtColor(gray, cv2.COLOR_GRAY2BGR)
    T_cam_base = invert(hand_eye.T_base_cam)
    T_cam_board = T_cam_base @ view.T_base_grip @ hand_eye.T_grip_board
    expected = project(T_cam_board, board.corners_m()[view.corners.ids], lens)
    for found, should in zip(view.corners.pixels, expected, strict=True):
        cv2.circle(shown, _whole(found), 7, _FOUND, 2, cv2.LINE_AA)
        cv2.drawMarker(shown, _whole(should), _EXPECTED, cv2.MARKER_CROSS, 9, 2)
    for T, length_m in ((T_cam_board, BOARD_AXIS_M), (T_cam_base, BASE_AXIS_M)):
        _draw_axes(shown, T, length_m, lens)
    height_px = round(lens.height_px * TILE_WIDTH_PX / lens.width_px)
    small = cv2.resize(shown, (TILE_WIDTH_PX, height_px), interpolation=cv2.INTER_AREA)
    text = f"view {index + 1}: {len(view.corners.ids)} corners, {hand_eye.view_rms_px[index]:.2f} px RMS"
    cv2.putText(small, text, (10, height_px - 12), cv2.FONT_HERSHEY_SIMPLEX, 0.5, _TEXT, 1, cv2.LINE_AA)
    return small


def _draw_axes(shown: np.ndarray, T_cam_frame: np.ndarray, length_m: float, lens: Lens) -> None:
    """As cv2.drawFrameAxes, which complains on the terminal of axes that leave the picture."""
    if T_cam_frame[2, 3] < 2 * length_m:  # behind the camera, or so near that an end might be
        return
    origin, *ends = project(T_cam_frame, length_m * np.vstack([np.zeros(3), np.eye(3)]), lens)
    for end, colour in zip(ends, _AXES, strict=True):
        cv2.line(shown, _whole(origin), _whole(end), colour, 4, cv2.LINE_AA)


def _whole(pixel: np.ndarray) -> tuple[int, int]:
    return round(float(pixel[0])), round(float(pixel[1]))
