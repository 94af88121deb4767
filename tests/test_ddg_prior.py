"""The built-in prior and the loading of recordings, by value on small pictures."""

import numpy as np
import pytest

from ddg_jax import data, prior
from ddgrasp.config import DDGConfig
from ddgrasp.errors import UserError
from ddgrasp.progress import Progress
from sensors.holes import fill_from_background
from sensors.recordings import RecordingWriter


def test_holes_take_the_farther_neighbour_of_their_row():
    near, far = 2.0, 1.0
    inverse = np.full((9, 12), far, np.float32)
    inverse[:, 6:] = near
    truth = inverse.copy()
    inverse[:, 4:6] = 0  # the shadow left of the near surface
    inverse[:, 0] = 0  # left band
    np.testing.assert_array_equal(fill_from_background(inverse), truth)


def test_rows_without_a_reading_take_the_nearest_row():
    inverse = np.ones((12, 10), np.float32)
    inverse[8:] = 3.0
    inverse[:3] = 0
    filled = fill_from_background(inverse)
    assert (filled[:3] == 1).all() and (filled[8:] == 3).all()
    assert (fill_from_background(np.zeros((4, 4), np.float32)) == 0).all()


def test_prior_ignores_affine_changes_of_inverse_depth():
    inverse = np.random.default_rng(0).uniform(0.5, 2, (2, 20, 30)).astype(np.float32)
    c = prior.normalise(inverse)
    np.testing.assert_allclose(prior.normalise(3 * inverse + 0.7), c, atol=1e-4)
    assert abs(np.median(c)) < 0.02 and abs(np.mean(np.abs(c)) - 0.5) < 0.02


def test_recording_and_simulation_of_one_scene_give_the_same_prior():
    clean = np.full((3, 24, 32), 1.5, np.float32)
    clean[:, 8:16, 12:22] = 0.8
    noisy = clean.copy()
    noisy[:, 8:16, 9:12] = 0
    made = prior.InverseDepthPrior(blur_px=1.0)
    rng = np.random.default_rng(0)
    np.testing.assert_allclose(made.from_recording(noisy, None, rng), made.from_sim(clean), atol=1e-5)


def test_temporal_smoothing_averages_one_surface_and_keeps_moving_edges():
    inverse = np.ones((3, 1, 2), np.float32)
    inverse[:, 0, 0] = (1.0, 1.03, 1.0)
    inverse[:, 0, 1] = (1.0, 2.0, 1.0)
    smooth = prior.smooth_in_time(inverse)
    np.testing.assert_allclose(smooth[1, 0], [1.01, 2.0], atol=1e-6)


def test_resizing_never_mixes_holes_into_surfaces():
    image = np.where(np.indices((48, 64)).sum(0) % 3 == 0, 0, 1000).astype(np.uint16)
    small = data.resize_nearest(image, (18, 32))
    assert small.shape == (18, 32) and set(np.unique(small)) == {0, 1000}
    ramp = np.tile(np.arange(64), (36, 1))
    assert data.resize_nearest(ramp, (18, 32))[0].tolist() == list(range(1, 64, 2))


@pytest.fixture
def recordings(tmp_path):
    rng = np.random.default_rng(0)
    for name in ("a", "b"):
        with RecordingWriter(tmp_path / name, {}) as writer:
            for _ in range(3):
                depth = rng.integers(700, 900, (36, 64)).astype(np.uint16)
                depth[:, :5] = 0
                writer.add(np.zeros((36, 64, 3), np.uint8), depth)
    return tmp_path


def test_frames_and_batches(recordings):
    config = DDGConfig(height_px=18, width_px=32, batch_size=4, holdout_fraction=0.34)
    frames = data.load_frames(recordings, config, prior.make_prior(config), 0, Progress(quiet=True))
    assert len(frames) == 6 and frames.recording.tolist() == [0, 0, 0, 1, 1, 1]
    np.testing.assert_allclose(np.mean(frames.depth_m == 0), 2 / 32)
    training, held = frames.split(config.holdout_fraction)
    assert (len(training), len(held)) == (4, 2)
    one, again, other = (data.make_batch(training, config, 7, step) for step in (3, 3, 4))
    np.testing.assert_array_equal(one.x_0, again.x_0)
    assert not np.array_equal(one.c, other.c)
    assert (one.x_0[:, :, 0] == -1).all() and one.x_0[:, :, 3:].min() > 0
    with pytest.raises(UserError, match="record more"):
        frames.part(slice(0, 1)).split(0.1)
    with pytest.raises(UserError, match="inverse_depth"):
        prior.make_prior(DDGConfig(prior="inverse_dept"))
