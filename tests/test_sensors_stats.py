"""Hole and noise statistics on hand-made frames; procedural noise by its rates."""

import numpy as np
import pytest

from ddgrasp.config import WorldConfig
from sensors import stats
from sensors.procedural import ProceduralConfig, corrupt


def test_holes_are_counted_with_diagonal_neighbours():
    frame = np.full((6, 8), 700, np.uint16)
    frame[0, 0] = frame[1, 1] = 0  # one diagonal region
    frame[4, 4:7] = 0
    assert sorted(stats.hole_sizes_px(frame)) == [2, 3]
    assert sorted(stats.hole_sizes_px(frame, connectivity=4)) == [1, 1, 3]


def test_measure_by_hand():
    frames = np.full((2, 10, 20), 750, np.uint16)
    frames[:, :, :3] = 0
    frames[1, 5, 10] = 0
    frames[1, :, 15] = 754
    result = stats.measure(frames)
    assert result.invalid_fraction == pytest.approx((30 + 31) / 400)
    assert result.hole_components == 1.5
    assert result.left_band_px == 3
    assert result.flicker_fraction == pytest.approx(1 / 200)
    assert result.temporal_deviation_mm == 0.0
    assert stats.temporal_deviation_mm(frames[:, :, 15:16]) == pytest.approx(np.sqrt(8), rel=1e-6)
    assert np.isnan(stats.temporal_deviation_mm(frames, range_mm=2000))


def test_decimation_is_the_median_of_valid_pixels():
    frame = np.array([[0, 10, 0, 0], [30, 20, 0, 0], [1, 2, 7, 0], [3, 4, 0, 9]], np.uint16)
    np.testing.assert_array_equal(stats.decimated(frame, 2), [[20, 0], [2, 7]])


def test_procedural_rates_and_disparity_noise():
    profile = WorldConfig().profile
    clean = np.full((8, 180, 320), 0.8, np.float32)
    clean[:, :, :40] = 0
    config = ProceduralConfig(dropout=0.02, random_value=0.01, sticks=0)
    noisy = corrupt(clean, np.random.default_rng(0), profile, config)
    assert noisy.shape == clean.shape and noisy.dtype == np.float32
    body = noisy[:, :, 60:]
    assert np.mean(body == 0) == pytest.approx(0.02, abs=0.001)
    near = body[np.abs(body - 0.8) < 0.03]
    expected_m = config.disparity_px * 0.8**2 / (profile.fx_px * profile.baseline_m)
    # Cubic interpolation of unit noise has a variance somewhat below one.
    assert 0.6 * expected_m < near.std() < 1.1 * expected_m
    np.testing.assert_array_equal(noisy, corrupt(clean, np.random.default_rng(0), profile, config))


def test_procedural_without_noise_is_the_identity():
    profile = WorldConfig().profile
    clean = np.random.default_rng(0).uniform(0.4, 1.5, (2, 90, 160)).astype(np.float32)
    off = ProceduralConfig(shift_px=0, disparity_px=0, dropout=0, random_value=0, sticks=0)
    np.testing.assert_allclose(corrupt(clean, np.random.default_rng(0), profile, off), clean, rtol=1e-5)
