"""The active-stereo camera: geometry of its depth, defects that follow from stereo, not from formulas."""

import math
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import mujoco
import numpy as np
import pytest

from ddgrasp import contract
from ddgrasp.config import RecordConfig, StereoConfig, WorldConfig
from ddgrasp.errors import UserError
from mjx_envs.camera import Buffers, Camera, nominal_camera
from rig.camera import RigCamera, jittered_pose
from sensors.models import matching
from sensors.models.active_stereo import ActiveStereo, of_scale
from sensors.models.matching import flatten
from sensors.models.materials import Material
from sensors.statistics import curves, figures, stats

PROFILE = WorldConfig().profile
FB_PX_M = PROFILE.fx_px * PROFILE.baseline_m
GREY = {0: Material(0.5, texture=0.1), 1: Material(0.5, texture=0.1)}
T_WORLD_CAM = np.eye(4)
JITTERS = ("camera_position_jitter_m", "camera_aim_jitter_m", "camera_roll_jitter_rad")


def wall(range_m: float, square_range_m: float = 0.0, half_m: float = 0.1):
    """Render function of a wall facing the camera (geom 0), optionally with a square before it (geom 1)."""

    def render(camera: Camera) -> Buffers:
        shape = (camera.height_px, camera.width_px)
        depth = np.full(shape, range_m, np.float32)
        ids = np.zeros(shape, np.int32)
        if square_range_m:
            x = (
                np.arange(shape[1]) + 0.5 - camera.cx_px
            ) / camera.fx_px * square_range_m + camera.T_world_cam[0, 3]
            y = (np.arange(shape[0]) + 0.5 - camera.cy_px) / camera.fy_px * square_range_m
            square = (np.abs(y)[:, None] < half_m) & (np.abs(x)[None, :] < half_m)
            depth[square], ids[square] = square_range_m, 1
        normal = np.zeros((*shape, 3), np.float32)
        normal[..., 2] = -1.0
        return Buffers(depth, np.full((*shape, 3), 0.5, np.float32), ids, normal)

    return render


def sense(render, seed: int = 0, materials=GREY, **config) -> np.ndarray:
    camera = ActiveStereo(replace(StereoConfig(), **config), PROFILE)
    return camera.sense(render, T_WORLD_CAM, np.random.default_rng(seed), materials)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("block_px", 9), ("smoothness", 4.0), ("uniqueness_percent", 40), ("speckle_px", 10_000),
        ("residual_limit", 0.3), ("contrast_limit", 30.0), ("dark_limit", 60), ("subpixel_steps", 4),
        ("dot_radius_mrad", 2.0), ("speckle_contrast", 0.6), ("refine_window_px", 5),
    ],
)  # fmt: skip
def test_a_setting_of_matching_or_light_is_used(name, value):
    """A user sets them to a camera of his own."""
    scene = wall(0.8, 0.6, 0.1)
    assert getattr(StereoConfig(), name) != value
    assert (sense(scene, **{name: value}) != sense(scene)).any()


def test_the_matcher_compares_left_with_right_as_configured():
    assert matching.matcher(replace(StereoConfig(), left_right_px=7), 48).getDisp12MaxDiff() == 7


def test_windows_cover_as_much_of_a_surface_in_larger_pictures():
    configured = StereoConfig()
    for scale, larger in ((0.125, 1.0), (0.25, 1.0), (0.5, 2.0), (1.0, 4.0)):
        made = of_scale(configured, contract.D455.scaled(scale)).config
        assert made == (configured if larger == 1 else configured.finer(larger)), scale


@pytest.mark.parametrize("range_m", [0.5, 0.8, 1.2])
def test_wall_is_measured_where_it_stands(range_m):
    depth_mm = sense(wall(range_m))
    band = int(np.ceil(FB_PX_M / range_m))
    assert depth_mm.dtype == np.uint16 and depth_mm.shape == (180, 320)
    # No counterpart in the right picture: the band is as wide as the disparity.
    assert np.mean(depth_mm[:, : band - 1] > 0) < 0.03
    inner = depth_mm[10:-10, band + 8 : -8]
    assert np.mean(inner > 0) > 0.95
    # A tenth of a pixel of disparity.
    assert abs(np.median(inner[inner > 0]) / 1000 - range_m) < 0.1 * range_m**2 / FB_PX_M


def test_the_projector_lights_what_a_principal_point_off_the_middle_shows():
    """One that is 20 px higher looks as much further down, where no dots were: half of it was lost."""
    camera = ActiveStereo(StereoConfig(), replace(PROFILE, cy_px=PROFILE.cy_px - 20))
    lost = camera.sense(wall(0.8), T_WORLD_CAM, np.random.default_rng(0), {0: Material(0.5)}) == 0
    assert np.mean(lost[-20:, 60:]) < 0.15


def test_another_projector_lights_the_same_surfaces():
    one, other = (ActiveStereo(StereoConfig(pattern_seed=seed), PROFILE) for seed in (455, 1))
    np.testing.assert_array_equal(one._texture, other._texture)
    assert not np.array_equal(one._pattern, other._pattern)


def test_disparity_is_quantised_in_32nds():
    depth_mm = sense(wall(0.6))
    values = np.unique(depth_mm[depth_mm > 0])
    steps = np.rint(32 * FB_PX_M * 1000 / values)
    np.testing.assert_allclose(32 * FB_PX_M * 1000 / steps, values, atol=0.51)
    # Neighbouring steps are z^2 / (32 f B) = 0.7 mm apart here, so not every millimetre occurs.
    assert len(values) < 200


def test_occlusion_shadow_lies_on_the_left_of_an_object():
    near_m, far_m, half_m = 0.6, 1.2, 0.1
    depth_mm = sense(wall(far_m, near_m, half_m))
    left = round(PROFILE.cx_px - half_m / near_m * PROFILE.fx_px)
    right = round(PROFILE.cx_px + half_m / near_m * PROFILE.fx_px)
    shadow_px = round(FB_PX_M * (1 / near_m - 1 / far_m))
    assert shadow_px == 13
    rows = slice(80, 100)
    on_left = np.mean(depth_mm[rows, left - shadow_px + 2 : left - 2] == 0)
    on_right = np.mean(depth_mm[rows, right + 3 : right + shadow_px] == 0)
    assert on_left > 0.8 and on_right < 0.2
    middle = depth_mm[rows, left + 6 : right - 6]
    assert np.mean(np.abs(middle.astype(int) - 600) < 15) > 0.95


def test_the_projector_s_dots_do_not_reach_behind_an_object():
    """It stands right of the left imager, which sees the unlit band of the wall left of the object."""
    camera, half_m, near_m = ActiveStereo(StereoConfig(), PROFILE), 0.1, 0.5
    plain = {geom: Material(0.5, specular=0.0) for geom in (0, 1)}
    left, _ = camera.infrared(wall(1.6, near_m, half_m), T_WORLD_CAM, np.random.default_rng(0), plain)
    edges = (round(PROFILE.cx_px + side * half_m / near_m * PROFILE.fx_px) for side in (-1, 1))
    rough = np.abs(np.diff(left[70:110].astype(float), axis=1)).mean(axis=0)
    behind, beside = (rough[at : at + 8].mean() for at in (next(edges) - 11, next(edges) + 3))
    assert behind < 0.4 * beside


def test_holes_come_from_matching_without_texture_there_is_no_depth():
    blank = {0: Material(0.5)}
    assert np.mean(sense(wall(0.8), materials=blank, projector_power=0.0) > 0) < 0.05
    assert np.mean(sense(wall(0.8), materials=blank) > 0) > 0.85


def test_dark_surfaces_lose_pixels():
    def lost(albedo: float) -> float:
        depth_mm = sense(wall(1.2, 0.7), materials={0: GREY[0], 1: Material(albedo, specular=0.0)})
        return float(np.mean(depth_mm[75:105, 142:178] == 0))

    assert lost(0.5) < 0.1 and lost(0.004) > 0.5


def lost_of_a_small_square(material: Material) -> float:
    """Share without depth of a 3 cm square (about 10 px) on a textured wall, its outline included."""
    render = wall(0.72, 0.7, half_m=0.015)
    depth_mm = sense(render, materials={0: Material(0.5, texture=0.35), 1: material})
    camera = ActiveStereo(StereoConfig(), PROFILE).camera(T_WORLD_CAM)
    return float(np.mean(depth_mm[render(camera).segmentation == 1] == 0))


def test_small_dark_objects_fail_and_bright_ones_do_not():
    """The bright surroundings within the contrast's window do not stand in for the object's own light."""
    assert lost_of_a_small_square(Material(0.5)) < 0.05
    assert lost_of_a_small_square(Material(0.015)) > 0.3


def test_translucent_bodies_return_light_without_dots():
    def picture(translucency: float) -> np.ndarray:
        camera = ActiveStereo(StereoConfig(), PROFILE)
        materials = {0: Material(0.5, specular=0.0, translucency=translucency)}
        left, _ = camera.infrared(wall(0.8), T_WORLD_CAM, np.random.default_rng(0), materials)
        return left[60:120, 100:220].astype(float)

    def roughness(left: np.ndarray) -> float:
        return float(np.abs(np.diff(left, axis=1)).mean())

    opaque, clear = picture(0.0), picture(1.0)
    assert roughness(clear) < 0.4 * roughness(opaque)
    assert clear.mean() == pytest.approx(opaque.mean(), rel=0.3)


def test_out_of_range_is_invalid():
    assert np.mean(sense(wall(0.25)) > 0) < 0.1
    assert not sense(wall(0.8), max_range_m=0.7).any()
    assert np.mean(sense(wall(0.0)) > 0) < 0.005


def test_noise_grows_with_the_square_of_range():
    def deviation_mm(range_m: float) -> float:
        camera, rng = ActiveStereo(StereoConfig(), PROFILE), np.random.default_rng(1)
        frames = np.stack([camera.sense(wall(range_m), T_WORLD_CAM, rng, GREY) for _ in range(6)])
        return stats.temporal_deviation_mm(frames[:, :, 60:260], 1000 * range_m)

    # Disparity noise is alike (slightly larger where dots are dimmer), z = fB / d squares it.
    assert 3.0 < deviation_mm(1.2) / deviation_mm(0.6) < 9.0


def test_flat_surfaces_are_as_smooth_as_a_real_cameras():
    """A D435 decimated to this size deviates by 0.013 px from a local plane at 0.7 to 0.9 m."""

    def deviation_px(**config) -> float:
        stream = figures.rig_stream(sense(wall(0.8), **config)[None], PROFILE, 1)
        return curves.by_surface(stream)[0]["spatial_px"].value[2]

    assert deviation_px() < 1.5 * 0.013 < deviation_px(flat_noise_px=0.0)


def test_flattening_keeps_edges_relief_and_holes_apart():
    rows = np.arange(40, dtype=np.float32)[:, None]
    truth = np.broadcast_to(10.0 + 0.13 * rows, (40, 60)).copy()  # a table's slope
    truth[10:30, 25:45] += 0.6  # an object a few centimetres high
    noise = 0.05 * np.random.default_rng(0).standard_normal(truth.shape).astype(np.float32)
    valid = np.ones(truth.shape, bool)
    valid[18:20, 10:12] = False
    noisy = np.where(valid, truth + noise, -1.0)
    error = flatten(noisy, valid, StereoConfig()) - truth
    assert np.std(error[14:26, 6:18][valid[14:26, 6:18]]) < 0.02
    on_step = error[12:28, 25]
    assert np.abs(np.mean(on_step)) < 0.1 and np.std(on_step) > 0.02


def test_frames_are_reproducible_and_differ_by_seed():
    first, again, other = (sense(wall(0.8), seed) for seed in (3, 3, 4))
    np.testing.assert_array_equal(first, again)
    assert np.mean(first != other) > 0.2


def test_rig_is_near_measured_cameras(rig_frames):
    """A D435 decimated to this size: 8.0 % invalid, 12.8 holes per 10,000 px, 0.027 px
    (1.0 mm here) at 0.75 m.

    More: `ddgrasp sensors compare`, docs/sensors.md.
    """
    measured = stats.measure(rig_frames)
    assert 0.07 < measured.invalid_fraction < 0.11
    assert 40 < measured.hole_components < 120
    assert 0.9 < measured.temporal_deviation_mm < 1.6
    assert 0.004 < measured.flicker_fraction < 0.03
    assert 15 <= measured.left_band_px <= 32


def test_cube_stands_out_of_the_table(rig_frames):
    """Height over the table, from depth alone, at the cube's top (0.05 m) and beside it (0)."""
    camera = nominal_camera(PROFILE)
    T_cam_world = np.linalg.inv(camera.T_world_cam)
    depth_m = np.median(rig_frames, axis=0) / 1000

    def height_m(point_w) -> float:
        x, y, z = (T_cam_world @ np.array([*point_w, 1.0]))[:3]
        u, v = camera.fx_px * x / z + camera.cx_px, camera.fy_px * y / z + camera.cy_px
        window = depth_m[int(v) - 1 : int(v) + 2, int(u) - 1 : int(u) + 2]
        z_seen = np.median(window[window > 0])
        return float((camera.T_world_cam @ np.array([x / z * z_seen, y / z * z_seen, z_seen, 1.0]))[2])

    assert abs(height_m((0.5, 0.0, 0.05)) - 0.05) < 0.012
    assert abs(height_m((0.5, 0.12, 0.0))) < 0.012


@pytest.fixture(scope="module")
def rig_frames() -> np.ndarray:
    from mjx_envs import scene

    model = scene.build_model()
    data = mujoco.MjData(model)
    data.qpos[:7], data.qpos[7:9] = contract.HOME_RAD, 0.04
    data.qpos[9:16] = 0.5, 0.0, 0.025, 1, 0, 0, 0
    mujoco.mj_forward(model, data)
    camera = RigCamera(model, StereoConfig(), PROFILE)
    rng = np.random.default_rng(0)
    T_world_cam = nominal_camera(PROFILE).T_world_cam
    return np.stack([camera.depth_mm(data, T_world_cam, rng, "cube") for _ in range(6)])


def test_jittered_pose_stays_near_the_nominal_one():
    config = RecordConfig()
    nominal = nominal_camera(PROFILE).T_world_cam
    for seed in range(20):
        T = jittered_pose(config, np.random.default_rng(seed))
        assert np.abs(T[:3, 3] - nominal[:3, 3]).max() <= config.camera_position_jitter_m
        np.testing.assert_allclose(T[:3, :3].T @ T[:3, :3], np.eye(3), atol=1e-9)
        assert np.arccos(T[:3, 2] @ nominal[:3, 2]) < 0.25


def test_a_pose_is_jittered_by_as_much_as_is_configured():
    nominal, none = nominal_camera(PROFILE).T_world_cam, dict.fromkeys(JITTERS, 0.0)
    still = jittered_pose(replace(RecordConfig(), **none), np.random.default_rng(3))
    np.testing.assert_allclose(still, nominal, atol=1e-12)

    def turned_rad(**jitter: float) -> float:
        T = jittered_pose(replace(RecordConfig(), **none | jitter), np.random.default_rng(3))
        np.testing.assert_allclose(T[:3, 3], nominal[:3, 3], atol=1e-12)
        return np.arccos((np.trace(T[:3, :3].T @ nominal[:3, :3]) - 1) / 2)

    for name in JITTERS[1:]:
        assert turned_rad(**{name: 0.02}) > 5e-4
        assert turned_rad(**{name: 0.04}) == pytest.approx(2 * turned_rad(**{name: 0.02}), rel=0.05)


def test_lens_blur_is_as_wide_as_it_says_and_the_rig_s_as_it_was():
    quiet = {"full_well_electrons": 1e9, "read_noise": 0.0}
    point = np.zeros((61, 61), np.float32)
    point[30, 30] = 1.0
    for sigma_px in (1.0, 3.0, 7.0):
        camera = ActiveStereo(StereoConfig(lens_blur_px=sigma_px, **quiet), PROFILE)
        seen = camera._expose(point, 2 * math.pi * sigma_px**2, np.random.default_rng(0)).sum(0)
        spread = np.sqrt(np.average((np.arange(61) - 30) ** 2, weights=seen))
        assert spread == pytest.approx(sigma_px, rel=0.03)
    default = StereoConfig()
    picture = np.random.default_rng(1).random((40, 50), np.float32)
    rng = np.random.default_rng(2)
    signal = np.minimum(cv2.GaussianBlur(picture, (5, 5), default.lens_blur_px) * np.float32(0.9), 1.0)
    sigma = np.sqrt(signal / np.float32(default.full_well_electrons) + np.float32(default.read_noise**2))
    noise = rng.standard_normal(signal.shape, dtype=np.float32)
    before = np.clip(255.0 * (signal + sigma * noise) + 0.5, 0, 255).astype(np.uint8)
    camera = ActiveStereo(default, PROFILE)
    np.testing.assert_array_equal(camera._expose(picture, 0.9, np.random.default_rng(2)), before)


def test_windows_have_a_middle_pixel():
    for name in ("block_px", "residual_window_px", "refine_window_px", "flat_window_px"):
        with pytest.raises(UserError, match=f"{name} is 4; expected an odd number"):
            StereoConfig(**{name: 4})


def test_sensors_need_no_jax():
    code = (
        "import sys, rig.camera, rig.stage, evaluation.camera_comparison, sensors.recordings.importers; "
        "assert 'jax' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True, cwd=Path(__file__).parents[1])
