"""Hand-eye calibration: the solver on projected corners, what it refuses, the board, the poses, the file."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ddgrasp import contract
from ddgrasp.errors import UserError
from deploy.calibration import hand_eye, session
from deploy.calibration.hand_eye import View, calibrate, invert, park_martin, project
from deploy.interfaces import Lens
from mjx_envs.camera import look_at
from sensors.charuco_board import CharucoBoard, Corners, printable

BOARD = CharucoBoard()
LENS = Lens(np.array([[674.0, 0.0, 639.5], [0.0, 674.0, 359.5], [0.0, 0.0, 1.0]]), np.zeros(5), 1280, 720)
T_BASE_CAM = look_at(contract.CAMERA_POSITION_M, contract.CAMERA_LOOK_AT_M)
NOTHING = Corners(np.zeros(0, np.int32), np.zeros((0, 2)))


def pose(turn_deg=(0.0, 0.0, 0.0), shift_m=(0.0, 0.0, 0.0)) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_rotvec(np.radians(turn_deg)).as_matrix(), shift_m
    return T


T_GRIP_BOARD = pose((88.0, 3.0, -2.0), (-0.07, 0.004, 0.02))


def synthetic_views(rng, count=15, noise_px=0.2, axes=(1.0, 1.0, 1.0), hand_noise=(0.0, 0.0)) -> list[View]:
    """The board before the camera, turned by up to 35 degrees times `axes` about its own axes."""
    views = []
    middle = pose(shift_m=(-BOARD.size_m[0] / 2, -BOARD.size_m[1] / 2, 0.0))
    for _ in range(count):
        turn = rng.uniform(-35, 35, 3) * axes
        T_cam_board = pose(turn, rng.uniform((-0.15, -0.1, 0.5), (0.15, 0.1, 0.7))) @ middle
        T_base_grip = T_BASE_CAM @ T_cam_board @ invert(T_GRIP_BOARD)
        pixels = project(T_cam_board, BOARD.corners_m(), LENS) + noise_px * rng.normal(size=(24, 2))
        wrong = pose(hand_noise[1] * rng.normal(size=3), hand_noise[0] * rng.normal(size=3))
        views.append(View(T_base_grip @ wrong, Corners(np.arange(24, dtype=np.int32), pixels)))
    return views


def error(T) -> tuple[float, float]:
    """Millimetres and degrees from the true camera."""
    difference = invert(T_BASE_CAM) @ T
    turn = Rotation.from_matrix(difference[:3, :3]).magnitude()
    return 1e3 * float(np.linalg.norm(difference[:3, 3])), float(np.degrees(turn))


def test_without_noise_the_closed_form_is_exact():
    views = synthetic_views(np.random.default_rng(0), count=4, noise_px=0.0)
    seen = [hand_eye.board_pose(view.corners, LENS, BOARD) for view in views]
    mm, deg = error(park_martin([view.T_base_grip for view in views], seen))
    assert mm < 1e-3 and deg < 1e-4


@pytest.mark.skipif(not hasattr(cv2, "calibrateHandEye"), reason="OpenCV 5.0.0 does not export it to Python")
def test_the_closed_form_is_opencv_s():
    views = synthetic_views(np.random.default_rng(1), count=10, hand_noise=(0.001, 0.1))
    seen = [hand_eye.board_pose(view.corners, LENS, BOARD) for view in views]
    hands = [invert(view.T_base_grip) for view in views]
    R, t = cv2.calibrateHandEye(
        [T[:3, :3] for T in hands], [T[:3, 3] for T in hands],
        [T[:3, :3] for T in seen], [T[:3, 3] for T in seen], method=cv2.CALIB_HAND_EYE_PARK,
    )  # fmt: skip
    ours = park_martin([view.T_base_grip for view in views], seen)
    np.testing.assert_allclose(ours[:3, :3], R, atol=2e-3)
    np.testing.assert_allclose(ours[:3, 3], np.ravel(t), atol=2e-3)


@pytest.mark.parametrize("seed", range(3))
def test_noisy_corners_leave_a_tenth_of_a_millimetre_and_the_standard_error_says_so(seed):
    found = calibrate(synthetic_views(np.random.default_rng(seed)), LENS, BOARD)
    mm, deg = error(found.T_base_cam)
    assert mm < 0.5 and deg < 0.05
    assert 0.25 < found.rms_px < 0.31, "0.2 px in x and in y"
    assert found.used.all() and found.closed_form_rms_px > found.rms_px
    away = np.abs(found.T_base_cam[:3, 3] - T_BASE_CAM[:3, 3]) / found.position_std_m
    assert 1e-6 < found.position_std_m.max() < 5e-4 and away.max() < 4.0
    assert np.allclose(found.T_grip_board, T_GRIP_BOARD, atol=2e-3)


def test_an_arm_that_is_half_a_millimetre_off_stays_within_the_goal():
    views = synthetic_views(np.random.default_rng(5), count=20, hand_noise=(0.0005, 0.05))
    found = calibrate(views, LENS, BOARD)
    mm, deg = error(found.T_base_cam)
    assert mm < 2.0 and deg < 0.2 and found.rms_px > 0.35


def test_a_view_in_which_the_board_slipped_is_left_out():
    views = synthetic_views(np.random.default_rng(6))
    views[4] = View(views[4].T_base_grip @ pose((0, 4, 0), (0.01, 0, 0)), views[4].corners)
    few = Corners(views[7].corners.ids[:5], views[7].corners.pixels[:5])
    views[7] = View(views[7].T_base_grip, few)
    found = calibrate(views, LENS, BOARD)
    assert sorted(np.flatnonzero(~found.used)) == [4, 7]
    assert found.view_rms_px[4] > 3 and np.isnan(found.view_rms_px[7]) and error(found.T_base_cam)[0] < 0.5


def test_views_that_are_too_few_once_outliers_are_left_out_are_refused():
    views = synthetic_views(np.random.default_rng(6), count=7)
    for slipped, turn_deg in ((1, 4), (4, -5)):
        slip = pose((0, turn_deg, 0), (0.01, 0, 0))
        views[slipped] = View(views[slipped].T_base_grip @ slip, views[slipped].corners)
    with pytest.raises(UserError, match=r"5 of 7 views can be used .*at least 6"):
        calibrate(views, LENS, BOARD)


def test_a_view_of_a_single_line_of_corners_is_left_out():
    views = synthetic_views(np.random.default_rng(6))
    line = np.arange(0, 24, 4)
    views[7] = View(views[7].T_base_grip, Corners(views[7].corners.ids[line], views[7].corners.pixels[line]))
    assert np.linalg.matrix_rank(np.diff(BOARD.corners_m()[line], axis=0)) == 1, "six corners of one column"
    found = calibrate(views, LENS, BOARD)
    assert list(np.flatnonzero(~found.used)) == [7] and np.isnan(found.view_rms_px[7])


@pytest.mark.parametrize(
    ("square_m", "said"), [(0.0295, "1.0 px is much"), (0.025, "are the board's squares 25 mm")]
)
def test_squares_of_another_size_than_said_are_noticed(square_m, said, tmp_path):
    """No view contradicts the others: all are wrong alike."""
    board, heard = replace(BOARD, square_m=square_m, marker_m=0.018), []
    found = calibrate(synthetic_views(np.random.default_rng(0)), LENS, board)
    assert found.used.all()
    try:
        session._check_fit(found.rms_px, 1e3 * square_m, tmp_path / "calibration.png", heard.append)
    except UserError as error:
        heard.append(str(error))
    assert said in " ".join(heard)


def test_a_board_that_is_not_seen_is_named():
    views = [View(view.T_base_grip, NOTHING) for view in synthetic_views(np.random.default_rng(0), 8)]
    with pytest.raises(
        UserError, match=r"in none of 8 pictures.*5 x 7 squares, 30 mm.*DICT_4X4_50"
    ) as refused:
        calibrate(views, LENS, BOARD)
    assert "\n" not in str(refused.value)


def test_too_few_views_are_refused():
    views = synthetic_views(np.random.default_rng(0), 8)
    views[2:5] = [View(view.T_base_grip, NOTHING) for view in views[2:5]]
    with pytest.raises(UserError, match=r"5 of 8 views can be used .* at least 6"):
        calibrate(views, LENS, BOARD)


def test_turns_about_one_axis_are_refused():
    views = synthetic_views(np.random.default_rng(0), axes=(0.0, 1.0, 0.0))
    with pytest.raises(UserError, match=r"about one axis only in the 15 views .*\(0\.0 degrees"):
        calibrate(views, LENS, BOARD)


def test_the_spread_is_the_turns_about_their_axes():
    poses = [pose((turn, 0, 0)) for turn in (-30, 30)] + [pose((0, turn, 0)) for turn in (-10, 10)]
    expected = np.radians([30, 10, 0]) * np.sqrt(0.5)
    np.testing.assert_allclose(hand_eye.rotation_spread_rad(poses), expected, atol=1e-6)


def test_the_board_is_found_where_its_picture_shows_it():
    rng = np.random.default_rng(0)
    sharp = cv2.copyMakeBorder(BOARD.picture(200), 250, 250, 300, 300, cv2.BORDER_CONSTANT, value=(255,))
    H = np.array([[0.17, 0.02, 20.7], [0.015, 0.16, 17.7], [1e-5, 2e-5, 1.0]])
    shown = cv2.warpPerspective(cv2.GaussianBlur(sharp, (0, 0), 4.0), H, (300, 320), borderValue=(255,))
    gray = np.clip(0.7 * shown + 30 + 2 * rng.normal(size=shown.shape), 0, 255).astype(np.uint8)
    found = BOARD.find(gray)
    assert list(found.ids) == list(range(24)) and BOARD.corner_count == 24
    flat = np.c_[BOARD.corners_m()[:, :2] / BOARD.square_m * 200 + (300, 250) - 0.5, np.ones(24)] @ H.T
    away_px = found.pixels - flat[:, :2] / flat[:, 2:]
    assert np.abs(away_px).max() < 0.15 and np.abs(away_px.mean(axis=0)).max() < 0.03
    assert len(BOARD.find(np.full((90, 90), 128, np.uint8)).ids) == 0


def test_the_printed_page_has_the_pattern_in_its_true_size():
    page = np.frombuffer(printable(BOARD, "png"), np.uint8)
    gray = cv2.imdecode(page, cv2.IMREAD_GRAYSCALE)
    assert gray is not None
    np.testing.assert_allclose(gray.shape, (297 / 25.4 * 300, 210 / 25.4 * 300), atol=1)
    found = BOARD.find(np.asarray(gray))
    across_px = found.pixels[3] - found.pixels[0]
    assert across_px[0] / 300 * 25.4 == pytest.approx(90.0, abs=0.15) and abs(across_px[1]) < 1
    assert printable(BOARD, "pdf").startswith(b"%PDF")


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"columns": 2}, "2 x 7 squares: give at least 3 x 4"),
        ({"columns": 3, "rows": 3}, "3 x 3 squares: give at least 3 x 4"),  # 4 corners: no view is used
        ({"marker_m": 0.03}, "30 mm in squares of 30 mm"),
        ({"square_m": 0.0005, "marker_m": 0.0003}, "markers of 0.3 mm: .* less than 1 mm"),
        ({"columns": 11, "rows": 11}, "needs 60 markers, DICT_4X4_50 has 50"),
        ({"dictionary": "DICT_7X7"}, "'DICT_7X7': choose one of"),
    ],
)
def test_boards_that_cannot_be_are_refused(values, said):
    with pytest.raises(UserError, match=said):
        CharucoBoard(**values)
    assert CharucoBoard(columns=3, rows=4).corner_count == hand_eye.MIN_CORNERS
