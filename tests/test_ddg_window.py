"""The camera's matching window on simulated depth: ramps in inverse depth, on both ways to noise alike."""

from dataclasses import replace

import jax
import numpy as np
import pytest

from ddg_jax.generate import Clip, noisy_episodes
from ddg_jax.prior import make_prior
from ddg_jax.sample import Generator, generate
from ddg_jax.sensor import learned
from ddg_jax.train import init_params
from ddg_jax.window import mixed
from ddgrasp.config import DDGConfig, DDGDepthConfig, GraftConfig, SamplingConfig, UNetConfig
from ddgrasp.depth import to_metres, to_millimetres
from ddgrasp.errors import UserError

CONFIG = DDGConfig(
    depth=DDGDepthConfig(height_px=16, width_px=24),
    unet=UNetConfig(widths=(8, 8), blocks=(0, 1), attention_heads=1),
    sampling=SamplingConfig(steps=2, batch_size=4),
    graft=GraftConfig(noise_threshold=-10.0),
)

GAUSSIAN_15 = GraftConfig(window_px=1.5)


def test_without_a_window_depth_keeps_its_bits():
    depth_m = np.random.default_rng(0).uniform(0.4, 2.0, (2, 8, 8)).astype(np.float32)
    np.testing.assert_array_equal(mixed(depth_m, GraftConfig()), depth_m)


def test_a_surface_stays_and_an_edge_becomes_a_ramp_of_inverse_depth():
    depth_m = np.full((1, 9, 40), 1.0, np.float32)
    np.testing.assert_allclose(mixed(depth_m, GAUSSIAN_15), depth_m, rtol=1e-6)
    depth_m[..., 20:] = 0.5
    inverse = 1.0 / mixed(depth_m, GAUSSIAN_15)[0, 4]
    assert inverse[19] + inverse[20] == pytest.approx(3.0, abs=1e-4), "symmetric about the edge's 1.5 per m"
    assert (np.diff(inverse) > -1e-6).all() and inverse[19] - 1.0 == pytest.approx(0.37, abs=0.02)
    np.testing.assert_allclose(inverse[[0, -1]], [1.0, 2.0], rtol=1e-5)


def test_a_box_weighs_all_of_its_window_alike():
    depth_m = np.full((1, 9, 40), 1.0, np.float32)
    depth_m[..., 20:] = 0.5
    inverse = 1.0 / mixed(depth_m, GraftConfig(window_px=5, window_shape="box"))[0, 4]
    np.testing.assert_allclose(inverse[17:23], [1.0, 1.2, 1.4, 1.6, 1.8, 2.0], rtol=1e-5)


@pytest.mark.parametrize("width", [2, 4.5, 1.25])
def test_a_box_has_a_middle(width):
    with pytest.raises(UserError, match=f"ddg.graft.window_px is {width:g}.*odd number of pixels"):
        GraftConfig(window_px=width, window_shape="box")


def test_holes_stay_and_do_not_leak():
    depth_m = np.full((1, 11, 11), 0.8, np.float32)
    depth_m[0, 3:6, 3:6] = 0.0
    out = mixed(depth_m, GraftConfig(window_px=2.0))
    np.testing.assert_array_equal(out == 0, depth_m == 0)
    np.testing.assert_allclose(out[depth_m > 0], 0.8, rtol=1e-5)


@pytest.mark.parametrize("by", ["frames", "episodes"])
def test_a_generator_with_a_window_is_one_without_on_mixed_depth(by):
    config = replace(CONFIG, graft=replace(CONFIG.graft, window_px=1.2))
    generators = [Generator(c, init_params(c, jax.random.key(0)), make_prior(c)) for c in (config, CONFIG)]
    rng = np.random.default_rng(1)
    clean_mm = np.full((3, 16, 24), 900, np.uint16)
    clean_mm[:, 4:9, 6:15] = rng.integers(500, 700, (3, 1, 1))
    inputs = (to_metres(clean_mm), mixed(to_metres(clean_mm), config.graft))
    made = [generate(jax.random.key(2), g, d).depth_m for g, d in zip(generators, inputs, strict=True)]
    np.testing.assert_array_equal(*made)
    assert np.abs(made[0] - generate(jax.random.key(2), generators[1], inputs[0]).depth_m).max() > 0.05
    if by == "episodes":
        (episode,) = noisy_episodes(jax.random.key(2), generators[0], [3], lambda i: Clip(0, clean_mm))
        np.testing.assert_allclose(episode.astype(int), to_millimetres(made[0]).astype(int), atol=1)


def test_the_camera_model_has_the_window_too():
    config = replace(CONFIG, graft=replace(CONFIG.graft, window_px=1.2))
    generators = [Generator(c, init_params(c, jax.random.key(0)), make_prior(c)) for c in (config, CONFIG)]
    senses = [learned(generator) for generator in generators]
    clean_m = np.full((2, 16, 24), 0.9, np.float32)
    clean_m[:, 4:9, 6:15] = 0.6
    inputs = (clean_m, mixed(clean_m, config.graft))
    made = [np.asarray(sense(jax.random.key(2), d, None)) for sense, d in zip(senses, inputs, strict=True)]
    np.testing.assert_allclose(*made, atol=1e-6)
    assert np.abs(made[0] - np.asarray(senses[1](jax.random.key(2), clean_m, None))).max() > 0.05


FITTED = Generator(CONFIG, init_params(CONFIG, jax.random.key(0)), make_prior(CONFIG))
SCENE_M = np.random.default_rng(0).uniform(0.5, 0.9, (6, 16, 24)).astype(np.float32)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"episode": np.arange(2)}, r"episode is int64 \(2,\) of 6 frames; expected .* or one for all"),
        ({"frame": np.zeros(7, int)}, r"frame is int64 \(7,\) of 6 frames"),
        ({"depth_m": -SCENE_M}, r"from -0.\d+ to 0; expected finite metres"),
        ({"depth_m": 1000 * SCENE_M}, "divide millimetres by 1000"),
        ({"depth_m": np.where(SCENE_M > 0.6, np.nan, SCENE_M)}, "expected finite metres"),
        ({"depth_m": SCENE_M[:0]}, "expected a frame or more"),
    ],
)
def test_numbers_and_depth_that_do_not_fit_are_refused(change, said):
    with pytest.raises(UserError, match=said):
        generate(jax.random.key(0), FITTED, **{"depth_m": SCENE_M} | change)


def test_frames_come_out_the_same_however_many_come_at_once():
    together = generate(jax.random.key(0), FITTED, SCENE_M)  # a batch and a half
    for t in (0, 5):
        alone = generate(jax.random.key(0), FITTED, SCENE_M[t : t + 1], frame=np.array([t]))
        for one, all_of_them in zip(vars(alone).values(), vars(together).values(), strict=True):
            np.testing.assert_allclose(one[0], all_of_them[t], atol=1e-6)
