"""Hole and noise statistics on hand-made frames."""

import numpy as np
import pytest

from sensors.statistics import stats


def test_holes_are_counted_with_diagonal_neighbours():
    frame = np.full((6, 8), 700, np.uint16)
    frame[0, 0] = frame[1, 1] = 0  # one diagonal region
    frame[4, 4:7] = 0
    assert sorted(stats.hole_sizes_px(frame)) == [2, 3]


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
