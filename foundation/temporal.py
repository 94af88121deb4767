"""The motion module of Video Depth Anything (Chen et al. 2025): every pixel attends over time at its own
place.
"""

import jax
import jax.numpy as jnp
import numpy as np
from flax import linen as nn
from jax import Array
from jax.typing import DTypeLike
from jaxtyping import Float, Float32

from foundation.attention import attend
from foundation.vit import layer_norm

MAX_FRAMES = 32
"""Rows of the table of time embeddings: the longest clip that the network takes."""
HEADS = 8
GROUPS = 32
GROUP_NORM_EPSILON = 1e-6
LAYER_NORM_EPSILON = 1e-5
ATTENTIONS = 2
FEED_FORWARD_RATIO = 4

InTime = Float[Array, "N T C"]


def time_table(channels: int) -> Float32[np.ndarray, "1 32 {channels}"]:
    """(1, MAX_FRAMES, channels) sinusoids: sin(t w_j) at channel 2j, cos(t w_j) at 2j+1, w_j = 10000^(-2j/C).

    Vaswani et al. 2017, section 3.5.
    """
    angle = np.arange(MAX_FRAMES)[:, None] * 10000.0 ** (-np.arange(0, channels, 2) / channels)
    return np.stack([np.sin(angle), np.cos(angle)], -1).reshape(1, MAX_FRAMES, channels).astype(np.float32)


class TimeAttention(nn.Module):
    """Self-attention over time; queries, keys and values all see the time embedding."""

    dtype: DTypeLike

    @nn.compact
    def __call__(self, x: InTime) -> InTime:
        """(N, T, C) normalised -> (N, T, C)."""
        count, frames, channels = x.shape
        table = self.param("pos_encoder.pe", lambda _: jnp.asarray(time_table(channels)))
        x = x + jnp.asarray(table[:, :frames], self.dtype)
        heads = (count, frames, HEADS, channels // HEADS)
        q, k, v = (
            nn.Dense(channels, use_bias=False, dtype=self.dtype, name=name)(x).reshape(heads)
            for name in ("to_q", "to_k", "to_v")
        )
        mixed = attend(q, k, v)
        return nn.Dense(channels, dtype=self.dtype, name="to_out.0")(mixed.reshape(x.shape))


class GatedFeedForward(nn.Module):
    """a gelu(b) between two dense layers, (a, b) the halves of the first one's output (Shazeer 2020)."""

    dtype: DTypeLike

    @nn.compact
    def __call__(self, x: InTime) -> InTime:
        """(N, T, C) -> (N, T, C)."""
        channels = x.shape[-1]
        inner = nn.Dense(2 * FEED_FORWARD_RATIO * channels, dtype=self.dtype, name="net.0.proj")(x)
        value, gate = jnp.split(inner, 2, axis=-1)
        value = value * jax.nn.gelu(gate, approximate=False)
        return nn.Dense(channels, dtype=self.dtype, name="net.2")(value)


class TimeBlock(nn.Module):
    """Two attentions over time and a feed-forward, each on the normalised sum so far."""

    dtype: DTypeLike

    @nn.compact
    def __call__(self, x: InTime) -> InTime:
        """(N, T, C) -> (N, T, C)."""
        for index in range(ATTENTIONS):
            y = layer_norm(f"norms.{index}", LAYER_NORM_EPSILON, self.dtype)(x)
            x = x + TimeAttention(self.dtype, name=f"attention_blocks.{index}")(y)
        y = layer_norm("ff_norm", LAYER_NORM_EPSILON, self.dtype)(x)
        return x + GatedFeedForward(self.dtype, name="ff")(y)


class MotionModule(nn.Module):
    """GroupNorm per frame, dense, a `TimeBlock` along time, dense, added to the input."""

    dtype: DTypeLike = jnp.float32

    @nn.compact
    def __call__(self, x: Float[Array, "N h w C"], frames: int) -> Float[Array, "N h w C"]:
        """(B * T, h, w, C), T = `frames` the faster index -> the same shape."""
        count, height, width, channels = x.shape
        y = nn.GroupNorm(
            GROUPS,
            epsilon=GROUP_NORM_EPSILON,
            use_fast_variance=False,
            dtype=self.dtype,
            name="temporal_transformer.norm",
        )(x)
        y = nn.Dense(channels, dtype=self.dtype, name="temporal_transformer.proj_in")(y)
        y = y.reshape(count // frames, frames, height * width, channels).swapaxes(1, 2)
        block = TimeBlock(self.dtype, name="temporal_transformer.transformer_blocks.0")
        y = block(y.reshape(-1, frames, channels))
        y = y.reshape(count // frames, height * width, frames, channels).swapaxes(1, 2)
        y = nn.Dense(
            channels,
            kernel_init=nn.initializers.zeros,
            dtype=self.dtype,
            name="temporal_transformer.proj_out",
        )(y)
        return x + y.reshape(x.shape)
