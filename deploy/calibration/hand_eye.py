"""Hand-eye calibration of a camera that stands beside the robot (eye-to-hand), board in the gripper.

For every view i, T_base_grip_i T_grip_board = T_base_cam T_cam_board_i, with T_base_cam and T_grip_board
unknown and the same in all of them. A closed form starts, the reprojection error of all corners decides.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float64
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from ddgrasp.errors import UserError
from deploy.interfaces import Lens
from sensors.charuco_board import MIN_CORNERS, CharucoBoard, Corners

MIN_VIEWS = 6
MIN_SPREAD_RAD = np.radians(5.0)
"""RMS of the hand's turns about the second of their principal axes. With turns about one axis alone the
camera's place along that axis cannot be told."""
OUTLIER_RATIO, OUTLIER_PX = 3.0, 1.0
"""A view is left out whose RMS is this many times the median view's, and more than this many pixels."""
_HUBER_PX = 1.0
_HALF_TURN_RAD = np.radians(170.0)
"""A relative turn of nearly half a turn has no axis that could be trusted."""

Pose = Float64[np.ndarray, "4 4"]


@dataclass(frozen=True)
class View:
    """A picture's corners and where the hand was."""

    T_base_grip: Pose
    """(4, 4) pose of the grip point in the robot's base frame, metres."""
    corners: Corners


@dataclass(frozen=True)
class HandEye:
    """Where the camera stands, and how far that can be trusted."""

    T_base_cam: Pose
    """(4, 4) pose of the camera in the robot's base frame, metres."""
    T_grip_board: Pose
    """(4, 4) pose of the board in the grip frame, metres."""
    rms_px: float
    """Reprojection error of the corners of all used views: root mean square of distances."""
    view_rms_px: Float64[np.ndarray, " n"]
    """(n,) the same for every view, NaN where it has too few corners."""
    used: Bool[np.ndarray, " n"]
    """(n,) which views were used."""
    closed_form_rms_px: float
    """The same of the closed form, over the same views."""
    position_std_m: Float64[np.ndarray, "3"]
    """(3,) standard error of the camera's position, base frame, if corners alone were noisy."""
    angle_std_rad: Float64[np.ndarray, "3"]
    """(3,) of its orientation about its own axes."""


def calibrate(views: Sequence[View], lens: Lens, board: CharucoBoard) -> HandEye:
    """The camera's pose from `views`; views that do not fit the others are left out.

    Raises UserError: board in too few views, or the hand turned about one axis only.
    """
    usable = np.array([_tells_pose(view.corners, board) for view in views], bool)
    _check_views(usable, views, board)
    used = usable.copy()
    problem = _Problem(views, lens, board)
    start = problem.closed_form(used)
    unknowns = problem.refine(start, used, loss="huber")
    for _ in range(3):
        errors = problem.view_rms_px(unknowns)
        fits = usable & (errors <= max(OUTLIER_RATIO * float(np.median(errors[used])), OUTLIER_PX))
        _check_views(fits, views, board)
        if np.array_equal(fits, used):
            break
        used = fits
        start = problem.closed_form(used)
        unknowns = problem.refine(start, used, loss="huber")
    unknowns = problem.refine(unknowns, used, loss="linear")
    return problem.answer(unknowns, start, used)


def rotation_spread_rad(T_base_grip: Sequence[Pose]) -> Float64[np.ndarray, "3"]:
    """(3,) RMS turn of the hand about the principal axes of its turns, largest first, radians."""
    rotations = Rotation.from_matrix(np.array([T[:3, :3] for T in T_base_grip]))
    turns = (rotations.mean().inv() * rotations).as_rotvec()
    return np.linalg.svd(turns, compute_uv=False) / np.sqrt(len(turns))


def park_martin(T_base_grip: Sequence[Pose], T_cam_board: Sequence[Pose]) -> Pose:
    """(4, 4) T_base_cam in closed form from n >= 3 poses of hand and board.

    F. C. Park and B. J. Martin, "Robot sensor calibration: solving AX = XB on the Euclidean group", IEEE
    Transactions on Robotics and Automation 10(5), 1994. A = G_j G_i^-1 and B = C_j C_i^-1 over all pairs: the
    rotation is the least squares fit of log A = R log B, the translation that of (R_A - I) t = R t_B - t_A.
    """
    pairs = [(i, j) for i in range(len(T_base_grip)) for j in range(i)]
    motions = [
        (T_base_grip[j] @ invert(T_base_grip[i]), T_cam_board[j] @ invert(T_cam_board[i])) for i, j in pairs
    ]
    hand, seen = (np.array(side) for side in zip(*motions, strict=True))
    alpha, beta = (Rotation.from_matrix(side[:, :3, :3]).as_rotvec() for side in (hand, seen))
    clear = np.maximum(np.linalg.norm(alpha, axis=1), np.linalg.norm(beta, axis=1)) < _HALF_TURN_RAD
    u, _, vt = np.linalg.svd(alpha[clear].T @ beta[clear])
    R = u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))]) @ vt
    left = (hand[:, :3, :3] - np.eye(3)).reshape(-1, 3)
    right = (seen[:, :3, 3] @ R.T - hand[:, :3, 3]).reshape(-1)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, np.linalg.lstsq(left, right, rcond=None)[0]
    return T


def board_pose(corners: Corners, lens: Lens, board: CharucoBoard) -> Pose:
    """(4, 4) T_cam_board of one view; of the two that a plane allows, the one that fits better."""
    points = board.corners_m()[corners.ids]
    _, turns, shifts, _ = cv2.solvePnPGeneric(
        points, corners.pixels, lens.matrix, lens.distortion, flags=cv2.SOLVEPNP_IPPE
    )
    turn, shift = cv2.solvePnPRefineLM(
        points, corners.pixels, lens.matrix, lens.distortion, turns[0], shifts[0]
    )
    return _pose(np.concatenate([turn.ravel(), shift.ravel()]))


def invert(T: Pose) -> Pose:
    """(4, 4) inverse of a rigid transform."""
    inverse = np.eye(4)
    inverse[:3, :3] = T[:3, :3].T
    inverse[:3, 3] = -T[:3, :3].T @ T[:3, 3]
    return inverse


def project(T_cam_board: Pose, points_m: Float[np.ndarray, "n 3"], lens: Lens) -> Float64[np.ndarray, "n 2"]:
    """(n, 2) pixels of points in the board's frame."""
    turn = Rotation.from_matrix(T_cam_board[:3, :3]).as_rotvec()
    pixels, _ = cv2.projectPoints(
        np.asarray(points_m, float), turn, T_cam_board[:3, 3], lens.matrix, lens.distortion
    )
    return np.asarray(pixels, float).reshape(-1, 2)


class _Problem:
    """Twelve unknowns, (T_cam_base, T_grip_board) as rotation vector and translation each, and residuals."""

    def __init__(self, views: Sequence[View], lens: Lens, board: CharucoBoard):
        self._views, self._lens, self._board = views, lens, board
        self._points = board.corners_m()

    def closed_form(self, used: np.ndarray) -> np.ndarray:
        """(12,) where to start: Park and Martin's camera, and the board that most views agree with."""
        chosen = [view for view, use in zip(self._views, used, strict=True) if use]
        seen = [board_pose(view.corners, self._lens, self._board) for view in chosen]
        T_base_cam = park_martin([view.T_base_grip for view in chosen], seen)
        boards = [invert(v.T_base_grip) @ T_base_cam @ T for v, T in zip(chosen, seen, strict=True)]
        candidates = [np.concatenate([_vector(invert(T_base_cam)), _vector(T)]) for T in boards]
        return min(candidates, key=lambda x: float(np.median(self.view_rms_px(x)[used])))

    def refine(self, start: np.ndarray, used: np.ndarray, loss: str) -> np.ndarray:
        """(12,) of least reprojection error over the used views."""
        return np.asarray(least_squares(self._residuals, start, args=(used,), loss=loss, f_scale=_HUBER_PX).x)

    def view_rms_px(self, unknowns: np.ndarray) -> np.ndarray:
        """(n,) per view, NaN without enough corners."""
        camera, board = _pose(unknowns[:6]), _pose(unknowns[6:])
        return np.array([self._rms(view, camera, board) for view in self._views])

    def answer(self, unknowns: np.ndarray, start: np.ndarray, used: np.ndarray) -> HandEye:
        """What is reported of (12,) `unknowns`; standard errors by the residuals' own size."""
        solution = least_squares(self._residuals, unknowns, args=(used,))
        count = len(solution.fun)
        covariance = np.linalg.pinv(solution.jac.T @ solution.jac) * (solution.fun @ solution.fun)
        covariance = covariance[:6, :6] / max(count - 12, 1)
        T_cam_base = _pose(unknowns[:6])
        # x = R^T (p - t) with small errors of rotation vector and translation: numerically, by columns.
        camera = np.stack([_moved(T_cam_base, unknowns[:6], column) for column in np.eye(6)], axis=1)
        std = np.sqrt(np.diag(camera @ covariance @ camera.T))
        return HandEye(
            T_base_cam=invert(T_cam_base),
            T_grip_board=_pose(unknowns[6:]),
            rms_px=_total(solution.fun),
            view_rms_px=self.view_rms_px(unknowns),
            used=used,
            closed_form_rms_px=_total(self._residuals(start, used)),
            position_std_m=std[:3],
            angle_std_rad=std[3:],
        )

    def _residuals(self, unknowns: np.ndarray, used: np.ndarray) -> np.ndarray:
        camera, board = _pose(unknowns[:6]), _pose(unknowns[6:])
        chosen = (view for view, use in zip(self._views, used, strict=True) if use)
        return np.concatenate([self._errors(view, camera, board).ravel() for view in chosen])

    def _errors(self, view: View, T_cam_base: np.ndarray, T_grip_board: np.ndarray) -> np.ndarray:
        """(corners, 2) pixels between where corners should be and where they are."""
        T_cam_board = T_cam_base @ view.T_base_grip @ T_grip_board
        return project(T_cam_board, self._points[view.corners.ids], self._lens) - view.corners.pixels

    def _rms(self, view: View, T_cam_base: np.ndarray, T_grip_board: np.ndarray) -> float:
        if not _tells_pose(view.corners, self._board):
            return float("nan")
        return _total(self._errors(view, T_cam_base, T_grip_board).ravel())


def _tells_pose(corners: Corners, board: CharucoBoard) -> bool:
    """Whether there are enough of them, and not all on one line."""
    points = board.corners_m()[corners.ids]
    return len(points) >= MIN_CORNERS and int(np.linalg.matrix_rank(points - points.mean(axis=0), 1e-6)) == 2


def _check_views(used: np.ndarray, views: Sequence[View], board: CharucoBoard) -> None:
    if not any(len(view.corners.ids) for view in views):
        raise UserError(
            f"the board is in none of {len(views)} pictures; looked for: {board.describe()}. Is it in view, "
            "lit, flat, in one piece and of these measures?"
        )
    if used.sum() < MIN_VIEWS:
        raise UserError(
            f"{used.sum()} of {len(views)} views can be used ({MIN_CORNERS} corners or more, on more than "
            f"one line, that fit the other views), at least {MIN_VIEWS} are needed: more --poses, more "
            "light, a flat board."
        )
    hands = [view.T_base_grip for view, use in zip(views, used, strict=True) if use]
    spread = rotation_spread_rad(hands)[1]
    if spread < MIN_SPREAD_RAD:
        raise UserError(
            f"the hand turned about one axis only in the {used.sum()} views that can be used "
            f"({np.degrees(spread):.1f} degrees about the second one, {np.degrees(MIN_SPREAD_RAD):.0f} are "
            "needed): the camera's place along that axis cannot be told; turn it about two axes."
        )


def _total(residuals: np.ndarray) -> float:
    """Root mean square of distances from the flat x and y of every corner."""
    return float(np.sqrt(2.0 * np.mean(np.square(residuals)))) if len(residuals) else float("nan")


def _pose(vector: np.ndarray) -> Pose:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_rotvec(vector[:3]).as_matrix(), vector[3:]
    return T


def _vector(T: np.ndarray) -> np.ndarray:
    return np.concatenate([Rotation.from_matrix(T[:3, :3]).as_rotvec(), T[:3, 3]])


def _moved(T_cam_base: np.ndarray, vector: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """(6,) how T_base_cam changes with `vector`: position in the base frame, turn about its own axes."""
    step = 1e-6
    before, after = invert(T_cam_base), invert(_pose(vector + step * direction))
    turn = Rotation.from_matrix(before[:3, :3].T @ after[:3, :3]).as_rotvec()
    return np.concatenate([after[:3, 3] - before[:3, 3], turn]) / step
