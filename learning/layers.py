"""Layers without parameters: sinusoids of a step, folding pixels into channels, ResNet's pooling.

Trained weights depend on every order stated here.
"""

import math
from types import ModuleType

import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.typing import ArrayLike
from jaxtyping import Float32, Real, Shaped

from ddgrasp.arrays import AnyArray

MAX_PERIOD = 10_000.0


def time_frequencies(size: int, xp: ModuleType = np) -> Float32[AnyArray, " {size}//2"]:
    """(size / 2,) float32 angular frequencies MAX_PERIOD^(-2i / size) (Vaswani et al. 2017, section 3.5).

    Args:
      size: length of the embedding.
      xp: numpy rounds once, at the end; jax.numpy computes in float32. Their last digits differ, so a network
        keeps the one it was trained with.
    """
    half = size // 2
    return xp.exp(-math.log(MAX_PERIOD) * xp.arange(half) / half).astype(xp.float32)


def sinusoids(
    position: Real[ArrayLike, "*batch"],
    frequencies: Float32[AnyArray, " n"],
    *,
    cosine_first: bool,
    xp: ModuleType = jnp,
) -> Float32[AnyArray, "*batch 2*n"]:
    """(...,) positions and (n,) frequencies to (..., 2n): all sines then all cosines, or the other way round.

    Args:
      xp: jax.numpy, or numpy for constants.
    """
    angles = xp.asarray(position).astype(xp.float32)[..., None] * frequencies
    pair = (xp.sin(angles), xp.cos(angles))
    return xp.concatenate(pair[::-1] if cosine_first else pair, axis=-1)


def space_to_depth(
    x: Shaped[Array, "B H W C"], factor: int
) -> Shaped[Array, "B H//{factor} W//{factor} C*{factor}**2"]:
    """(B, H, W, C) -> (B, H/f, W/f, f*f*C); H and W divisible by `factor`.

    Within a patch pixels go row by row, and a pixel's channels stay together: channel (i f + j) C + c is
    channel c of the patch's pixel in row i and column j.
    """
    b, h, w, c = x.shape
    x = x.reshape(b, h // factor, factor, w // factor, factor, c)
    return x.transpose(0, 1, 3, 2, 4, 5).reshape(b, h // factor, w // factor, factor * factor * c)


def depth_to_space(
    x: Shaped[Array, "B H W C"], factor: int
) -> Shaped[Array, "B H*{factor} W*{factor} C//{factor}**2"]:
    """(B, H, W, f*f*C) -> (B, H*f, W*f, C): inverse of `space_to_depth`."""
    b, h, w, c = x.shape
    x = x.reshape(b, h, w, factor, factor, c // factor**2)
    return x.transpose(0, 1, 3, 2, 4, 5).reshape(b, h * factor, w * factor, c // factor**2)


def resnet_max_pool(x: Float32[Array, "B H W C"]) -> Float32[Array, "B H//2 W//2 C"]:
    """(B, H, W, C), at least 0, H and W even -> (B, H/2, W/2, C): maxima of 3x3 pixels, stride 2, padding 1.

    Slices and maxima, an axis at a time: `nn.max_pool`'s gradient is a select-and-scatter, for which a CPU
    takes four times as long.
    """
    return _max_of_three(_max_of_three(x, 1), 2)


def _max_of_three(x: Array, axis: int) -> Array:
    """The maximum of every second pixel along `axis` and the two beside it; 0 before the first."""
    pairs = x.reshape(*x.shape[:axis], x.shape[axis] // 2, 2, *x.shape[axis + 1 :])
    even, odd = (lax.index_in_dim(pairs, i, axis + 1, keepdims=False) for i in (0, 1))
    before = lax.slice_in_dim(odd, 0, odd.shape[axis] - 1, axis=axis)
    before = jnp.pad(before, [(int(i == axis), 0) for i in range(x.ndim)])
    return jnp.maximum(jnp.maximum(even, odd), before)
