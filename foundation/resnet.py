"""ResNet-18 (He et al. 2016) as torchvision publishes it, trained on ImageNet."""

import jax.numpy as jnp
from flax import linen as nn
from jax import Array
from jax.typing import DTypeLike
from jaxtyping import Float, Float32

STAGE_CHANNELS = (64, 128, 256, 512)
BLOCKS = 2
"""Basic blocks per stage."""
CLASSES = 1000
NORM_EPSILON = 1e-5


def _conv(channels: int, kernel: int, stride: int, name: str, dtype: DTypeLike) -> nn.Conv:
    pad = kernel // 2
    return nn.Conv(
        channels, (kernel,) * 2, (stride,) * 2, ((pad, pad),) * 2, use_bias=False, dtype=dtype, name=name
    )


def _norm(name: str, dtype: DTypeLike) -> nn.BatchNorm:
    return nn.BatchNorm(use_running_average=True, epsilon=NORM_EPSILON, dtype=dtype, name=name)


class BasicBlock(nn.Module):
    """relu(x' + bn(conv3(relu(bn(conv3 x))))), x' = x, or projected where the shape changes."""

    channels: int
    stride: int
    dtype: DTypeLike

    @nn.compact
    def __call__(self, x: Float[Array, "B h w c"]) -> Float[Array, "B rows columns {self.channels}"]:
        """(B, h, w, c) -> (B, h / stride, w / stride, channels), rounded up."""
        y = _conv(self.channels, 3, self.stride, "conv1", self.dtype)(x)
        y = nn.relu(_norm("bn1", self.dtype)(y))
        y = _norm("bn2", self.dtype)(_conv(self.channels, 3, 1, "conv2", self.dtype)(y))
        if self.stride != 1 or x.shape[-1] != self.channels:
            x = _conv(self.channels, 1, self.stride, "downsample.0", self.dtype)(x)
            x = _norm("downsample.1", self.dtype)(x)
        return nn.relu(x + y)


class ResNet18(nn.Module):
    """Standardised RGB to 512 features and ImageNet's 1000 logits."""

    dtype: DTypeLike = jnp.float32

    @nn.compact
    def __call__(
        self, x: Float[Array, "B H W 3"]
    ) -> tuple[Float32[Array, "B 512"], Float32[Array, f"B {CLASSES}"]]:
        """(B, H, W, 3) -> features (B, 512), logits (B, 1000), float32."""
        dtype = self.dtype
        x = _conv(STAGE_CHANNELS[0], 7, 2, "conv1", dtype)(x)
        x = nn.relu(_norm("bn1", dtype)(x))
        x = jnp.pad(x, ((0, 0), (1, 1), (1, 1), (0, 0)))  # zeros: below no value after the ReLU
        x = nn.max_pool(x, window_shape=(3, 3), strides=(2, 2))
        self.sow("intermediates", "maxpool", x)
        for stage, channels in enumerate(STAGE_CHANNELS):
            for block in range(BLOCKS):
                stride = 2 if stage > 0 and block == 0 else 1
                x = BasicBlock(channels, stride, dtype, name=f"layer{stage + 1}.{block}")(x)
        features = x.astype(jnp.float32).mean((1, 2))
        return features, nn.Dense(CLASSES, name="fc")(features)
