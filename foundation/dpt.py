"""The dense prediction head (Ranftl et al. 2021, section 3) of both depth networks, in two parts.

`CoarseHead` ends where the video network's motion modules end and sees whole clips; `FineHead` works on
single frames at the finer resolutions, where memory goes. Both read one tree of parameters.
"""

import jax.numpy as jnp
from flax import linen as nn
from jax import Array
from jax.typing import DTypeLike
from jaxtyping import Float, Float32

from foundation.resample import resize_corners
from foundation.sizes import PATCH_PX, DepthSize
from foundation.temporal import MotionModule

FINE_CHANNELS = 32
"""Channels of the output convolutions at full resolution."""
UPSCALING = (4, 2)
"""By how much the two finest maps are enlarged before the fusion."""


def conv3(channels: int, name: str, dtype: DTypeLike, *, stride: int = 1, bias: bool = True) -> nn.Conv:
    """3x3 convolution, one pixel of zeros on every side."""
    return nn.Conv(channels, (3, 3), (stride,) * 2, ((1, 1), (1, 1)), use_bias=bias, dtype=dtype, name=name)


def conv1(channels: int, name: str, dtype: DTypeLike) -> nn.Conv:
    """1x1 convolution."""
    return nn.Conv(channels, (1, 1), dtype=dtype, name=name)


class Upscale(nn.Module):
    """Transposed convolution whose stride is its kernel's side: every pixel becomes a block of pixels."""

    channels: int
    factor: int
    dtype: DTypeLike

    @nn.compact
    def __call__(
        self, x: Float[Array, "B h w c"]
    ) -> Float[Array, "B {self.factor}*h {self.factor}*w {self.channels}"]:
        """(B, h, w, c) -> (B, factor h, factor w, channels)."""
        batch, height, width, inner = x.shape
        shape = (self.factor, self.factor, inner, self.channels)
        kernel = self.param("transposed_kernel", nn.initializers.lecun_normal(), shape)
        bias = self.param("bias", nn.initializers.zeros, (self.channels,))
        y = jnp.einsum("bhwi,klio->bhkwlo", jnp.asarray(x, self.dtype), jnp.asarray(kernel, self.dtype))
        y = y.reshape(batch, self.factor * height, self.factor * width, self.channels)
        return y + jnp.asarray(bias, self.dtype)


class ResidualConv(nn.Module):
    """x + conv(relu(conv(relu x)))."""

    dtype: DTypeLike

    @nn.compact
    def __call__(self, x: Float[Array, "B h w C"]) -> Float[Array, "B h w C"]:
        """(B, h, w, C) -> the same shape."""
        channels = x.shape[-1]
        y = conv3(channels, "conv1", self.dtype)(nn.relu(x))
        return x + conv3(channels, "conv2", self.dtype)(nn.relu(y))


class Fusion(nn.Module):
    """Adds the finer map to the coarser one, refines, enlarges (Ranftl et al. 2021, figure 1 right)."""

    dtype: DTypeLike

    @nn.compact
    def __call__(
        self, x: Float[Array, "B h w C"], skip: Float[Array, "B h w C"] | None, size: tuple[int, int]
    ) -> Float[Array, "B {size[0]} {size[1]} C"]:
        """(B, h, w, C), finer map of the same shape or None -> (B, *size, C)."""
        if skip is not None:
            x = x + ResidualConv(self.dtype, name="resConfUnit1")(skip)
        x = ResidualConv(self.dtype, name="resConfUnit2")(x)
        return conv1(x.shape[-1], "out_conv", self.dtype)(resize_corners(x, size))


class CoarseHead(nn.Module):
    """Taps to what the finer half needs, motion modules included where there are any."""

    size: DepthSize
    video: bool
    dtype: DTypeLike = jnp.float32

    @nn.compact
    def __call__(
        self, taps: tuple[Float[Array, "N gh gw width"], ...], frames: int = 1
    ) -> tuple[
        Float[Array, "N 2*gh 2*gw features"],
        Float[Array, "N 2*gh 2*gw features"],
        Float[Array, "N 4*gh 4*gw features"],
    ]:
        """Four (B * T, gh, gw, width) taps, T = `frames` -> path_3 and the reduced maps 2 and 1.

        All (B * T, h, w, features), of sides 2 g, 2 g and 4 g.
        """
        size, dtype = self.size, self.dtype

        def in_time(index: int, x: Array) -> Array:
            return MotionModule(dtype, name=f"motion_modules.{index}")(x, frames) if self.video else x

        maps = [
            conv1(channels, f"projects.{index}", dtype)(tap)
            for index, (tap, channels) in enumerate(zip(taps, size.channels, strict=True))
        ]
        for index, factor in enumerate(UPSCALING):
            maps[index] = Upscale(size.channels[index], factor, dtype, name=f"resize_layers.{index}")(
                maps[index]
            )
        maps[3] = conv3(size.channels[3], "resize_layers.3", dtype, stride=2)(maps[3])
        maps[2], maps[3] = in_time(0, maps[2]), in_time(1, maps[3])
        layer_1, layer_2, layer_3, layer_4 = (
            conv3(size.features, f"scratch.layer{index}_rn", dtype, bias=False)(x)
            for index, x in enumerate(maps, start=1)
        )
        path_4 = in_time(2, Fusion(dtype, name="scratch.refinenet4")(layer_4, None, _sides(layer_3)))
        path_3 = in_time(3, Fusion(dtype, name="scratch.refinenet3")(path_4, layer_3, _sides(layer_2)))
        return path_3, layer_2, layer_1


class FineHead(nn.Module):
    """Per-frame rest of the head. The last two convolutions are float32 whatever `dtype` is."""

    size: DepthSize
    dtype: DTypeLike = jnp.float32

    @nn.compact
    def __call__(
        self,
        path_3: Float[Array, "N h w features"],
        layer_2: Float[Array, "N h w features"],
        layer_1: Float[Array, "N 2*h 2*w features"],
    ) -> Float32[Array, "N 7*h 7*w"]:
        """What `CoarseHead` gives -> (N, 14 gh, 14 gw) float32, see `DepthNetwork`."""
        path_2 = Fusion(self.dtype, name="scratch.refinenet2")(path_3, layer_2, _sides(layer_1))
        height, width = _sides(layer_1)
        path_1 = Fusion(self.dtype, name="scratch.refinenet1")(path_2, layer_1, (2 * height, 2 * width))
        x = conv3(self.size.features // 2, "scratch.output_conv1", self.dtype)(path_1)
        x = resize_corners(x, (height // 4 * PATCH_PX, width // 4 * PATCH_PX)).astype(jnp.float32)
        x = nn.relu(conv3(FINE_CHANNELS, "scratch.output_conv2.0", jnp.float32)(x))
        x = conv1(1, "scratch.output_conv2.2", jnp.float32)(x)[..., 0]
        return nn.relu(x)


def _sides(x: Array) -> tuple[int, int]:
    return x.shape[-3], x.shape[-2]
