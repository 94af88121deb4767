"""Space-to-depth, the U-Net's shape rules, depth normalisation and grafting."""

import jax
import jax.numpy as jnp
import numpy as np

from ddg_jax import normalise
from ddg_jax.graft import artefact_mask, graft, graft_mask
from ddg_jax.unet import UNet, depth_to_space, space_to_depth


def test_space_to_depth_orders_and_inverts():
    x = jnp.arange(2 * 4 * 6).reshape(2, 4, 6, 1)
    folded = space_to_depth(x, 2)
    assert folded.shape == (2, 2, 3, 4)
    assert folded[0, 0, 0].tolist() == [0, 1, 6, 7]
    np.testing.assert_array_equal(depth_to_space(folded, 2), x)


def test_unet_takes_any_size_and_sees_prior_and_step():
    net = UNet((8, 8), (0, 1), 2, 4)
    x, c = jax.random.normal(jax.random.key(0), (2, 2, 18, 21))
    params = net.init(jax.random.key(1), x, c, jnp.zeros(2, int))
    params = jax.tree.map(lambda p: p + 0.05, params)
    out = net.apply(params, x, c, jnp.array([3, 3]))
    assert out.shape == (2, 18, 21) and out.dtype == jnp.float32
    assert not np.allclose(out, net.apply(params, x, c + 1, jnp.array([3, 3])))
    assert not np.allclose(out, net.apply(params, x, c, jnp.array([3, 900]))[1], atol=1e-4)
    np.testing.assert_allclose(net.apply(params, x[:1], c[:1], jnp.array([3])), out[:1], atol=1e-5)


def test_depth_survives_the_diffusion_space_and_holes_are_far_away():
    depth = jnp.array([0.0, 0.25, 0.5, 1.0, 9.0])
    x = normalise.to_diffusion(depth, 0.25, 10.0)
    # 1/d from 1/10 to 1/0.25: 0.5 m is (2 - 0.1) / (4 - 0.1)
    np.testing.assert_allclose(x, [-1, 1, 1.9 / 3.9, 0.9 / 3.9, (1 / 9 - 0.1) / 3.9], atol=1e-6)
    np.testing.assert_allclose(normalise.to_depth(x, 0.25, 10.0, -0.5), depth, rtol=1e-5)
    assert normalise.to_depth(jnp.array([-0.51]), 0.25, 10.0, -0.5)[0] == 0.0
    np.testing.assert_allclose(
        normalise.to_depth(jnp.array([-0.4, 2.0]), 0.25, 10.0, -0.5), [10, 0.25], rtol=1e-6
    )
    assert normalise.to_diffusion(jnp.array([60.0, 0.1]), 0.25, 10.0).tolist() == [0.0, 1.0]


def test_grafting_is_the_papers_equation_bit_for_bit():
    rng = np.random.default_rng(0)
    d_sim = rng.uniform(0.3, 2.0, (3, 5, 7)).astype(np.float32)
    x = rng.uniform(-1, 1, d_sim.shape).astype(np.float32)
    mask = np.asarray(artefact_mask(x, -0.5))
    d_pred = normalise.to_depth(x, 0.25, 10.0, -0.5)
    final = np.asarray(graft_mask(d_sim, d_pred, mask))
    assert 0 < mask.mean() < 1
    np.testing.assert_array_equal(final, d_sim * (1 - mask) + np.asarray(d_pred) * mask)
    assert final[~mask].tobytes() == d_sim[~mask].tobytes()
    assert (final[mask] == 0).all()
    np.testing.assert_array_equal(graft_mask(final, d_pred, mask), final)
    np.testing.assert_array_equal(graft(d_sim, d_pred, 0.1), final)
