"""The ChArUco board that calibration looks for: its measures, its print, and where a picture shows it.

Board frame as OpenCV has it: origin at the pattern's upper left corner, x right, y down, z into the board.
"""

import io
import math
from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Float64, Int32, UInt8

from ddgrasp.config.sensors import MARKER_DICTIONARIES, MarkerDictionary
from ddgrasp.errors import UserError

PAPERS_MM = {"A4": (210.0, 297.0), "A3": (297.0, 420.0)}
HELD_AT_M = 0.020
"""From the point between the finger pads to the pattern's upper edge: the plate's margin is between them."""
MIN_CORNERS = 6
"""Calibration uses no view with fewer, nor one with those of a single line: a plane's pose from them is a
guess."""
_SMALLEST_MARKER_M = 0.001
_INCH_MM = 25.4
_PRINT_DPI = 300
_RULER_MM = 100.0
_WINDOW_SHARE = 0.7
"""Half a refinement window's side over the gap between a corner and the nearest marker."""
_SUBPIXEL_STOP = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 50, 1e-3)


@dataclass(frozen=True)
class Corners:
    """Inner corners of the board that a picture shows."""

    ids: Int32[np.ndarray, " n"]
    """(n,) numbers of the corners, row by row."""
    pixels: Float64[np.ndarray, "n 2"]
    """(n, 2) where they are, column and row; the centre of the upper left pixel is (0, 0), as in OpenCV."""


@dataclass(frozen=True)
class CharucoBoard:
    """A chess board whose light squares carry ArUco markers, so that every corner has a number.

    Raises UserError for measures that no board can have.
    """

    columns: int = 5
    rows: int = 7
    """Squares."""
    square_m: float = 0.030
    marker_m: float = 0.022
    """Side of a square and of the marker inside it."""
    dictionary: MarkerDictionary = "DICT_4X4_50"
    """OpenCV's name of the set of markers."""

    def __post_init__(self) -> None:
        if self.dictionary not in MARKER_DICTIONARIES:
            raise UserError(
                f"board dictionary {self.dictionary!r}: choose one of {', '.join(MARKER_DICTIONARIES)}."
            )
        if min(self.columns, self.rows) < 3 or self.corner_count < MIN_CORNERS:
            raise UserError(f"a board of {self.columns} x {self.rows} squares: give at least 3 x 4.")
        if not 0 < self.marker_m < self.square_m:
            raise UserError(
                f"board markers of {1e3 * self.marker_m:g} mm in squares of {1e3 * self.square_m:g} mm: "
                "a marker must be smaller than its square, and larger than nothing."
            )
        if self.marker_m < _SMALLEST_MARKER_M:
            raise UserError(
                f"board markers of {1e3 * self.marker_m:g} mm: no printer or camera resolves less than "
                f"{1e3 * _SMALLEST_MARKER_M:g} mm."
            )
        known, needed = len(self._markers().bytesList), self.columns * self.rows // 2
        if needed > known:
            raise UserError(
                f"a board of {self.columns} x {self.rows} squares needs {needed} markers, {self.dictionary} "
                f"has {known}: take fewer squares or a larger dictionary."
            )

    @property
    def size_m(self) -> tuple[float, float]:
        """Width and height of the pattern."""
        return self.columns * self.square_m, self.rows * self.square_m

    @property
    def corner_count(self) -> int:
        """Inner corners."""
        return (self.columns - 1) * (self.rows - 1)

    def corners_m(self) -> Float64[np.ndarray, "n 3"]:
        """(n, 3) inner corners in the board's frame, by their numbers."""
        return np.asarray(self._board().getChessboardCorners(), float)

    def outline_m(self) -> Float64[np.ndarray, "4 3"]:
        """(4, 3) the pattern's own corners in the board's frame, clockwise from the upper left one."""
        width, height = self.size_m
        return np.array([[0.0, 0.0, 0.0], [width, 0.0, 0.0], [width, height, 0.0], [0.0, height, 0.0]])

    def held_pose(self) -> Float64[np.ndarray, "4 4"]:
        """(4, 4) T_grip_board of a plate that the fingers hold at the middle of its upper margin.

        The pattern faces along y of the grip frame, in which the fingers open; its lower edge points out of
        the hand.
        """
        T = np.eye(4)
        T[:3, :3] = [[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]
        T[:3, 3] = (-self.size_m[0] / 2, 0.0, HELD_AT_M)
        return T

    def picture(self, px_per_square: int) -> UInt8[np.ndarray, "h w"]:
        """(rows * px, columns * px) uint8 of the pattern, without a margin."""
        size = (self.columns * px_per_square, self.rows * px_per_square)
        return np.asarray(self._board().generateImage(size, marginSize=0, borderBits=1))

    def find(self, gray: UInt8[np.ndarray, "H W"]) -> Corners:
        """Corners in an (H, W) uint8 picture, refined below a pixel; none where no board is seen."""
        corners, ids, *_ = cv2.aruco.CharucoDetector(self._board()).detectBoard(gray)
        if ids is None or corners is None:
            return Corners(np.zeros(0, np.int32), np.zeros((0, 2)))
        return Corners(np.asarray(ids, np.int32).ravel(), self._refined(gray, np.asarray(corners)))

    def _refined(self, gray: np.ndarray, corners: np.ndarray) -> np.ndarray:
        """(n, 2) once more, in windows that no marker reaches into: markers pull at the corners, and versions
        of OpenCV differ by half a pixel in what they return."""
        pixels = corners.reshape(-1, 2).astype(np.float32)
        if len(pixels) < 2:
            return pixels.astype(float)
        apart = np.linalg.norm(pixels[:, None] - pixels[None], axis=-1) + 1e9 * np.eye(len(pixels))
        gap_px = float(np.median(apart.min(axis=1))) * (self.square_m - self.marker_m) / 2 / self.square_m
        half = int(np.clip(round(_WINDOW_SHARE * gap_px), 2, 9))
        cv2.cornerSubPix(gray, pixels.reshape(-1, 1, 2), (half, half), (-1, -1), _SUBPIXEL_STOP)
        return pixels.astype(float)

    def describe(self) -> str:
        """One line for whoever holds, or looks for, the board."""
        return (
            f"ChArUco board of {self.columns} x {self.rows} squares, {1e3 * self.square_m:g} mm each, "
            f"markers {1e3 * self.marker_m:g} mm of {self.dictionary}"
        )

    def _markers(self) -> "cv2.aruco.Dictionary":
        return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, self.dictionary))

    def _board(self) -> "cv2.aruco.CharucoBoard":
        size = (self.columns, self.rows)
        return cv2.aruco.CharucoBoard(size, self.square_m, self.marker_m, self._markers())


def printable(board: CharucoBoard, kind: Literal["png", "pdf"]) -> bytes:
    """A page to print at 100 %: the pattern at its true size, its measures, a ruler to check the print.

    Raises UserError if no page of `PAPERS_MM` holds it.
    """
    from matplotlib.figure import Figure

    width_mm, height_mm = (1e3 * side for side in board.size_m)
    paper_mm = _paper_mm(width_mm, height_mm)
    figure = Figure(figsize=(paper_mm[0] / _INCH_MM, paper_mm[1] / _INCH_MM), dpi=_PRINT_DPI)
    left_mm, foot_mm = (paper_mm[0] - width_mm) / 2, (paper_mm[1] - height_mm) / 2 + 10
    box = (left_mm / paper_mm[0], foot_mm / paper_mm[1], width_mm / paper_mm[0], height_mm / paper_mm[1])
    axes = figure.add_axes(box)
    axes.imshow(board.picture(_print_px(board)), cmap="gray", interpolation="nearest", aspect="auto")
    axes.set_axis_off()
    page = figure.add_axes((0.0, 0.0, 1.0, 1.0), xlim=(0, paper_mm[0]), ylim=(0, paper_mm[1]))
    page.set_axis_off()
    page.patch.set_alpha(0.0)
    start_mm = (paper_mm[0] - _RULER_MM) / 2
    page.plot([start_mm, start_mm + _RULER_MM], [14.0, 14.0], "k|-", linewidth=0.8, markersize=8)
    below = {"ha": "center", "va": "center", "fontsize": 8}
    page.text(paper_mm[0] / 2, 18.0, f"{_RULER_MM:g} mm: print at 100 %, then measure", **below)
    page.text(paper_mm[0] / 2, 8.0, board.describe(), **below)
    file = io.BytesIO()
    figure.savefig(file, format=kind, dpi=_PRINT_DPI)
    return file.getvalue()


def _print_px(board: CharucoBoard) -> int:
    """Pixels per square, no fewer than the printer has."""
    return math.ceil(1e3 * board.square_m / _INCH_MM * _PRINT_DPI)


def _paper_mm(width_mm: float, height_mm: float) -> tuple[float, float]:
    for paper in PAPERS_MM.values():
        if width_mm + 10 <= paper[0] and height_mm + 50 <= paper[1]:
            return paper
    raise UserError(
        f"a board of {width_mm:g} x {height_mm:g} mm fits no page of {', '.join(PAPERS_MM)}: "
        "take smaller squares, or fewer."
    )
