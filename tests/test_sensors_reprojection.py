"""A picture seen from beside: disparity, occlusion, what is uncovered."""

import numpy as np
import pytest

from ddgrasp.contract import D455
from mjx_envs.camera import Camera
from sensors.models.reprojection import from_beside

PROFILE = D455.scaled(0.125)
SIZE = (PROFILE.height_px, PROFILE.width_px)
GREY = np.full((*SIZE, 3), 0.5, np.float32)


def beside(offset_m: float) -> Camera:
    T = np.eye(4)
    T[0, 3] = offset_m
    return Camera.of(PROFILE, T)


def test_the_same_place_gives_the_same_picture():
    depth = np.random.default_rng(0).uniform(0.5, 2.0, SIZE).astype(np.float32)
    depth[10:20, 30:50] = 0
    seen = from_beside(depth, GREY, PROFILE, np.eye(4))(beside(0.0))
    np.testing.assert_allclose(seen.depth_m, depth, rtol=1e-3)
    np.testing.assert_array_equal(seen.segmentation, np.where(depth > 0, 0, -1))


def test_near_surfaces_move_by_their_disparity_and_uncover_the_background():
    depth = np.full(SIZE, 2.0, np.float32)
    depth[30:60, 80:100] = 0.5
    rgb = GREY.copy()
    rgb[30:60, 80:100] = 1.0
    step_m = 4 * 0.5 / PROFILE.fx_px  # the square moves 4 px to the left, the wall 1
    seen = from_beside(depth, rgb, PROFILE, np.eye(4))(beside(step_m))
    np.testing.assert_array_equal(np.flatnonzero(seen.depth_m[45] < 1), np.arange(76, 96))
    np.testing.assert_allclose(seen.depth_m[45, 96:], 2.0, rtol=1e-3)
    assert (seen.rgb[45, 76:96] == 1.0).all() and (seen.rgb[45, 96:] == 0.5).all()


def test_a_tilted_wall_keeps_its_plane_and_normal():
    rays = (np.arange(SIZE[1]) + 0.5 - PROFILE.cx_px) / PROFILE.fx_px
    # n . X = 1 m with n = (0.6, 0, 0.8): z = 1 / (0.6 x + 0.8).
    depth = np.broadcast_to(1.0 / (0.6 * rays + 0.8), SIZE).astype(np.float32)
    seen = from_beside(depth, GREY, PROFILE, np.eye(4))(beside(0.02))
    expected = (1.0 - 0.6 * 0.02) / (0.6 * rays + 0.8)
    np.testing.assert_allclose(seen.depth_m[40, 10:-10], expected[10:-10], rtol=2e-3)
    np.testing.assert_allclose(seen.normal_w[40, 80], [-0.6, 0.0, -0.8], atol=1e-2)
    assert seen.depth_m[40, 80] == pytest.approx(expected[80], rel=2e-3)
