"""DINOv2's vision transformer (Oquab et al. 2023; Dosovitskiy et al. 2021), the encoder of both depth
networks.

Here and in the other network files a module's name is its path in the published checkpoint, dots included, so
that a parameter is found in both under the same name (foundation/convert.py relies on it).
"""

import jax
import jax.numpy as jnp
from flax import linen as nn
from jax import Array
from jax.typing import DTypeLike
from jaxtyping import Float

from foundation.attention import attend
from foundation.resample import resize_cubic
from foundation.sizes import PATCH_PX, DepthSize

TABLE_SIDE = 37
"""Side of the trained grid of position embeddings: pictures of 518 x 518."""
TABLE_OFFSET = 0.1
"""Added to the wanted grid's side where the table is resampled, as DINOv2 was trained and published."""
NORM_EPSILON = 1e-6
MLP_RATIO = 4

Tokens = Float[Array, "B N C"]


def layer_norm(name: str, epsilon: float, dtype: DTypeLike) -> nn.LayerNorm:
    """LayerNorm whose variance is taken about the mean, not as a difference of large numbers."""
    return nn.LayerNorm(epsilon=epsilon, use_fast_variance=False, dtype=dtype, name=name)


class Attention(nn.Module):
    """Multi-head self-attention, one fused projection for queries, keys and values."""

    heads: int
    dtype: DTypeLike

    @nn.compact
    def __call__(self, x: Tokens) -> Tokens:
        """(B, N, C) -> (B, N, C)."""
        batch, tokens, width = x.shape
        qkv = nn.Dense(3 * width, dtype=self.dtype, name="qkv")(x)
        q, k, v = jnp.moveaxis(qkv.reshape(batch, tokens, 3, self.heads, width // self.heads), 2, 0)
        mixed = attend(q, k, v)
        return nn.Dense(width, dtype=self.dtype, name="proj")(mixed.reshape(batch, tokens, width))


class Mlp(nn.Module):
    """Two dense layers with the exact (erf) GELU between."""

    dtype: DTypeLike

    @nn.compact
    def __call__(self, x: Tokens) -> Tokens:
        """(B, N, C) -> (B, N, C)."""
        width = x.shape[-1]
        x = jax.nn.gelu(nn.Dense(MLP_RATIO * width, dtype=self.dtype, name="fc1")(x), approximate=False)
        return nn.Dense(width, dtype=self.dtype, name="fc2")(x)


class LayerScale(nn.Module):
    """A learnt gain per channel (Touvron et al. 2021, eq. 3)."""

    dtype: DTypeLike

    @nn.compact
    def __call__(self, x: Tokens) -> Tokens:
        """(B, N, C) -> (B, N, C)."""
        gamma = self.param("gamma", nn.initializers.ones, (x.shape[-1],))
        return x * jnp.asarray(gamma, self.dtype)


class Block(nn.Module):
    """Pre-norm transformer block: x += ls1 attn(norm1 x); x += ls2 mlp(norm2 x)."""

    heads: int
    dtype: DTypeLike

    @nn.compact
    def __call__(self, x: Tokens) -> Tokens:
        """(B, N, C) -> (B, N, C)."""
        y = layer_norm("norm1", NORM_EPSILON, self.dtype)(x)
        x = x + LayerScale(self.dtype, name="ls1")(Attention(self.heads, self.dtype, name="attn")(y))
        y = layer_norm("norm2", NORM_EPSILON, self.dtype)(x)
        return x + LayerScale(self.dtype, name="ls2")(Mlp(self.dtype, name="mlp")(y))


def resize_positions(
    table: Float[Array, "1 1370 C"], grid: tuple[int, int]
) -> Float[Array, "1 1+{grid[0]}*{grid[1]} C"]:
    """(1, 1 + 37*37, C) position embeddings -> (1, 1 + rows*columns, C) for a `grid` of (rows, columns)
    patches.

    The first row belongs to the class token and stays.
    """
    if grid == (TABLE_SIDE, TABLE_SIDE):
        return table
    channels = table.shape[-1]
    spatial = table[:, 1:].reshape(1, TABLE_SIDE, TABLE_SIDE, channels)
    spatial = resize_cubic(spatial, grid, TABLE_OFFSET)
    return jnp.concatenate([table[:, :1], spatial.reshape(1, -1, channels)], axis=1)


class VisionTransformer(nn.Module):
    """Pictures to the normalised patch tokens of the four tapped blocks."""

    size: DepthSize
    dtype: DTypeLike = jnp.float32

    @nn.compact
    def __call__(
        self, x: Float[Array, "B H W 3"]
    ) -> tuple[Float[Array, "B H//14 W//14 {self.size.width}"], ...]:
        """(B, 14 gh, 14 gw, 3) standardised RGB -> four (B, gh, gw, width), shallowest tap first."""
        size, dtype = self.size, self.dtype
        patches = nn.Conv(
            size.width, (PATCH_PX,) * 2, (PATCH_PX,) * 2, "VALID", dtype=dtype, name="patch_embed.proj"
        )(x)
        batch, *grid, width = patches.shape
        class_token = self.param("cls_token", nn.initializers.normal(1e-6), (1, 1, width))
        table_shape = (1, 1 + TABLE_SIDE**2, width)
        table = self.param("pos_embed", nn.initializers.truncated_normal(0.02), table_shape)
        tokens = jnp.concatenate(
            [
                jnp.broadcast_to(jnp.asarray(class_token, dtype), (batch, 1, width)),
                patches.reshape(batch, -1, width),
            ],
            axis=1,
        )
        tokens = tokens + jnp.asarray(resize_positions(table, (grid[0], grid[1])), dtype)
        self.sow("intermediates", "tokens_in", tokens)
        norm, taps = layer_norm("norm", NORM_EPSILON, dtype), []
        for index in range(size.taps[-1] + 1):
            tokens = Block(size.heads, dtype, name=f"blocks.{index}")(tokens)
            if index in size.taps:
                taps.append(norm(tokens)[:, 1:].reshape(batch, *grid, width))
        return tuple(taps)
