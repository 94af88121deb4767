"""Every camera model by the same rules: jit, vmap, keys, invalid pixels, metres."""

import math

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ddg_jax.prior import make_prior
from ddg_jax.representation import LIMIT_PER_M
from ddg_jax.sample import Generator
from ddg_jax.sensor import SENSORS, learned, make_sensor
from ddg_jax.train import init_params
from ddgrasp.config import (
    DDGConfig,
    DDGDepthConfig,
    DextrahConfig,
    GraftConfig,
    KinectConfig,
    SamplingConfig,
    SensorConfig,
    UNetConfig,
)
from ddgrasp.contract import D455
from ddgrasp.errors import UserError
from sensors.models import procedural
from sensors.models.sense import Sense, ideal

PROFILE = D455.scaled(0.125)
SIZE = (PROFILE.height_px, PROFILE.width_px)
FB_PX_M = PROFILE.fx_px * PROFILE.baseline_m


def scene() -> tuple[np.ndarray, np.ndarray]:
    """Two tilted planes with a box before each; the second picture has an invalid corner."""
    rows = np.linspace(1.1, 0.7, SIZE[0], dtype=np.float32)[:, None]
    depth = np.broadcast_to(rows, (2, *SIZE)).copy()
    depth[:, 40:60, 80:100] = 0.65
    depth[1, :20, :30] = 0
    rgb = np.full((2, *SIZE, 3), 150, np.uint8)
    return depth, rgb


@pytest.fixture(scope="module")
def sensors() -> dict[str, Sense]:
    config = DDGConfig(
        depth=DDGDepthConfig(height_px=72, width_px=128),
        unet=UNetConfig(widths=(8, 16), blocks=(0, 1), attention_heads=0),
        sampling=SamplingConfig(steps=2),
        graft=GraftConfig(noise_threshold=0.0),
    )
    # A network at its start predicts zero everywhere; shaken weights give pictures with and without holes.
    leaves, tree = jax.tree.flatten(init_params(config, jax.random.key(0)))
    keys = jax.random.split(jax.random.key(1), len(leaves))
    shaken = [p + 0.2 * jax.random.normal(k, p.shape) for p, k in zip(leaves, keys, strict=True)]
    params = jax.tree.unflatten(tree, shaken)
    made = {name: make_sensor(SensorConfig(name=name), PROFILE) for name in SENSORS if name != "learned"}
    return {**made, "learned": learned(Generator(config, params, make_prior(config)))}


@pytest.mark.parametrize("name", list(SENSORS))
def test_one_api(sensors, name):
    sense = sensors[name]
    depth, rgb = scene()
    key = jax.random.key(3)
    noisy = np.asarray(jax.jit(sense)(key, depth, rgb))
    assert noisy.shape == depth.shape and noisy.dtype == np.float32
    np.testing.assert_array_equal(noisy, np.asarray(jax.jit(sense)(key, depth, rgb)))
    # Invalid stays invalid; what is valid is in metres, and mostly near the truth.
    assert not noisy[depth == 0].any()
    valid = (noisy > 0) & (depth > 0)
    if name == "learned":  # not fitted: its artefacts mean nothing, but what is valid is as metric as any
        assert 0.02 < valid.mean() < 0.96
        assert np.abs(1 / noisy[valid] - 1 / depth[valid]).max() <= LIMIT_PER_M * 1.001
    else:
        assert valid.mean() > 0.6
        assert np.median(np.abs(noisy - depth)[valid]) < 0.02
    # One picture at a time with the batch's own keys gives the batch; another key gives another result.
    keys = jax.random.split(key, 2)
    single = np.asarray(jax.vmap(sense)(keys, jnp.asarray(depth), jnp.asarray(rgb)))
    assert np.mean(np.abs(single - noisy) < 1e-5) > 0.999
    if name != "ideal":
        assert np.mean(noisy != np.asarray(sense(jax.random.key(4), depth, rgb))) > 0.001


def test_unknown_sensor_suggests_the_nearest():
    with pytest.raises(UserError, match="Did you mean 'dextrah'"):
        make_sensor(SensorConfig(name="dextra"), PROFILE)
    with pytest.raises(UserError, match="learned_from is empty"):
        make_sensor(SensorConfig(name="learned"), PROFILE)


def test_wrong_input_is_named():
    depth, rgb = scene()
    with pytest.raises(UserError, match="uint16.*divide millimetres by 1000"):
        ideal()(jax.random.key(0), (1000 * depth).astype(np.uint16), None)
    with pytest.raises(UserError, match="rgb is"):
        ideal()(jax.random.key(0), depth, rgb[:, :-1])
    with pytest.raises(UserError, match="was made for 160x90"):
        make_sensor(SensorConfig(name="stereo"), PROFILE)(jax.random.key(0), depth[:, ::2], None)


# --- the procedural equations ----------------------------------------------------------------------


def test_quantised_to_eighths_of_a_pixel():
    fb = 10.0
    # 8 f B / z = 80 / 1.013 = 78.97: step 79; 80 / 1.005 = 79.6: step 80.
    result = procedural.quantised(jnp.array([1.013, 1.005, 1.0]), fb, 8.0)
    np.testing.assert_allclose(result, [80 / 79, 1.0, 1.0], rtol=1e-6)


def test_axial_noise_is_quadratic_and_as_measured():
    # Khoshelham and Elberink 2012: 1.4 mm at 1 m, 3.6 cm at 5 m.
    sigma = procedural.axial_deviation_m(jnp.array([1.0, 5.0]), KinectConfig().axial_per_m)
    np.testing.assert_allclose(sigma, [0.001425, 0.0356], rtol=1e-2)


def test_disparity_noise_by_hand():
    # f B = 16, z = 0.8: d = 20 px; 21 px is 0.7619 m. Invalid stays invalid.
    result = procedural.add_disparity(jnp.array([0.8, 0.0]), jnp.array([1.0, 1.0]), 16.0)
    np.testing.assert_allclose(result, [16 / 21, 0.0], rtol=1e-6)


def test_shift_looks_up_whole_pixels():
    depth = jnp.arange(12.0).reshape(3, 4) + 1
    shift = jnp.stack([jnp.full((3, 4), 0.9), jnp.full((3, 4), -1.2)])
    np.testing.assert_array_equal(
        procedural.shifted(depth, shift), [[5, 5, 6, 7], [9, 9, 10, 11], [9, 9, 10, 11]]
    )


def test_smooth_field_has_unit_variance_everywhere_and_is_correlated():
    field = np.asarray(procedural.smooth_field(jax.random.key(0), (4000, 12, 16), 4.0))
    np.testing.assert_allclose(field.std(axis=0), 1.0, atol=0.06)
    beside = np.mean(field[:, :, 8] * field[:, :, 9])
    far = np.mean(field[:, :, 2] * field[:, :, 13])
    assert beside > 0.8 and abs(far) < 0.03


def test_dextrah_rates():
    config = DextrahConfig(dropout=0.02, random_value=0.01, stick=0.0)
    clean = jnp.full((8, *SIZE), 0.8)
    noisy = np.asarray(procedural.dextrah(config, PROFILE)(jax.random.key(0), clean, None))
    assert np.mean(noisy == 0) == pytest.approx(0.02, abs=0.002)
    near = noisy[np.abs(noisy - 0.8) < 0.03]
    assert near.std() == pytest.approx(config.disparity_px * 0.8**2 / FB_PX_M, rel=0.1)
    # 0.01 take a value from 0.3 to 2 m: all but 4 % of them are away from the wall.
    assert np.mean((noisy > 0) & (np.abs(noisy - 0.8) > 0.03)) == pytest.approx(0.0098, abs=0.0015)


def test_formulas_scaled_are_as_noisy_in_a_larger_picture_of_the_same_wall():
    strengths, wide = DextrahConfig(dropout=0.0, random_value=0.0), D455.scaled(0.25)

    def noisy(config, profile):
        wall = jnp.full((8, profile.height_px, profile.width_px), 0.8)
        return np.asarray(procedural.dextrah(config, profile)(jax.random.key(0), wall, None))

    def deviation(noisy):
        return noisy[np.abs(noisy - 0.8) < 0.03].std()

    small, unscaled = (noisy(strengths, profile) for profile in (PROFILE, wide))
    large = noisy(strengths.scaled(2.0), wide)
    assert deviation(large) == pytest.approx(deviation(small), rel=0.05)
    assert deviation(unscaled) == pytest.approx(deviation(small) / 2, rel=0.05)
    # As much of a picture is covered by sticks.
    covered = [np.mean(np.abs(seen - 0.8) > 0.03) for seen in (small, large)]
    assert covered[1] == pytest.approx(covered[0], rel=0.25) and covered[0] > 0.002
    assert strengths.scaled(1.0) == strengths
    assert strengths.scaled(0.125).stick_width_px == 1.0


def test_sticks_have_the_expected_number_and_one_depth_each():
    config = DextrahConfig(stick=0.001, random_near_m=3.0, random_far_m=4.0)
    pictures = [
        np.asarray(procedural.draw_sticks(jax.random.key(i), jnp.ones(SIZE), config)) for i in range(40)
    ]
    numbers = [len(np.unique(p)) - 1 for p in pictures]
    expected = 0.001 * SIZE[0] * SIZE[1]
    assert np.mean(numbers) == pytest.approx(expected, rel=0.15)
    assert all(p[p != 1.0].min(initial=3.0) >= 3.0 for p in pictures)
    np.testing.assert_array_equal(
        procedural.draw_sticks(jax.random.key(0), jnp.ones(SIZE), DextrahConfig(stick=0.0)), 1.0
    )


def test_ellipses_are_holes_of_the_expected_number_size_and_slant():
    size = (100, 140)
    drop = jax.jit(procedural.ellipse_dropout(0.5, 12.0))
    pictures = np.asarray(drop(jax.random.key(0), jnp.ones((400, *size)), None))
    assert set(np.unique(pictures)) == {0.0, 1.0}
    counts, longest, slant = [], 0.0, 0.0
    for holes in (pictures == 0).astype(np.uint8):
        labels, numbers, _, _ = cv2.connectedComponentsWithStats(holes, connectivity=8)
        counts.append(labels - 1)
        for label in range(1, labels):
            place = np.argwhere(numbers == label)
            spread = 4 * np.atleast_2d(np.cov(place.T, bias=True))  # of an ellipse: its half axes squared
            longest = max(longest, float(np.sqrt(np.linalg.eigvalsh(spread)[-1])))
            slant = max(slant, float(abs(spread[0, 1]) / spread.trace()))
    assert np.mean(counts) == pytest.approx(0.5, rel=0.2)  # fewer where one lies on another
    # A half axis is 12 px x 8^-u on average 12 (1 - 1/8) / ln 8; the borders cut off some.
    mean_area_px = math.pi * (12 * (1 - 1 / 8) / math.log(8)) ** 2
    assert np.mean(pictures == 0) == pytest.approx(0.5 * mean_area_px / pictures[0].size, rel=0.25)
    assert 10.5 < longest < 24  # two that touch count as one
    assert slant > 0.25, "turned"
    none = procedural.ellipse_dropout(0.0, 12.0)(jax.random.key(0), jnp.ones(size), None)
    np.testing.assert_array_equal(none, 1.0)


def test_ellipses_lie_elsewhere_with_another_key_and_leave_holes_holes():
    depth, _ = scene()
    drop = procedural.ellipse_dropout(4.0, 12.0)
    keys = jax.random.split(jax.random.key(3), len(depth))
    batch = np.asarray(drop(jax.random.key(3), depth, None))
    single = np.stack(
        [np.asarray(drop(key, picture, None)) for key, picture in zip(keys, depth, strict=True)]
    )
    np.testing.assert_array_equal(batch, single)
    assert (
        not batch[depth == 0].any()
        and np.mean(batch != np.asarray(drop(jax.random.key(4), depth, None))) > 0.01
    )


def test_without_noise_the_procedural_models_change_nothing():
    depth, _ = scene()
    off = DextrahConfig(shift_px=0, disparity_px=0, dropout=0.0, random_value=0.0, stick=0.0)
    np.testing.assert_allclose(
        procedural.dextrah(off, PROFILE)(jax.random.key(0), depth, None), depth, rtol=1e-5
    )
    off = KinectConfig(shift_px=0, axial_per_m=0, steps_per_px=1e4)
    np.testing.assert_allclose(
        procedural.kinect(off, PROFILE)(jax.random.key(0), depth, None), depth, rtol=1e-5
    )


@pytest.mark.parametrize("tilt_deg", [0.0, 30.0, 60.0])
def test_noise_along_normals_is_less_deep_on_what_is_tilted(tilt_deg):
    quiet = DextrahConfig(shift_px=0, disparity_px=0, dropout=0.0, random_value=0.0, stick=0.0, normal_m=0.01)
    across = (np.arange(SIZE[1]) - PROFILE.cx_px) / PROFILE.fx_px
    slope = np.tan(np.radians(tilt_deg))
    clean = np.broadcast_to(1.0 / (1.0 - slope * across), SIZE).astype(np.float32)  # z = 1 + slope x
    near = (slice(40, 80), slice(int(PROFILE.cx_px) - 20, int(PROFILE.cx_px) + 20))
    off = (np.asarray(procedural.dextrah(quiet, PROFILE)(jax.random.key(0), clean, None)) - clean)[near]
    assert off.std() == pytest.approx(0.01 * np.cos(np.radians(tilt_deg)), rel=0.06)
    assert abs(np.corrcoef(off[:, 1:].ravel(), off[:, :-1].ravel())[0, 1]) < 0.1


def test_noise_along_normals_leaves_holes_and_what_is_beside_them():
    clean = np.full(SIZE, 0.7, np.float32)
    clean[20, 30] = 0.0
    noise = np.full(SIZE, 0.01, np.float32)
    moved = np.asarray(procedural.along_normals(jnp.asarray(clean), jnp.asarray(noise), PROFILE))
    assert moved[20, 30] == 0.0 and moved[20, 29] == moved[19, 30] == np.float32(0.7)
    assert np.isclose(moved, 0.71).sum() == (SIZE[0] - 1) * (SIZE[1] - 1) - 3


def test_dextrah_frays_edges_by_its_shift_and_mixes_no_depths():
    off = DextrahConfig(shift_px=1.5, disparity_px=0, dropout=0.0, random_value=0.0, stick=0.0)
    clean = np.full(SIZE, 1.2, np.float32)
    clean[:, 80:] = 0.6
    noisy = np.asarray(procedural.dextrah(off, PROFILE)(jax.random.key(0), clean, None))
    frayed = np.abs(noisy - clean) > 1e-3
    assert frayed[:, 78:82].mean() > 0.1 and not frayed[:, :70].any() and not frayed[:, 90:].any()
    np.testing.assert_allclose(noisy, np.where(noisy > 0.9, 1.2, 0.6), rtol=1e-5)


def test_kinect_s_depth_is_off_by_its_axial_noise():
    config = KinectConfig(shift_px=0, axial_per_m=0.002, steps_per_px=1e4)
    noisy = np.asarray(procedural.kinect(config, PROFILE)(jax.random.key(0), jnp.full(SIZE, 1.5), None))
    assert noisy.std() == pytest.approx(0.002 * 1.5**2, rel=0.05)
