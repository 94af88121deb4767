"""ONNX nodes of the generator's network (ddg_jax/unet.py). Pictures are NCHW here, NHWC there."""

import math
from collections.abc import Mapping
from typing import Any

import jax.numpy as jnp
import numpy as np

from ddg_jax import unet
from ddgrasp.config import DDGConfig
from export.builder import GraphBuilder
from export.layers import Params, write_group_norm
from learning.layers import time_frequencies

EPSILON = 1e-6
"""Flax's GroupNorm."""


class UNetWriter:
    """Writes the network; what depends on the prior alone is written once, before the sampler's loop."""

    def __init__(self, g: GraphBuilder, config: DDGConfig, params: Params, maps: int, c: str):
        """`c` (B, 1, H, W) is the prior, `maps` the channels of x."""
        self.g, self.config, self.params, self.maps = g, config.unet, params, maps
        self.height, self.width = config.depth.height_px, config.depth.width_px
        self.stride = config.unet.stride
        dense = _Numbered(params)
        self.time_layers = dense.next("Dense"), dense.next("Dense")
        self.first = dense.next("Dense")
        self.names = dense
        self.prior = self._folded(c)
        hidden = self._pointwise(self.prior, self._first_rows(of_prior=True), self.first["bias"])
        if self.config.position:
            hidden = g.add(hidden, g.constant(np.moveaxis(np.asarray(params["position"]), -1, 0)[None]))
        self.prior_hidden = hidden

    def write(self, x: str, step: str) -> str:
        """x (B, C, H, W) and the diffusion step (1, 1) float to the network's output (B, C, H, W)."""
        g, names = self.g, self.names.copy()
        time = self._time_embedding(step)
        h = self._pointwise(self._folded(x), self._first_rows(of_prior=False))
        h, skips = self._encode(g.add(h, self.prior_hidden), time, names)
        h = self._res_block(h, time, names.next("ResBlock"))
        if self.config.attention_heads:
            h = self._attention(h, names.next("SelfAttention"))
        h = self._res_block(h, time, names.next("ResBlock"))
        h = self._decode(h, skips, time, names)
        h = g.silu(self._modulated(h, time, names.next("Dense")))
        last = names.next("Conv")
        out = g.conv(h, last["kernel"], last["bias"], pad=1)
        out = g.add(out, self._dense(self.prior, names.next("Dense")))
        out = g.op("DepthToSpace", out, blocksize=self.config.space_to_depth, mode="DCR")
        return g.slice(out, [0, 0], [self.height, self.width], [2, 3])

    def _first_rows(self, *, of_prior: bool) -> np.ndarray:
        """Rows of the first layer's kernel that read the prior, or x: channels of a pixel stay together."""
        kernel = np.asarray(self.first["kernel"])
        by_pixel = kernel.reshape(-1, self.maps + 1, kernel.shape[1])
        part = by_pixel[:, self.maps :] if of_prior else by_pixel[:, : self.maps]
        return part.reshape(-1, kernel.shape[1])

    def _folded(self, x: str) -> str:
        """Zeros at the bottom and right up to a multiple of the stride; then pixels folded into channels."""
        below, right = -self.height % self.stride, -self.width % self.stride
        if below or right:
            x = self.g.op("Pad", x, self.g.integers([0, 0, 0, 0, 0, 0, below, right]))
        return self.g.op("SpaceToDepth", x, blocksize=self.config.space_to_depth)

    def _time_embedding(self, step: str) -> str:
        g, (first, second) = self.g, self.time_layers
        frequencies = np.asarray(time_frequencies(np.shape(first["kernel"])[0], jnp))
        angles = g.mul(step, g.constant(frequencies[None]))
        pair = g.concat([g.op("Cos", angles), g.op("Sin", angles)], axis=1)
        return g.silu(g.dense(g.silu(g.dense(pair, first)), second))

    def _encode(self, h: str, time: str, names: "_Numbered") -> tuple[str, list[str]]:
        skips = []
        for level, blocks in enumerate(self.config.blocks):
            if level:
                h = self._dense(self.g.op("SpaceToDepth", h, blocksize=2), names.next("Dense"))
            for _ in range(blocks):
                h = self._res_block(h, time, names.next("ResBlock"))
            skips.append(h)
        return h, skips

    def _decode(self, h: str, skips: list[str], time: str, names: "_Numbered") -> str:
        for level in reversed(range(len(self.config.widths))):
            h = self._dense(self.g.concat([h, skips[level]], axis=1), names.next("Dense"))
            for _ in range(self.config.blocks[level]):
                h = self._res_block(h, time, names.next("ResBlock"))
            if level:
                h = self._dense(h, names.next("Dense"))
                h = self.g.op("DepthToSpace", h, blocksize=2, mode="DCR")
        return h

    def _res_block(self, x: str, time: str, params: Params) -> str:
        g = self.g
        h = g.silu(self._norm(x, params["GroupNorm_0"]))
        h = g.conv(h, params["Conv_0"]["kernel"], params["Conv_0"]["bias"], pad=1)
        h = g.silu(self._modulated(self._norm(h, params["GroupNorm_1"]), time, params["Dense_0"]))
        h = g.conv(h, params["Conv_1"]["kernel"], params["Conv_1"]["bias"], pad=1)
        return g.add(self._dense(x, params["Dense_1"]) if "Dense_1" in params else x, h)

    def _modulated(self, h: str, time: str, params: Params) -> str:
        """h (1 + scale) + shift, both (1, width) from the time embedding."""
        g, width = self.g, np.shape(params["bias"])[0] // 2
        both = g.reshape(g.dense(time, params), [1, 2 * width, 1, 1])
        scale, shift = (g.slice(both, [i * width], [(i + 1) * width], [1]) for i in range(2))
        return g.add(g.mul(h, g.add(scale, g.constant(1.0))), shift)

    def _attention(self, x: str, params: Params) -> str:
        g, heads = self.g, self.config.attention_heads
        attention, channels = params["MultiHeadDotProductAttention_0"], len(params["GroupNorm_0"]["scale"])
        tokens = g.reshape(self._norm(x, params["GroupNorm_0"]), [0, channels, -1])
        tokens = g.op("Transpose", tokens, perm=[0, 2, 1])  # (B, L, C)

        def projected(name: str, scale: float = 1.0) -> str:
            kernel = scale * np.reshape(attention[name]["kernel"], (channels, channels))
            bias = scale * np.reshape(attention[name]["bias"], channels)
            made = g.add(g.op("MatMul", tokens, g.constant(kernel)), g.constant(bias))
            made = g.reshape(made, [0, 0, heads, channels // heads])
            return g.op("Transpose", made, perm=[0, 2, 1, 3])  # (B, heads, L, C / heads)

        keys = g.op("Transpose", projected("key"), perm=[0, 1, 3, 2])
        scores = g.op("MatMul", projected("query", 1 / math.sqrt(channels // heads)), keys)
        seen = g.op("MatMul", g.op("Softmax", scores, axis=-1), projected("value"))
        seen = g.reshape(g.op("Transpose", seen, perm=[0, 2, 1, 3]), [0, 0, channels])
        kernel = np.reshape(attention["out"]["kernel"], (channels, channels))
        out = g.add(g.op("MatMul", seen, g.constant(kernel)), g.constant(attention["out"]["bias"]))
        out = g.op("Reshape", g.op("Transpose", out, perm=[0, 2, 1]), g.op("Shape", x))
        return g.add(x, out)

    def _norm(self, x: str, params: Params) -> str:
        groups = math.gcd(unet.GROUPS, len(params["scale"]))
        return write_group_norm(self.g, x, params, groups, EPSILON)

    def _dense(self, x: str, params: Params) -> str:
        return self._pointwise(x, np.asarray(params["kernel"]), params["bias"])

    def _pointwise(self, x: str, kernel: np.ndarray, bias: Any = None) -> str:
        """Flax Dense on every pixel."""
        return self.g.conv(x, kernel[None, None], bias)


class _Numbered:
    """Flax's names of layers that were given none: a class and its number, in the order of their calls."""

    def __init__(self, params: Params, counts: Mapping[str, int] | None = None):
        self.params, self.counts = params, dict(counts or {})

    def next(self, kind: str) -> Params:
        number = self.counts.get(kind, 0)
        self.counts[kind] = number + 1
        return self.params[f"{kind}_{number}"]

    def copy(self) -> "_Numbered":
        return _Numbered(self.params, self.counts)
