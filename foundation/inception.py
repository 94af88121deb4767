"""The Inception-v3 (Szegedy et al. 2016) that FID is defined by, in pytorch-fid's version.

It was converted from TensorFlow's graph of 2015-12-05 and differs from torchvision's network: average pools
leave padding out, and the last mixed block pools by maximum.
"""

from collections.abc import Sequence

import jax.numpy as jnp
from flax import linen as nn
from jax import Array
from jax.typing import DTypeLike
from jaxtyping import Float, Float32

from foundation.resample import resize_half_pixel

SIDE_PX = 299
FEATURES = 2048
NORM_EPSILON = 1e-3

_BORDER = ((0, 0), (1, 1), (1, 1), (0, 0))
Step = tuple[str, int, int, int]
"""A convolution: name, channels, kernel rows, kernel columns."""
Map = Float[Array, "B h w c"]


class ConvNorm(nn.Module):
    """relu(bn(conv x)), no bias."""

    channels: int
    kernel: tuple[int, int]
    stride: int
    pad: bool
    dtype: DTypeLike

    @nn.compact
    def __call__(self, x: Map) -> Float[Array, "B rows columns {self.channels}"]:
        """(B, h, w, c) -> (B, rows, columns, channels)."""
        padding = [(size // 2, size // 2) if self.pad else (0, 0) for size in self.kernel]
        x = nn.Conv(
            self.channels,
            self.kernel,
            (self.stride,) * 2,
            padding,
            use_bias=False,
            dtype=self.dtype,
            name="conv",
        )(x)
        return nn.relu(
            nn.BatchNorm(use_running_average=True, epsilon=NORM_EPSILON, dtype=self.dtype, name="bn")(x)
        )


def average_pool(x: Map) -> Map:
    """3x3, stride 1, same size: the mean over the pixels that exist."""

    def pooled(values: Array) -> Array:
        return nn.avg_pool(jnp.pad(values, _BORDER), window_shape=(3, 3), strides=(1, 1))

    return pooled(x) / pooled(jnp.ones((1, *x.shape[1:3], 1), x.dtype))


def max_pool(x: Map, stride: int) -> Float[Array, "B rows columns c"]:
    """3x3 of values >= 0; stride 1 keeps the size, stride 2 is not padded."""
    x = jnp.pad(x, _BORDER) if stride == 1 else x
    return nn.max_pool(x, window_shape=(3, 3), strides=(stride, stride))


class Mixed(nn.Module):
    """Base of the mixed blocks: named chains of convolutions side by side."""

    dtype: DTypeLike

    def chain(
        self, x: Map, steps: Sequence[Step], last_stride: int = 1
    ) -> Float[Array, "B rows columns {steps[-1][1]}"]:
        """Convolutions one after the other; only the last one may have stride 2, and then no padding."""
        for index, (name, channels, rows, columns) in enumerate(steps):
            stride = last_stride if index == len(steps) - 1 else 1
            x = ConvNorm(channels, (rows, columns), stride, stride == 1, self.dtype, name=name)(x)
        return x


class MixedA(Mixed):
    """Mixed_5b, 5c, 5d."""

    pool_channels: int

    @nn.compact
    def __call__(self, x: Map) -> Float[Array, "B h w 224+{self.pool_channels}"]:
        """The same sides."""
        double = [("branch3x3dbl_1", 64, 1, 1), ("branch3x3dbl_2", 96, 3, 3), ("branch3x3dbl_3", 96, 3, 3)]
        parts = [
            self.chain(x, [("branch1x1", 64, 1, 1)]),
            self.chain(x, [("branch5x5_1", 48, 1, 1), ("branch5x5_2", 64, 5, 5)]),
            self.chain(x, double),
            self.chain(average_pool(x), [("branch_pool", self.pool_channels, 1, 1)]),
        ]
        return jnp.concatenate(parts, -1)


class MixedB(Mixed):
    """Mixed_6a: halves the sides."""

    @nn.compact
    def __call__(self, x: Map) -> Float[Array, "B (h-1)//2 (w-1)//2 480+c"]:
        """(B, h, w, c) -> 480 channels, then the input's, pooled."""
        double = [("branch3x3dbl_1", 64, 1, 1), ("branch3x3dbl_2", 96, 3, 3), ("branch3x3dbl_3", 96, 3, 3)]
        parts = [self.chain(x, [("branch3x3", 384, 3, 3)], 2), self.chain(x, double, 2), max_pool(x, 2)]
        return jnp.concatenate(parts, -1)


class MixedC(Mixed):
    """Mixed_6b to 6e: 7x7 convolutions in two factors."""

    inner: int

    @nn.compact
    def __call__(self, x: Map) -> Float[Array, "B h w 768"]:
        """The same sides."""
        c = self.inner
        single = [("branch7x7_1", c, 1, 1), ("branch7x7_2", c, 1, 7), ("branch7x7_3", 192, 7, 1)]
        double = [
            ("branch7x7dbl_1", c, 1, 1),
            ("branch7x7dbl_2", c, 7, 1),
            ("branch7x7dbl_3", c, 1, 7),
            ("branch7x7dbl_4", c, 7, 1),
            ("branch7x7dbl_5", 192, 1, 7),
        ]
        parts = [
            self.chain(x, [("branch1x1", 192, 1, 1)]),
            self.chain(x, single),
            self.chain(x, double),
            self.chain(average_pool(x), [("branch_pool", 192, 1, 1)]),
        ]
        return jnp.concatenate(parts, -1)


class MixedD(Mixed):
    """Mixed_7a: halves the sides."""

    @nn.compact
    def __call__(self, x: Map) -> Float[Array, "B (h-1)//2 (w-1)//2 512+c"]:
        """(B, h, w, c) -> 512 channels, then the input's, pooled."""
        factored = [
            ("branch7x7x3_1", 192, 1, 1),
            ("branch7x7x3_2", 192, 1, 7),
            ("branch7x7x3_3", 192, 7, 1),
            ("branch7x7x3_4", 192, 3, 3),
        ]
        single = [("branch3x3_1", 192, 1, 1), ("branch3x3_2", 320, 3, 3)]
        return jnp.concatenate([self.chain(x, single, 2), self.chain(x, factored, 2), max_pool(x, 2)], -1)


class MixedE(Mixed):
    """Mixed_7b, 7c: two chains end in a 1x3 and a 3x1 side by side."""

    pool_by_maximum: bool

    @nn.compact
    def __call__(self, x: Map) -> Float[Array, "B h w 2048"]:
        """The same sides."""
        single = self.chain(x, [("branch3x3_1", 384, 1, 1)])
        double = self.chain(x, [("branch3x3dbl_1", 448, 1, 1), ("branch3x3dbl_2", 384, 3, 3)])
        pooled = max_pool(x, 1) if self.pool_by_maximum else average_pool(x)
        parts = [
            self.chain(x, [("branch1x1", 320, 1, 1)]),
            self.chain(single, [("branch3x3_2a", 384, 1, 3)]),
            self.chain(single, [("branch3x3_2b", 384, 3, 1)]),
            self.chain(double, [("branch3x3dbl_3a", 384, 1, 3)]),
            self.chain(double, [("branch3x3dbl_3b", 384, 3, 1)]),
            self.chain(pooled, [("branch_pool", 192, 1, 1)]),
        ]
        return jnp.concatenate(parts, -1)


class FidInception(nn.Module):
    """RGB in [0, 1] to the features that FID compares."""

    dtype: DTypeLike = jnp.float32

    @nn.compact
    def __call__(self, x: Float[Array, "B H W 3"]) -> Float32[Array, f"B {FEATURES}"]:
        """(B, H, W, 3) of any size, in [0, 1] -> (B, 2048) float32."""
        dtype = self.dtype

        def conv(name: str, channels: int, kernel: int, stride: int = 1, pad: bool = False) -> ConvNorm:
            return ConvNorm(channels, (kernel, kernel), stride, pad, dtype, name=name)

        x = 2 * resize_half_pixel(x, (SIDE_PX, SIDE_PX)) - 1
        self.sow("intermediates", "net_input", x)
        x = conv("Conv2d_1a_3x3", 32, 3, 2)(x)
        x = conv("Conv2d_2a_3x3", 32, 3)(x)
        x = max_pool(conv("Conv2d_2b_3x3", 64, 3, pad=True)(x), 2)
        x = conv("Conv2d_3b_1x1", 80, 1)(x)
        x = max_pool(conv("Conv2d_4a_3x3", 192, 3)(x), 2)
        for name, channels in (("5b", 32), ("5c", 64), ("5d", 64)):
            x = MixedA(dtype, channels, name=f"Mixed_{name}")(x)
        x = MixedB(dtype, name="Mixed_6a")(x)
        for name, channels in (("6b", 128), ("6c", 160), ("6d", 160), ("6e", 192)):
            x = MixedC(dtype, channels, name=f"Mixed_{name}")(x)
        x = MixedD(dtype, name="Mixed_7a")(x)
        x = MixedE(dtype, False, name="Mixed_7b")(x)
        x = MixedE(dtype, True, name="Mixed_7c")(x)
        return x.astype(jnp.float32).mean((1, 2))
