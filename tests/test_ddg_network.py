"""The U-Net's shape rules, representations of depth and grafting."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ddg_jax.graft import graft
from ddg_jax.representation import LIMIT_PER_M, channels, decode, encode
from ddg_jax.unet import UNet
from ddgrasp.config import DDGConfig, DDGDepthConfig, GraftConfig
from ddgrasp.errors import UserError


def test_a_unet_with_positions_sees_where_it_is_and_begins_without():
    plain, positioned = (UNet((8, 8), (0, 1), 0, 2, position) for position in (False, True))
    x, c, step = jnp.zeros((1, 20, 24, 2)), jnp.zeros((1, 20, 24)), jnp.zeros(1, int)
    params = positioned.init(jax.random.key(0), x, c, step)["params"]
    nowhere = params["position"]
    assert nowhere.shape == (10, 12, 8) and not nowhere.any()
    params = jax.tree.map(lambda p: p + 0.05, {name: params[name] for name in params if name != "position"})
    blind = plain.apply({"params": params}, x, c, step)
    same = positioned.apply({"params": params | {"position": nowhere}}, x, c, step)
    np.testing.assert_array_equal(same, blind)
    there = positioned.apply({"params": params | {"position": nowhere.at[2, 3].set(1.0)}}, x, c, step)
    assert np.abs(there - blind)[0, 4:6, 6:8].min() > 1e-3


def test_unet_takes_any_size_and_sees_prior_and_step():
    net = UNet((8, 8), (0, 1), 2, 4)
    x = jax.random.normal(jax.random.key(0), (2, 18, 21, 2))
    c = jax.random.normal(jax.random.key(2), (2, 18, 21))
    params = net.init(jax.random.key(1), x, c, jnp.zeros(2, int))
    params = jax.tree.map(lambda p: p + 0.05, params)
    out = net.apply(params, x, c, jnp.array([3, 3]))
    assert out.shape == (2, 18, 21, 2) and out.dtype == jnp.float32
    assert not np.allclose(out, net.apply(params, x, c + 1, jnp.array([3, 3])))
    assert not np.allclose(out, net.apply(params, x, c, jnp.array([3, 900]))[1], atol=1e-4)
    np.testing.assert_allclose(net.apply(params, x[:1], c[:1], jnp.array([3])), out[:1], rtol=1e-5, atol=1e-5)


DEPTH = DDGConfig(depth=DDGDepthConfig(representation="depth"), graft=GraftConfig(noise_threshold=-0.5))


def test_depth_survives_the_diffusion_space_and_holes_are_far_away():
    depth = jnp.array([0.0, 0.25, 0.5, 1.0, 9.0])
    x = encode(DEPTH, depth, depth)
    # 1/d from 1/10 to 1/0.25: 0.5 m is (2 - 0.1) / (4 - 0.1)
    np.testing.assert_allclose(x[:, 0], [-1, 1, 1.9 / 3.9, 0.9 / 3.9, (1 / 9 - 0.1) / 3.9], atol=1e-6)
    made = decode(DEPTH, x, depth)
    np.testing.assert_allclose(made.depth_m, depth, rtol=1e-5)
    np.testing.assert_array_equal(made.mask, depth == 0)
    outside = decode(DEPTH, jnp.array([[-0.51], [-0.4], [2.0]]), jnp.ones(3)).depth_m
    np.testing.assert_allclose(outside, [0, 10, 0.25], rtol=1e-6)
    assert encode(DEPTH, jnp.array([60.0, 0.1]), jnp.ones(2)).ravel().tolist() == [0.0, 1.0]


def test_deviations_are_metric_on_any_surface_and_limited():
    config = DDGConfig(
        depth=DDGDepthConfig(representation="deviation"), graft=GraftConfig(deviation_threshold=0.0005)
    )
    surface = jnp.array([1.0, 1.0, 1.0, 1.0, 2.0, 0.0])
    measured = 1 / (1 / jnp.maximum(surface, 0.5) + jnp.array([0.0, 0.0004, 0.01, 0.5, -0.03, 0.0]))
    measured = measured.at[5].set(0.0)
    x = encode(config, measured, surface)
    assert x.shape == (6, channels(config)) and x[:, 0].tolist() == [1, 1, 1, 1, 1, -1]
    assert x[3, 1] == 1.0 and x[5, 1] == 0.0 and abs(x[:, 1]).max() <= 1
    made = decode(config, x, surface)
    exact = measured.at[3].set(1 / (1 + LIMIT_PER_M))
    np.testing.assert_allclose(made.depth_m, exact, rtol=1e-5)
    # 0.0004 1/m is under the threshold: the simulation's own depth stays
    assert made.mask.tolist() == [False, False, True, True, True, True]
    # the same deviation is the same disparity at half the distance
    closer = decode(config, x[2:3], jnp.array([0.5])).depth_m
    np.testing.assert_allclose(closer, 1 / (2 + 0.01), rtol=1e-5)
    assert not decode(
        replace(config, graft=replace(config.graft, deviation_threshold=1.0)), x[:5], surface[:5]
    ).mask.any()


def test_an_unknown_representation_is_named():
    with pytest.raises(UserError, match="ddg.depth.representation 'disparity'"):
        channels(DDGConfig(depth=DDGDepthConfig(representation="disparity")))


def test_a_threshold_among_the_surfaces_is_refused():
    with pytest.raises(UserError, match=r"ddg.graft.noise_threshold is 0.4.*-0.2"):
        DDGConfig(depth=DDGDepthConfig(representation="depth"))


@pytest.mark.parametrize("threshold", [-0.1, float("inf"), float("nan")])
def test_a_threshold_that_no_deviation_has_is_refused(threshold):
    with pytest.raises(UserError, match=f"ddg.graft.deviation_threshold is {threshold}"):
        DDGConfig(graft=GraftConfig(deviation_threshold=threshold))


@pytest.mark.parametrize("representation", ["depth", "deviation"])
@pytest.mark.parametrize("threshold", [-0.8, -0.4, -0.1])
def test_grafting_is_the_papers_equation_bit_for_bit(representation, threshold):
    config = DDGConfig(
        depth=DDGDepthConfig(representation=representation), graft=GraftConfig(noise_threshold=threshold)
    )
    rng = np.random.default_rng(0)
    d_sim = rng.uniform(0.3, 2.0, (3, 5, 7)).astype(np.float32)
    d_sim[:, 0] = 0  # nothing in range there
    x = rng.uniform(-1, 1, (*d_sim.shape, channels(config))).astype(np.float32)
    x[:, 3:, :, -1] = np.maximum(x[:, 3:, :, -1], 0) * 1e-3
    d_pred, mask = map(np.asarray, decode(config, x, d_sim))
    final = np.asarray(graft(d_sim, d_pred, mask))
    assert 0 < mask.mean() < 1
    np.testing.assert_array_equal(final, d_sim * (1 - mask) + d_pred * mask)
    assert final[~mask].tobytes() == d_sim[~mask].tobytes()
    assert np.asarray(graft(final, d_pred, mask)).tobytes() == final.tobytes()
    valid = (final > 0) & (d_sim > 0)
    error_per_m = np.abs(1 / final[valid] - 1 / d_sim[valid])
    assert error_per_m.max() <= (0 if representation == "depth" else LIMIT_PER_M * 1.001)
