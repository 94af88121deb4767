"""Curves of a depth stream's defects, on frames whose answer is known by hand."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest

from ddgrasp.config import RecordConfig
from ddgrasp.contract import D455
from ddgrasp.errors import UserError
from ddgrasp.progress import Progress
from evaluation import camera_comparison as compare
from recording_support import write_depth
from rig.scenes import StandingScene, standing_scenes
from sensors.statistics import curves, figures
from sensors.statistics.curves import Stream

FX_PX, FB_PX_M = 170.0, 16.0
SIZE = (90, 160)


def stream(depth_mm: np.ndarray, static: bool = True) -> Stream:
    runs = (slice(0, len(depth_mm)),) if static else ()
    return Stream(depth_mm.astype(np.uint16), FX_PX, FB_PX_M, runs)


def plane_mm(tilt_deg: float, range_m: float = 1.0) -> np.ndarray:
    """(H, W) depth of a plane through (0, 0, range_m), turned about the picture's x axis."""
    v = (np.arange(SIZE[0]) + 0.5 - SIZE[0] / 2) / FX_PX
    # n = (0, sin, cos): z (v sin + cos) = range cos.
    t = math.radians(tilt_deg)
    z = range_m * math.cos(t) / (v * math.sin(t) + math.cos(t))
    return np.broadcast_to(np.rint(1000 * z)[:, None], SIZE)


@pytest.mark.parametrize("tilt_deg", [0.0, 30.0, 60.0])
def test_incidence_angle_of_a_plane(tilt_deg):
    s = curves.surface(plane_mm(tilt_deg).astype(np.uint16), FX_PX, FB_PX_M)
    # On the optical axis the ray is the z axis: the angle is the tilt.
    assert np.median(s.angle_deg[43:47, 78:82]) == pytest.approx(tilt_deg, abs=3.0)


def test_edges_shadow_and_left_band():
    depth = np.full(SIZE, 1600, np.uint16)  # disparity 10
    depth[30:60, 80:120] = 800  # disparity 20: hides 10 columns left of it
    s = curves.surface(depth, FX_PX, FB_PX_M)
    assert not s.seen[45, :12].any() and s.seen[45, 13:60].all()
    # Column 70 meets the square's first column exactly and is not behind it.
    np.testing.assert_array_equal(np.flatnonzero(s.shadow[45]), np.arange(71, 80))
    assert not s.shadow[10].any() and not s.seen[45, 71:80].any()
    assert s.edge_px[45, 79] == 0.0 and s.edge_px[10, 20] > 40


def test_invalid_rates_by_hand():
    depth = np.full((1, *SIZE), 1000)
    depth[0, 40:50, 100:120] = 0  # filled at 1 m: no edge, 200 pixels lost
    made, shadow = curves.by_surface(stream(depth, static=False))
    bins = made["depth_m"]
    at = bins.edges.index(0.9)
    assert bins.value[at] * bins.count[at] == pytest.approx(200)
    assert bins.count[at] == sum(bins.count) == (SIZE[0] - 4) * (SIZE[1] - 2 - 19)
    assert math.isnan(shadow) and math.isnan(bins.value[0])
    # Facing plane: every angle is that of the ray alone.
    angle = made["angle_deg"]
    assert sum(angle.count[2:]) == 0
    assert made["spatial_px"].value[at] == pytest.approx(0.0, abs=1e-3)


def test_spectrum_counts_holes_per_ten_thousand_pixels():
    depth = np.full((2, 100, 100), 1000)
    depth[0, 10, 10] = depth[0, 20, 20:23] = 0
    spectrum = curves.hole_spectrum(stream(depth))
    assert spectrum.value[:3] == (0.5, 0.5, 0.0)


def test_noise_over_time_in_pixels_of_disparity():
    rng = np.random.default_rng(0)
    disparity = 20.0 + 0.1 * rng.standard_normal((12, *SIZE))
    noisy = stream(1000 * FB_PX_M / disparity)
    curve = curves.temporal_deviation_px(noisy)
    assert curve.value[curve.edges.index(0.7)] == pytest.approx(0.1, rel=0.1)
    local = curves.by_surface(noisy)[0]["spatial_px"]
    assert local.value[local.edges.index(0.7)] == pytest.approx(0.1, rel=0.1)
    assert all(math.isnan(v) for v in curves.temporal_deviation_px(stream(noisy.depth_mm, False)).value)


def test_standing_frames_are_found():
    rng = np.random.default_rng(0)
    moving = np.broadcast_to(1000.0 + 40 * np.arange(6)[:, None, None], (6, *SIZE))
    depth = np.concatenate([np.full((6, *SIZE), 1000.0), moving])
    depth = 1000 * FB_PX_M / (1000 * FB_PX_M / depth + 0.05 * rng.standard_normal(depth.shape))
    assert curves.static_runs(depth.astype(np.uint16), FB_PX_M) == (slice(0, 7),)


def test_a_frame_that_comes_again_stands_for_no_still_camera():
    rng = np.random.default_rng(0)
    still = 1000 * FB_PX_M / (16.0 + 0.05 * rng.standard_normal((16, *SIZE)))
    again = np.concatenate([still[:8], np.repeat(still[8:9], 6, axis=0), still[9:]])
    assert curves.static_runs(again.astype(np.uint16), FB_PX_M) == (slice(0, 9), slice(13, 21))


def test_a_blind_frame_leaves_the_standing_ones_before_and_after_it():
    rng = np.random.default_rng(0)
    still = 1000 * FB_PX_M / (16.0 + 0.05 * rng.standard_normal((13, *SIZE)))
    still[6] = 0
    runs = curves.static_runs(still.astype(np.uint16), FB_PX_M)
    assert runs == (slice(0, 6), slice(7, 13))
    assert curves.static_runs(np.zeros((13, *SIZE), np.uint16), FB_PX_M) == ()


def test_grid_of_disparities_is_recognised_although_fb_is_a_little_wrong():
    steps = np.arange(100, 200)
    on_grid = np.rint(1000 * 32 * FB_PX_M / steps).astype(np.uint16)
    assert curves.grid_share(on_grid, FB_PX_M * 1.0002, 32) > 0.95
    assert curves.grid_share(np.arange(3000, 5000).astype(np.uint16), FB_PX_M, 32) < 0.4
    assert math.isnan(curves.grid_share(np.array([500], np.uint16), FB_PX_M, 32))


def test_figures_survive_json():
    rng = np.random.default_rng(1)
    depth = np.where(rng.random((3, *SIZE)) < 0.05, 0, 900 + rng.integers(0, 9, (3, *SIZE)))
    measured = figures.measure("test", stream(depth), 32)
    again = figures.from_json(json.loads(json.dumps(figures.to_json(measured))))
    assert again.scalars["invalid_fraction"] == pytest.approx(0.05, abs=0.005)
    assert math.isnan(again.curves["depth_m"].value[0])
    for name in figures.CURVES:
        np.testing.assert_allclose(again.curves[name].value, measured.curves[name].value, rtol=1e-3)
    assert set(measured.scalars) == set(figures.SCALARS) and set(measured.curves) == set(figures.CURVES)


def test_published_figures_name_what_is_compared():
    d455, native, decimated = figures.published()
    assert (d455.scalars["invalid_fraction"], d455.scalars["flicker_fraction"]) == (0.107, 0.027)
    assert (native.width_px, decimated.width_px) == (640, 320)
    assert native.scalars["grid_share"] > 0.95 and set(native.curves) == set(figures.CURVES)


def test_real_recordings_without_a_focal_length_are_left_out_by_name(tmp_path):
    depth = plane_mm(20.0).astype(np.uint16)
    for name, meta in (("a", {"sensor": "D435", "fx_px": FX_PX}), ("b", {"sensor": "unknown"})):
        write_depth(tmp_path / name, [depth], **meta)
    measured, skipped = compare.measure_real(tmp_path, D455.scaled(0.125), Progress(quiet=True))
    assert [m.camera for m in measured] == ["a 160x90"]
    assert len(skipped) == 1 and "add fx_px and baseline_m" in skipped[0]
    with pytest.raises(UserError, match="none of its recordings can be compared"):
        compare.measure_real(tmp_path / "b", D455.scaled(0.125), Progress(quiet=True))


def test_of_a_long_recording_the_first_frames_are_measured_and_it_is_said(tmp_path, monkeypatch):
    write_depth(tmp_path / "a", 9 * [plane_mm(20.0).astype(np.uint16)], sensor="D435", fx_px=FX_PX)
    monkeypatch.setattr(figures, "MOST_PIXELS", 5 * SIZE[0] * SIZE[1] + 1)
    progress = Progress(quiet=True)
    said: list[str] = []
    monkeypatch.setattr(progress, "note", said.append)
    measured, _ = compare.measure_real(tmp_path, D455.scaled(0.125), progress)
    assert [m.frames for m in measured] == [5]
    assert said == [f"{tmp_path / 'a'}: the first 5 of 9 frames are measured"]


def test_losses_count_the_objects_own_pixels():
    depth = np.full((2, *SIZE), 1000, np.uint16)
    depth[:, :10] = 0  # not the object
    depth[0, 40, 50:53] = 0
    mask = np.zeros(SIZE, bool)
    mask[40, 50:60] = True
    loss = compare.object_losses([StandingScene("cube", depth, mask)])["cube"]
    assert loss == pytest.approx({"pixels": 10, "invalid_fraction": 0.15, "flicker_fraction": 0.3})


def test_objects_fail_by_their_materials():
    names = ("wheel", "can", "starfruit", "banana", "bread", "apple")
    scenes = list(standing_scenes(RecordConfig(), D455.scaled(0.25), names, 2, 2, seed=0))
    lost = {name: loss["invalid_fraction"] for name, loss in compare.object_losses(scenes).items()}
    assert min(lost[name] for name in ("wheel", "can", "starfruit")) > 0.07
    assert max(lost[name] for name in ("banana", "bread", "apple")) < 0.07
    assert max(lost.values()) < 0.5


def test_no_number_is_cut_however_many_recordings_there_are(monkeypatch, capsys):
    """Tables of as many as fit, the rig's camera beside each."""
    monkeypatch.setenv("COLUMNS", "80")
    full = next(camera for camera in figures.published() if camera.curves.keys() == figures.CURVES.keys())
    rig, *known = (replace(full, camera=f"take{i} 848x480") for i in range(8))
    result = compare.Comparison(known, rig, {}, [])
    compare.print_tables(result)
    shown = capsys.readouterr().out
    assert "…" not in shown and max(map(len, shown.splitlines())) <= 80
    groups = compare.side_by_side(result, 80)
    assert [camera for group in groups for camera in group[:-1]] == known
    assert all(group[-1] is rig and len(group) > 1 for group in groups)
    assert shown.count("take0") == len(groups) * (1 + len(figures.CURVES))
    assert compare.side_by_side(replace(result, real=known[:1]), 10) == [[known[0], rig]]


def test_compare_writes_table_json_and_picture(tmp_path, capsys):
    result = compare.compare(
        RecordConfig(),
        D455.scaled(0.125),
        None,
        per_object=1,
        frames=2,
        seed=0,
        progress=Progress(quiet=True),
    )
    compare.print_tables(result)
    shown = capsys.readouterr().out
    assert "D435 320x240" in shown and "rig 160x90" in shown and "starfruit" in shown
    json_file, png_file = compare.write(result, tmp_path)
    written = json.loads(json_file.read_text())
    assert 0.03 < written["rig"]["scalars"]["invalid_fraction"] < 0.2
    assert len(written["objects"]) == 12 and len(written["real"]) == 3
    assert png_file.read_bytes()[:4] == b"\x89PNG"
