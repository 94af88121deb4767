"""The geometry that stands in for simulation in scores of real cameras."""

import numpy as np
import pytest

from evaluation.stand_in import stand_in

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
    made = 1 / stand_in(np.divide(1, recorded, out=np.zeros_like(recorded), where=known)[None])[0]
    assert np.isfinite(made).all() and (made > 0).all()
    assert np.abs(recorded - truth)[known].mean() > 0.7 * NOISE_PER_M
    assert np.median(np.abs(made - truth)) < 0.25 * NOISE_PER_M


def test_edges_stay_sharp(scene):
    """Hardly a pixel between the surfaces (the box's corners, which a median rounds)."""
    truth, recorded, box = scene
    made = 1 / stand_in(np.divide(1, recorded, out=np.zeros_like(recorded), where=recorded > 0)[None])[0]
    for surface in (box, ~box):
        assert np.mean(np.abs(made - truth)[surface] > 0.1) < 0.03


def test_frames_are_made_one_by_one(scene):
    _, recorded, _ = scene
    depth_m = np.divide(1, recorded, out=np.zeros_like(recorded), where=recorded > 0)
    both = stand_in(np.stack([depth_m, depth_m[::-1]]))
    np.testing.assert_array_equal(both[0], stand_in(depth_m[None])[0])


def test_a_frame_without_any_depth_stays_empty():
    assert not stand_in(np.zeros((1, HEIGHT, WIDTH), np.float32)).any()
