"""Depth picture: hand-derived values, invalid pixels, crops, resizing."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ddgrasp import contract
from ddgrasp.config import StudentConfig
from ddgrasp.errors import UserError
from mjx_envs.camera import nominal_camera
from student_jax import preprocess

PROFILE = contract.D455.scaled(0.25)
CONFIG = StudentConfig()
RESIZED = replace(
    CONFIG,
    picture=replace(CONFIG.picture, height_px=56, width_px=72),
)
TABLE = preprocess.table_depth(PROFILE, CONFIG.picture.max_depth_m)


def frames_of(depth: np.ndarray) -> np.ndarray:
    return np.broadcast_to(depth, (1, contract.DEPTH_FRAMES, *depth.shape)).astype(np.float32).copy()


def test_table_depth_is_the_distance_along_the_axis_to_z_equals_zero():
    camera = nominal_camera(PROFILE)
    row, column = 100, 40
    ray = np.array(
        [
            (column + 0.5 - PROFILE.cx_px) / PROFILE.fx_px,
            (row + 0.5 - PROFILE.cy_px) / PROFILE.fy_px,
            1.0,
            0.0,
        ]
    )
    point = camera.T_world_cam @ (ray * TABLE[row, column] + [0, 0, 0, 1])
    np.testing.assert_allclose(point[2], 0.0, atol=1e-6)


def test_cells_of_a_resized_window_lie_as_far_apart_as_what_they_see():
    """10 of 20 pixels in cells of two, each four pixels wide; 8 taken as they are, from the fourth on."""
    window = preprocess.ResizeWindow(preprocess.plan_axis(20, 10), preprocess.Axis(3, 8, None))
    rows, columns = preprocess.pixel_coordinates(window, 2)
    np.testing.assert_allclose(rows, [2, 6, 10, 14, 18])
    np.testing.assert_allclose(columns, [4, 6, 8, 10])


def test_empty_table_has_no_relief_and_a_box_has_its_own():
    depth = TABLE.copy()
    depth[80:90, 150:160] -= 0.05
    depth[80:90, 161:170] -= 0.6
    picture = preprocess.prepare_depth(frames_of(depth), None, PROFILE, CONFIG)
    assert picture.shape == (1, 112, 144, 6)
    # the centred crop starts at (34, 87); 112 of 112 rows and 144 of 145 columns are used
    relief = np.asarray(picture[0, :, :, 4])
    np.testing.assert_allclose(relief[80 - 34 : 90 - 34, 150 - 87 : 160 - 87], 0.5, atol=1e-5)
    np.testing.assert_allclose(relief[80 - 34 : 90 - 34, 161 - 87 : 170 - 87], preprocess.RELIEF_MAX)
    np.testing.assert_allclose(relief[:40], 0.0, atol=1e-5)
    assert np.all(np.asarray(picture[0, :, :, 5]) == 1.0)


@pytest.mark.parametrize("config", [CONFIG, RESIZED])
def test_invalid_readings_change_nothing_but_their_own_pixels(config):
    depth = TABLE - 0.03
    spoilt = depth.copy()
    for row, value in enumerate([np.nan, np.inf, -np.inf, -1.0, 0.0, 9.0, 0.05]):
        spoilt[60 + 4 * row, 100:200] = value
    clean = np.asarray(preprocess.prepare_depth(frames_of(depth), None, PROFILE, config))
    dirty = np.asarray(preprocess.prepare_depth(frames_of(spoilt), None, PROFILE, config))
    valid = dirty[..., 1] == 1.0
    assert np.isfinite(dirty).all()
    if config is CONFIG:
        assert int((~valid).sum()) == 7 * 100
    np.testing.assert_allclose(dirty[..., 0][valid], clean[..., 0][valid], atol=2e-5)
    assert np.all(dirty[..., 0][~valid] == 0.0)


FILLED = replace(CONFIG, picture=replace(CONFIG.picture, fill_holes=True))


def test_holes_are_filled_from_around_them_and_nothing_else_changes():
    depth = TABLE.copy()
    depth[60:120, 120:200] -= 0.05  # a plateau of relief 0.5
    spoilt = depth.copy()
    spoilt[80:100, 150:170] = 0.0
    spoilt[:, :100] = np.nan
    whole = np.asarray(preprocess.prepare_depth(frames_of(depth), None, PROFILE, FILLED))
    np.testing.assert_array_equal(whole, preprocess.prepare_depth(frames_of(depth), None, PROFILE, CONFIG))
    made = np.asarray(preprocess.prepare_depth(frames_of(spoilt), None, PROFILE, FILLED))
    given = np.asarray(preprocess.prepare_depth(frames_of(spoilt), None, PROFILE, CONFIG))
    assert np.all(made[..., 1::2] == 1.0)
    has = given[..., 1] == 1.0
    np.testing.assert_array_equal(made[..., 0][has], given[..., 0][has])
    # Amid the plateau nothing but the plateau is near; left of column 100 it is as far as the table.
    np.testing.assert_allclose(made[0, 80 - 34 : 100 - 34, 150 - 87 : 170 - 87, 0], 0.5, atol=1e-5)
    left = made[0, :, : 100 - 87, 0]
    assert np.isfinite(left).all() and 0.0 <= left.min() and left.max() <= 0.5 + 1e-5
    nothing = np.zeros_like(TABLE)
    assert not np.asarray(preprocess.prepare_depth(frames_of(nothing), None, PROFILE, FILLED)).any()


def test_resized_pixel_with_more_hole_than_surface_is_invalid():
    depth = TABLE.copy()
    depth[:, 150:] = 0.0
    picture = np.asarray(preprocess.prepare_depth(frames_of(depth), None, PROFILE, RESIZED))
    border = (150 - 87) * 72 / 145  # where the edge falls among the 72 columns
    assert np.all(picture[0, :, : int(border), 1] == 1.0)
    assert np.all(picture[0, :, int(border) + 1 :, 1] == 0.0)


def test_resize_matrix_equals_jax_image_resize():
    image = np.random.default_rng(0).normal(size=(45, 3)).astype(np.float32)
    ours = preprocess.resize_matrix(45, 28) @ image
    theirs = jax.image.resize(jnp.asarray(image), (28, 3), "linear", antialias=True)
    np.testing.assert_allclose(ours, theirs, atol=1e-5)


@pytest.mark.parametrize("config", [CONFIG, RESIZED])
def test_a_crop_at_the_centre_equals_the_default(config):
    depth = frames_of(TABLE - np.random.default_rng(1).uniform(0, 0.3, TABLE.shape).astype(np.float32))
    centre = jnp.array([PROFILE.crop_origin_px])
    static = preprocess.prepare_depth(depth, None, PROFILE, config)
    dynamic = preprocess.prepare_depth(depth, centre, PROFILE, config)
    np.testing.assert_allclose(static, dynamic, atol=1e-6)


@pytest.mark.parametrize("config", [CONFIG, RESIZED])
def test_the_part_that_is_seen_makes_the_picture_of_the_whole_frames(config):
    rng = np.random.default_rng(2)
    depth = (TABLE - rng.uniform(0, 0.3, (2, 3, *TABLE.shape))).astype(np.float32)
    crop, window = jnp.array([[31, 80], [999, -5]]), preprocess.plan_window(PROFILE, config)
    first_px = preprocess.first_pixel(crop, PROFILE, config)
    part = preprocess.cut(depth, first_px, (window.rows.length, window.columns.length))
    made, whole = (preprocess.prepare_depth(x, crop, PROFILE, config) for x in (part, depth))
    np.testing.assert_allclose(made, whole, atol=1e-6)


def test_the_empty_table_is_flat_in_every_crop_and_crops_stay_inside():
    depth = np.repeat(frames_of(TABLE), 3, axis=0)
    crop = jnp.array([[0, 0], [68, 175], [999, -5]])
    picture = preprocess.prepare_depth(depth, crop, PROFILE, CONFIG)
    np.testing.assert_allclose(picture[..., ::2], 0.0, atol=1e-5)
    assert np.asarray(preprocess.clip_crop(crop, PROFILE)).tolist() == [[0, 0], [68, 175], [68, 0]]


def test_wrong_frames_and_channels_are_refused_by_name():
    with pytest.raises(UserError, match=r"\(1, 3, 90, 160\); expected \(B, 3, 180, 320\)"):
        preprocess.prepare_depth(jnp.zeros((1, 3, 90, 160)), None, PROFILE, CONFIG)
    with pytest.raises(UserError, match="Did you mean 'relief'"):
        replace(CONFIG.picture, channels=("releif",))


def test_millimetres_are_refused():
    with pytest.raises(UserError, match="uint16; expected metres"):
        preprocess.prepare_depth(frames_of(TABLE).astype(np.uint16), None, PROFILE, CONFIG)
