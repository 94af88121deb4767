"""Large planes of a depth picture, and the generator's surfaces made of them."""

import cv2
import numpy as np
import pytest

from ddg_jax.geometry import surfaces
from ddg_jax.prior import make_prior
from ddgrasp.config import FILTERED, PLANES, DDGConfig, DDGDepthConfig, PriorConfig
from ddgrasp.config.ddg import Surface
from ddgrasp.depth import inverse_depth
from sensors.statistics.planes import on_planes

HEIGHT, WIDTH = 180, 320
BUMP_PER_M, BUMP_PX = 0.004, 6.0
"""Standard deviation and width of the bumps that a stereo camera sees in a table."""
V, U = np.mgrid[:HEIGHT, :WIDTH]
BOX = (abs(U - 220) < 14) & (abs(V - 90) < 14)


@pytest.fixture(scope="module")
def table() -> np.ndarray:
    """(H, W) inverse depth of a table with a 4 cm high box on it."""
    return (0.8 + 0.003 * V + 0.0002 * U + 0.05 * BOX).astype(np.float32)


@pytest.fixture(scope="module")
def bumps() -> np.ndarray:
    """(H, W) what the camera adds to it."""
    noise = cv2.GaussianBlur(np.random.default_rng(0).standard_normal((HEIGHT, WIDTH)), (0, 0), BUMP_PX)
    return (BUMP_PER_M / noise.std() * noise).astype(np.float32)


def test_a_table_is_flat_again_and_what_stands_on_it_stays(table, bumps):
    made = on_planes(table + bumps)
    far = (abs(U - 220) > 30) | (abs(V - 90) > 30)
    inside = far & (U > 16) & (U < WIDTH - 16) & (V > 16) & (V < HEIGHT - 16)
    assert np.percentile(np.abs(made - table)[inside], 90) < 0.3 * BUMP_PER_M
    np.testing.assert_array_equal(made[BOX], (table + bumps)[BOX])


def test_what_has_no_large_plane_stays():
    ball = (1.0 + 0.5 * np.sqrt(np.maximum(1 - ((U - 160) / 170) ** 2 - ((V - 90) / 100) ** 2, 0))).astype(
        np.float32
    )
    assert np.mean(on_planes(ball) != ball) < 0.2


def test_a_picture_too_small_for_planes_stays():
    tiny = np.array([[0.5, 0.5], [0.5, 2.0]], np.float32)
    np.testing.assert_array_equal(on_planes(tiny), tiny)


def test_two_planes_each_become_flat(bumps):
    wall = np.where(V < 80, 0.45, 0.45 + 0.004 * (V - 80)).astype(np.float32)
    made = on_planes(wall + bumps)
    for inside in ((V > 12) & (V < 60), (V > 100) & (V < HEIGHT - 12)):
        assert np.median(np.abs(made - wall)[inside & (U > 12) & (U < WIDTH - 12)]) < 0.3 * BUMP_PER_M


def test_the_generator_is_taught_the_bumps_and_its_prior_does_not_show_them(table, bumps):
    depth_m = (1 / (table + bumps))[None]
    seen = {
        kind: np.corrcoef(
            (inverse_depth(depth_m) - inverse_depth(surfaces(depth_m, kind))).ravel(), bumps.ravel()
        )[0, 1]
        for kind in (FILTERED, PLANES)
    }
    assert seen[FILTERED] < 0.5 and seen[PLANES] > 0.8

    def prior(kind: Surface, inverse: np.ndarray, recorded: bool) -> np.ndarray:
        config = DDGConfig(
            depth=DDGDepthConfig(surface=kind),
            prior=PriorConfig(source="metric_inverse_depth", decoy_holes=0.0),
        )
        made, maps = make_prior(config), (1 / inverse)[None]
        return (
            made.from_recording(maps, None, np.random.default_rng(0))
            if recorded
            else made.from_sim(maps, None)
        )

    shown = {
        kind: np.abs(prior(kind, table + bumps, True) - prior(kind, table, False)).mean()
        for kind in (FILTERED, PLANES)
    }
    assert shown[PLANES] < 0.4 * shown[FILTERED]
