"""Recorded depth made whole and piecewise smooth."""

import numpy as np
import pytest

from ddg_jax.geometry import surfaces
from ddg_jax.piecewise import piecewise_smooth
from ddg_jax.prior import make_prior
from ddgrasp.config import PIECEWISE, DDGConfig, DDGDepthConfig, PriorConfig
from ddgrasp.depth import inverse_depth
from ddgrasp.errors import UserError

HEIGHT, WIDTH = 60, 80
NOISE_PER_M = 0.004


@pytest.fixture(scope="module")
def scene() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(inverse depth of a tilted floor with a box before it, the same as recorded, where the box is)."""
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    box = (abs(u - 45) < 12) & (abs(v - 30) < 12)
    truth = np.where(box, 1.4, 0.4 + 0.008 * v + 0.001 * u).astype(np.float32)
    rng = np.random.default_rng(0)
    noisy = truth + NOISE_PER_M * rng.standard_normal(truth.shape).astype(np.float32)
    shadow = ~box & (u > 26) & (u <= 33) & (abs(v - 30) < 12)
    lost = shadow | (rng.random(truth.shape) < 0.05)
    return truth, np.where(lost, 0, noisy), box


def test_every_pixel_has_depth_and_noise_is_gone(scene):
    truth, recorded, _ = scene
    known = recorded > 0
    made = piecewise_smooth(recorded)
    assert np.isfinite(made).all() and (made > 0).all()
    assert np.abs(recorded - truth)[known].mean() > 0.7 * NOISE_PER_M
    assert np.median(np.abs(made - truth)) < 0.25 * NOISE_PER_M


def test_edges_stay_sharp(scene):
    """Hardly a pixel between the surfaces (the box's corners, which a median rounds)."""
    truth, recorded, box = scene
    made = piecewise_smooth(recorded)
    for surface in (box, ~box):
        assert np.mean(np.abs(made - truth)[surface] > 0.1) < 0.03


def test_a_frame_without_any_depth_stays_empty():
    assert not piecewise_smooth(np.zeros((HEIGHT, WIDTH), np.float32)).any()


def test_prior_and_surface_of_the_generator_take_it(scene):
    """The prior of a recording is that of simulation, but for the camera's noise."""
    truth, recorded, _ = scene
    depth_m = inverse_depth(recorded[None])
    made = make_prior(
        DDGConfig(
            prior=PriorConfig(source="metric_inverse_depth", decoy_holes=0.0),
            depth=DDGDepthConfig(surface=PIECEWISE),
        )
    )
    np.testing.assert_allclose(surfaces(depth_m, PIECEWISE)[0], 1 / piecewise_smooth(recorded), rtol=1e-3)
    c = made.from_recording(depth_m, None, np.random.default_rng(0))
    assert np.median(np.abs(c - made.from_sim(inverse_depth(truth[None]), None))) < 2 * 0.25 * NOISE_PER_M
    with pytest.raises(UserError, match="Unknown ddg.depth.surface 'piecewice'. Did you mean 'piecewise'"):
        make_prior(DDGConfig(depth=DDGDepthConfig(surface="piecewice")))


def test_another_name_of_a_surface_is_refused():
    with pytest.raises(UserError, match="Unknown surface 'plane'. Did you mean 'planes'"):
        surfaces(np.ones((1, 8, 8), np.float32), "plane")
