"""Hand poses in which the camera sees the board that the gripper holds, and which the arm can reach."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float64
from scipy.spatial.transform import Rotation

from ddgrasp.errors import UserError
from deploy import kinematics
from deploy.calibration.hand_eye import Pose, invert, project
from deploy.interfaces import Lens
from deploy.safety import SafetyLimits
from sensors.charuco_board import CharucoBoard

DISTANCE_M = (0.42, 0.72)
"""From the camera to the board's middle."""
TILT_RAD, ROLL_RAD = np.radians(30.0), np.radians(40.0)
"""Largest turn of the board out of the picture's plane, about either axis, and within it."""
EDGE_PX = 25.0
"""The pattern stays this far inside the picture, so that a camera a little beside its place sees it too."""
TABLE_GAP_M, LINK_GAP_M = 0.02, 0.04
"""Room between the board and the table, and between it and the arm's own links."""
_JOINT_MARGIN_RAD = 0.05
_PATH_STEP_RAD = 0.1
_TRIES = 15
"""Random poses drawn for each that is wanted, in each of `_ROUNDS`: the straight way to some is not free."""
_ROUNDS = 4
_VIEW_TRIES = 2000
"""Random views drawn for one with the whole pattern in the picture."""


@dataclass(frozen=True)
class Bench:
    """What poses are planned for."""

    limits: SafetyLimits
    lens: Lens
    T_base_cam: Pose
    """(4, 4) where the camera is thought to stand."""
    board: CharucoBoard


def plan(
    bench: Bench, count: int, q_start_rad: Float[np.ndarray, "7"], rng: np.random.Generator
) -> Float64[np.ndarray, "n 7"]:
    """(count, 7) joint positions in the order of shortest ways from `q_start_rad`, straight ways free.

    Raises UserError if the arm's limits leave too few.
    """
    reached: list[np.ndarray] = []
    ordered: list[np.ndarray] = []
    for _ in range(_ROUNDS):
        reached += _reached(bench, count + count // 2, q_start_rad, rng)
        ordered = _ordered(reached, q_start_rad, lambda a, b: is_free_way(bench, a, b))[:count]
        if len(ordered) == count:
            return np.array(ordered)
    raise UserError(
        f"{len(ordered)} of {count} poses with the board in view can be reached within deploy.workspace and "
        "deploy.arm: give fewer --poses, a smaller board, or wider limits if there is room."
    )


def reach(T_base_grip: Pose, q_guess_rad: Float[np.ndarray, "7"], limits: SafetyLimits) -> np.ndarray | None:
    """(7,) joints that bring the grip frame there, within the limits; None if they are not found.

    Damped least squares from `q_guess_rad`.
    """
    lower, upper = np.array(limits.lower_rad), np.array(limits.upper_rad)
    q = np.clip(q_guess_rad, lower + _JOINT_MARGIN_RAD, upper - _JOINT_MARGIN_RAD)
    for _ in range(40):
        now = kinematics.grip_pose(q)
        turn = Rotation.from_matrix(T_base_grip[:3, :3] @ now[:3, :3].T).as_rotvec()
        error = np.concatenate([T_base_grip[:3, 3] - now[:3, 3], turn])
        if np.abs(error).max() < 1e-4:
            return q
        J = kinematics.grip_jacobian(q)
        step = J.T @ np.linalg.solve(J @ J.T + 1e-4 * np.eye(6), error)
        step *= min(1.0, 0.3 / float(np.abs(step).max()))
        q = np.clip(q + step, lower + _JOINT_MARGIN_RAD, upper - _JOINT_MARGIN_RAD)
    return None


def is_free(bench: Bench, q_rad: Float[np.ndarray, "7"]) -> bool:
    """Whether grip point, arm and board are where they may be, the board clear of table and arm."""
    limits, T_base_grip = bench.limits, kinematics.grip_pose(q_rad)
    if not _is_board_free(bench, T_base_grip):
        return False
    centers, radii = kinematics.part_centers(q_rad), kinematics.PART_RADII_M[:, None]
    if (centers - radii < limits.arm_lower_m).any() or (centers + radii > limits.arm_upper_m).any():
        return False
    points = _sheet_m(bench.board, T_base_grip)
    links = kinematics.LINKS  # what the board could touch; hand and flange hold it
    apart = np.linalg.norm(points[:, None] - centers[None, links], axis=-1) - radii[None, links, 0]
    return bool(apart.min() > LINK_GAP_M)


def is_free_way(bench: Bench, a_rad: Float[np.ndarray, "7"], b_rad: Float[np.ndarray, "7"]) -> bool:
    """Whether all joints at once, straight from (7,) `a_rad` to (7,) `b_rad`, keep clear."""
    steps = int(np.ceil(np.abs(b_rad - a_rad).max() / _PATH_STEP_RAD))
    return all(is_free(bench, a_rad + (b_rad - a_rad) * i / max(steps, 1)) for i in range(steps + 1))


def _reached(bench: Bench, count: int, q_start_rad: np.ndarray, rng: np.random.Generator) -> list[np.ndarray]:
    """Up to `count` joint positions with the board in view, in the order in which they were drawn."""
    T_board_grip = invert(bench.board.held_pose())
    found: list[np.ndarray] = []
    for _ in range(_TRIES * count):
        T_base_grip = bench.T_base_cam @ _random_view(bench, rng) @ T_board_grip
        if not _is_board_free(bench, T_base_grip):
            continue  # before the arm's joints are looked for, which takes longer
        for turned in (np.pi / 2, -np.pi / 2):
            q = reach(T_base_grip, np.append(q_start_rad[:6], q_start_rad[6] + turned), bench.limits)
            if q is not None and is_free(bench, q):
                found.append(q)
                break
        if len(found) == count:
            break
    return found


def _random_view(bench: Bench, rng: np.random.Generator) -> np.ndarray:
    """(4, 4) T_cam_board with the whole pattern in the picture. UserError if it hardly ever fits."""
    lens, board = bench.lens, bench.board
    width, height = board.size_m
    outline = board.outline_m()
    for _ in range(_VIEW_TRIES):
        tilt, roll = rng.uniform(-TILT_RAD, TILT_RAD, 2), rng.uniform(-ROLL_RAD, ROLL_RAD)
        T = np.eye(4)
        T[:3, :3] = (Rotation.from_rotvec([*tilt, 0.0]) * Rotation.from_rotvec([0.0, 0.0, roll])).as_matrix()
        pixel = rng.uniform(0, 1, 2) * (lens.width_px, lens.height_px)
        ray = np.linalg.solve(lens.matrix, [*pixel, 1.0])
        middle = ray * rng.uniform(*DISTANCE_M)
        T[:3, 3] = middle - T[:3, :3] @ (width / 2, height / 2, 0.0)
        seen = project(T, outline, lens)
        size = (lens.width_px - 1, lens.height_px - 1)
        if (seen > EDGE_PX).all() and (seen < np.array(size) - EDGE_PX).all():
            return T
    near_m, far_m = DISTANCE_M
    raise UserError(
        f"a pattern of {1e3 * width:.0f} x {1e3 * height:.0f} mm does not fit into the picture at {near_m:g} "
        f"to {far_m:g} m: print it smaller, and give --board.square-mm in millimetres."
    )


def _is_board_free(bench: Bench, T_base_grip: np.ndarray) -> bool:
    """Whether the grip point is in its box, and the board in the arm's, clear of the table."""
    limits, grip = bench.limits, T_base_grip[:3, 3]
    if (grip < limits.workspace_lower_m).any() or (grip > limits.workspace_upper_m).any():
        return False
    points = _sheet_m(bench.board, T_base_grip)
    lower_m = np.array(limits.arm_lower_m) + (0.0, 0.0, TABLE_GAP_M)
    return bool((points >= lower_m).all() and (points <= limits.arm_upper_m).all())


def _sheet_m(board: CharucoBoard, T_base_grip: np.ndarray) -> np.ndarray:
    """(9, 3) corners, edges' middles and middle of the pattern in the robot's base frame."""
    width, height = board.size_m
    points = [[x, y, 0.0] for x in (0.0, width / 2, width) for y in (0.0, height / 2, height)]
    T = T_base_grip @ board.held_pose()
    return np.array(points) @ T[:3, :3].T + T[:3, 3]


def _ordered(
    poses: list[np.ndarray], q_start_rad: np.ndarray, free: Callable[[np.ndarray, np.ndarray], bool]
) -> list[np.ndarray]:
    """Always on to the nearest pose to which the straight way is free; others are left out."""
    left, way = list(poses), [q_start_rad]
    while left:
        left.sort(key=lambda q: float(np.abs(q - way[-1]).max()))
        index = next((i for i, q in enumerate(left) if free(way[-1], q)), None)
        if index is None:
            break
        way.append(left.pop(index))
    return way[1:]
