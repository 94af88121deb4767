"""Hole-level measures on scenes whose answer is known by hand."""

import numpy as np
import pytest

from evaluation.depth_score import holes


def sums(depth_m: np.ndarray, clean_m: np.ndarray, focal_px: float = 100.0) -> holes.Sums:
    places = [holes.geometry(frame, focal_px) for frame in clean_m]
    return holes.episode_sums(depth_m.astype(np.float32), clean_m.astype(np.float32), places)


def test_edge_distance_counts_pixels_from_a_step():
    clean = np.full((9, 20), 1.0, np.float32)
    clean[:, 10:] = 2.0
    distance = holes.edge_distance_px(clean)
    # both pixels of the step are on it
    np.testing.assert_allclose(distance[4, [7, 8, 9, 10, 11, 12]], [2, 1, 0, 0, 1, 2], atol=0.02)
    assert holes.edge_distance_px(np.ones((9, 20), np.float32)).min() > 20


@pytest.mark.parametrize("tilt_deg", [0.0, 30.0, 60.0])
def test_incidence_of_a_tilted_plane_on_the_axis(tilt_deg):
    focal, size = 200.0, 41
    x = (np.arange(size) + 0.5 - size / 2) / focal
    # plane z = 1 + tan(tilt) x z in rays x / z: normal tilted by `tilt` against the axis
    clean = np.broadcast_to(1 / (1 - np.tan(np.radians(tilt_deg)) * x), (size, size)).astype(np.float32)
    assert holes.incidence_deg(clean, focal)[size // 2, size // 2] == pytest.approx(tilt_deg, abs=0.1)


def test_counts_and_figures_by_hand():
    clean = np.full((2, 6, 10), 0.95, np.float32)
    clean[:, 0, 0] = 0.0  # nothing there: not counted where surfaces are
    depth = clean.copy()
    depth[0, 2, 2:5] = 0  # a hole of three pixels
    depth[1, 2, 2:4] = 0  # of which two stay
    depth[1, 5, 9] = 0.95 + 0.06  # an outlier, 60 mm too far
    total = sums(depth, clean)
    figures = holes.figures(total)
    assert figures["invalid_share"] == pytest.approx((4 + 3) / 120)
    assert figures["components_per_frame"] == 2  # the pixel where nothing is counts as a hole
    assert figures["flicker"] == pytest.approx(1 / 60)
    assert figures["persistence"] == pytest.approx(3 / 4)
    valid = 118 - 5
    assert figures["bias_mm"] == pytest.approx(60 / valid, rel=1e-4)
    assert figures["rmse_mm"] == pytest.approx(60 / np.sqrt(valid), rel=1e-4)
    assert figures["outlier_share"] == pytest.approx(1 / valid)
    assert np.isnan(figures["repeat_iou"])
    curves = holes.curves(total)
    at = np.searchsorted(holes.DEPTH_EDGES_M, 0.95) - 1
    assert curves["depth_m"][at] == pytest.approx(5 / 118)
    assert np.isnan(curves["depth_m"][0])
    np.testing.assert_array_equal(curves["size_px"][:3], [1.0, 1.0, 0.0])  # 1 px twice, 2-3 px twice, in two


def test_episodes_add_up_and_gaps_are_zero_against_themselves():
    rng = np.random.default_rng(0)
    clean = np.full((3, 8, 8), 0.8, np.float32)
    noisy = [np.where(rng.random(clean.shape) < share, 0, clean) for share in (0.1, 0.3)]
    parts = [sums(depth, clean) for depth in noisy]
    both = holes.added(parts)
    assert both["holes"] == sum(int((depth == 0).sum()) for depth in noisy)
    assert all(value == 0 for value in holes.gaps(both, both).values())
    gap = holes.gaps(parts[0], parts[1])["gap_depth_m"]
    assert gap == pytest.approx(abs((noisy[0] == 0).mean() - (noisy[1] == 0).mean()))


def test_repeats_by_hand():
    depth = np.full((3, 4, 4), 1.0, np.float32)
    depth[0, 0, :2] = depth[1, 0, :2] = depth[2, 0, 1:3] = 0
    depth[:, 3, 3] = (1.0, 1.002, 1.004)
    figures = holes.figures(holes.added([sums(depth, np.ones_like(depth)), holes.repeat_sums(depth)]))
    assert figures["repeat_iou"] == pytest.approx((1 + 1 / 3 + 1 / 3) / 3)
    assert figures["repeat_flicker"] == pytest.approx(2 / 32)
    assert figures["repeat_deviation_mm"] == pytest.approx(2 / 13, rel=1e-3)


def test_readings_where_nothing_is_are_not_off_from_anything():
    clean = np.full((1, 6, 10), 0.9, np.float32)
    clean[0, 0] = 0.0
    figures = holes.figures(sums(np.full_like(clean, 0.9), clean))
    assert (figures["rmse_mm"], figures["outlier_share"]) == (0.0, 0.0)


def test_a_gap_weighs_what_the_real_side_shows():
    """A tenth of the real pixels is far, where the simulated side, most of which is, loses all."""
    real, sim = (np.full((1, 10, 10), 0.55, np.float32) for _ in range(2))
    real[0, 0], sim[0, 1:] = 1.7, 1.7
    gaps = holes.gaps(sums(np.where(sim > 1, 0, sim), sim), sums(real, real))
    assert gaps["gap_depth_m"] == pytest.approx(0.1)
