"""Conditional U-Net eps_theta(d_k (+) c, k) (paper III-B1): encoder-decoder, skips, attention in the middle.

Space-to-depth folds f x f pixels into channels before the network and back after it: with f = 4 a 180x320
map is 45x80x16, and a convolution costs a sixteenth. Strided layers are space-to-depth and a matrix product
as well, the shape that CPUs and accelerators are fast at.
"""

import math
from collections.abc import Sequence

import flax.linen as nn
import jax.numpy as jnp
from jax import Array
from jaxtyping import Float, Float32, Int

from ddgrasp.arrays import AnyArray
from learning.layers import depth_to_space, sinusoids, space_to_depth, time_frequencies

GROUPS = 8


class ResBlock(nn.Module):
    """Two 3x3 convolutions with group normalisation; the time embedding scales and shifts between them."""

    width: int

    @nn.compact
    def __call__(
        self, x: Float[Array, "B H W C"], time: Float[Array, "B T"]
    ) -> Float[Array, "B H W {self.width}"]:
        """(B, H, W, C), time embedding (B, T) -> (B, H, W, width)."""
        groups = math.gcd(GROUPS, self.width)
        h = nn.silu(nn.GroupNorm(math.gcd(GROUPS, x.shape[-1]))(x))
        h = nn.Conv(self.width, (3, 3))(h)
        scale, shift = jnp.split(nn.Dense(2 * self.width)(time)[:, None, None], 2, axis=-1)
        h = nn.silu(nn.GroupNorm(groups)(h) * (1 + scale) + shift)
        h = nn.Conv(self.width, (3, 3), kernel_init=nn.initializers.zeros)(h)
        if x.shape[-1] != self.width:
            x = nn.Dense(self.width)(x)
        return x + h


class SelfAttention(nn.Module):
    """Attention between all positions of a feature map, as a residual."""

    heads: int

    @nn.compact
    def __call__(self, x: Float[Array, "B H W C"]) -> Float[Array, "B H W C"]:
        """(B, H, W, C) -> same."""
        b, h, w, c = x.shape
        tokens = nn.GroupNorm(math.gcd(GROUPS, c))(x).reshape(b, h * w, c)
        out = nn.MultiHeadDotProductAttention(self.heads, out_kernel_init=nn.initializers.zeros)(tokens)
        return x + out.reshape(b, h, w, c)


class UNet(nn.Module):
    """Maps x_k and the prior c to the clean map; `ddg_jax/train.py` turns it into the noise.

    Attributes:
      widths: channels per level; every level halves the one before in height and width.
      blocks: residual blocks per level, in the encoder and again in the decoder.
      heads: attention heads in the middle (0: no attention).
      factor: space-to-depth before and depth-to-space after the network.
      position: whether the network knows where in the picture it is, by a learnt embedding that is added to
        what it sees (Dosovitskiy et al. 2021, section 3.1). It then takes maps of the size that it was
        initialised with. A camera's own defects stay at their pixels, wherever it looks: dust, a corner
        that the lens leaves dark, where its projector is too bright.
    """

    widths: Sequence[int]
    blocks: Sequence[int]
    heads: int
    factor: int
    position: bool = False

    @nn.compact
    def __call__(
        self, x_k: Float[AnyArray, "B H W C"], c: Float[AnyArray, "B H W"], step: Int[AnyArray, " B"]
    ) -> Float32[Array, "B H W C"]:
        """x_k (B, H, W, C), c (B, H, W), step (B,) int -> (B, H, W, C) float32."""
        height, width, maps = x_k.shape[1:]
        both = self._padded(jnp.concatenate([x_k, c[..., None]], axis=-1))
        folded = space_to_depth(both, self.factor)
        time = self._time_embedding(step)
        h = nn.Dense(self.widths[0])(folded)
        if self.position:
            h = h + self.param("position", nn.initializers.zeros, h.shape[1:])
        h, skips = self._encode(h, time)
        h = ResBlock(self.widths[-1])(h, time)
        if self.heads:
            h = SelfAttention(self.heads)(h)
        h = ResBlock(self.widths[-1])(h, time)
        h = self._decode(h, skips, time)
        # How much of x_k may reach the output past the bottlenecks depends on how noisy it is.
        scale, shift = jnp.split(nn.Dense(2 * self.widths[0])(time)[:, None, None], 2, axis=-1)
        h = nn.silu(h * (1 + scale) + shift)
        size = maps * self.factor**2
        out = nn.Conv(size, (3, 3), kernel_init=nn.initializers.zeros)(h)
        out = out + nn.Dense(size, kernel_init=nn.initializers.zeros)(folded[..., maps :: maps + 1])
        return depth_to_space(out, self.factor)[:, :height, :width]

    def _padded(self, x: Array) -> Array:
        """Zeros at the bottom and right up to the next multiple of the total stride."""
        stride = self.factor * 2 ** (len(self.widths) - 1)
        return jnp.pad(x, ((0, 0), (0, -x.shape[1] % stride), (0, -x.shape[2] % stride), (0, 0)))

    def _time_embedding(self, step: AnyArray) -> Array:
        size = 4 * self.widths[0]
        time = nn.Dense(size)(sinusoids(step, time_frequencies(size, jnp), cosine_first=True))
        return nn.silu(nn.Dense(size)(nn.silu(time)))

    def _encode(self, h: Array, time: Array) -> tuple[Array, list[Array]]:
        skips = []
        for level, (width, blocks) in enumerate(zip(self.widths, self.blocks, strict=True)):
            if level:
                h = nn.Dense(width)(space_to_depth(h, 2))
            for _ in range(blocks):
                h = ResBlock(width)(h, time)
            skips.append(h)
        return h, skips

    def _decode(self, h: Array, skips: list[Array], time: Array) -> Array:
        for level in reversed(range(len(self.widths))):
            width = self.widths[level]
            h = nn.Dense(width)(jnp.concatenate([h, skips[level]], axis=-1))
            for _ in range(self.blocks[level]):
                h = ResBlock(width)(h, time)
            if level:
                h = depth_to_space(nn.Dense(4 * self.widths[level - 1])(h), 2)
        return h
