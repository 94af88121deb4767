"""Sinusoids of a step and folding of pixels into channels, in the orders that trained weights know."""

import jax
import jax.numpy as jnp
import numpy as np
from flax import linen as nn

from learning.layers import depth_to_space, resnet_max_pool, sinusoids, space_to_depth, time_frequencies
from student_jax import denoiser


def test_space_to_depth_orders_and_inverts():
    x = jnp.arange(2 * 4 * 6).reshape(2, 4, 6, 1)
    folded = space_to_depth(x, 2)
    assert folded.shape == (2, 2, 3, 4)
    assert folded[0, 0, 0].tolist() == [0, 1, 6, 7]
    np.testing.assert_array_equal(depth_to_space(folded, 2), x)


def test_space_to_depth_by_hand():
    x = jnp.arange(2 * 4 * 1).reshape(1, 2, 4, 1)
    assert np.asarray(space_to_depth(x, 2))[0, 0].tolist() == [[0, 1, 4, 5], [2, 3, 6, 7]]


def test_channels_of_a_pixel_stay_together():
    x = jnp.arange(2 * 2 * 3).reshape(1, 2, 2, 3)
    folded = space_to_depth(x, 2)
    assert folded.shape == (1, 1, 1, 12)
    for i, j, channel in ((0, 0, 2), (0, 1, 0), (1, 0, 1)):
        assert folded[0, 0, 0, (2 * i + j) * 3 + channel] == x[0, i, j, channel]
    np.testing.assert_array_equal(depth_to_space(folded, 2), x)


def test_time_embedding_by_value():
    embedded = denoiser.embed_time(jnp.array([0, 3]), 4)
    np.testing.assert_allclose(embedded[0], [0, 0, 1, 1], atol=1e-6)
    np.testing.assert_allclose(embedded[1], [np.sin(3), np.sin(0.03), np.cos(3), np.cos(0.03)], atol=1e-6)


def test_the_two_orders_of_sinusoids():
    step, frequencies = np.array([2, 5]), time_frequencies(6)
    np.testing.assert_allclose(frequencies, [1, 10_000 ** (-1 / 3), 10_000 ** (-2 / 3)], rtol=1e-6)
    sines_first = np.asarray(sinusoids(step, frequencies, cosine_first=False))
    np.testing.assert_allclose(sines_first[:, 3:], np.cos(step[:, None] * frequencies), atol=1e-6)
    cosines_first = np.asarray(sinusoids(step, frequencies, cosine_first=True))
    np.testing.assert_array_equal(cosines_first, np.roll(sines_first, 3, axis=1))
    assert sinusoids(7, frequencies, cosine_first=True, xp=np).shape == (6,)


def test_frequencies_rounded_once_or_at_every_step_agree_to_the_last_digits():
    np.testing.assert_allclose(time_frequencies(128), time_frequencies(128, jnp), rtol=1e-6)


def test_resnet_s_pooling_is_flax_s_with_its_gradient():
    rng = np.random.default_rng(0)
    x = jnp.asarray(np.maximum(rng.normal(size=(2, 6, 10, 3)), 0.0).astype(np.float32))
    weight = jnp.asarray(rng.normal(size=(2, 3, 5, 3)).astype(np.float32))

    def flax_s(x):
        padded = jnp.pad(x, ((0, 0), (1, 1), (1, 1), (0, 0)))
        return nn.max_pool(padded, window_shape=(3, 3), strides=(2, 2), padding="VALID")

    values, gradients = zip(
        *(
            (pool(x), jax.grad(lambda x, pool=pool: jnp.sum(pool(nn.relu(x)) * weight))(x))
            for pool in (flax_s, resnet_max_pool)
        ),
        strict=True,
    )
    np.testing.assert_array_equal(*values)
    np.testing.assert_allclose(*gradients, atol=1e-6)
