"""ONNX nodes of the convolutional layers that encoder and hand view share (student_jax/encoder.py). NCHW."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from export.builder import GraphBuilder
from student_jax import encoder

Params = Mapping[str, Any]
"""Nested, arrays by name."""


def write_stem(g: GraphBuilder, x: str, params: Params, kind: str) -> str:
    """The first layer, `conv7` or patches of STEM_STRIDE pixels (student_jax/encoder.py, Stem)."""
    if kind == "conv7":
        x = g.relu(write_conv_norm(g, x, params["conv7"], 2))
        return g.op("MaxPool", x, kernel_shape=[3, 3], strides=[2, 2], pads=[1, 1, 1, 1])
    size = encoder.STEM_STRIDE
    kernel = np.asarray(params["patch"]["kernel"])
    patches = kernel.reshape(size, size, -1, kernel.shape[1])  # (dy, dx, in, out)
    x = g.conv(x, patches, params["patch"].get("bias"), stride=size)
    return g.relu(write_norm(g, x, params.get("norm")))


def write_block(g: GraphBuilder, x: str, params: Params, stride: int) -> str:
    """A basic residual block (He et al. 2016, figure 2), its shortcut projected where shapes differ."""
    y = g.relu(write_conv_norm(g, x, params["first"], stride))
    y = write_conv_norm(g, y, params["second"], 1)
    shortcut = write_conv_norm(g, x, params["shortcut"], stride) if "shortcut" in params else x
    return g.relu(g.add(shortcut, y))


def write_conv_norm(g: GraphBuilder, x: str, params: Params, stride: int) -> str:
    """Convolution with half-kernel padding, then its normalisation."""
    kernel = np.asarray(params["conv"]["kernel"])
    x = g.conv(x, kernel, params["conv"].get("bias"), stride=stride, pad=kernel.shape[0] // 2)
    return write_norm(g, x, params.get("norm"))


def write_norm(g: GraphBuilder, x: str, params: Params | None) -> str:
    """The encoder's GroupNorm, if it has one."""
    if params is None:
        return x
    return write_group_norm(g, x, params, len(params["scale"]) // encoder.GROUP_CHANNELS, encoder.EPSILON)


def write_group_norm(g: GraphBuilder, x: str, params: Params, groups: int, epsilon: float) -> str:
    """GroupNorm: InstanceNormalization over groups, then scale and bias per channel."""
    channels = len(params["scale"])
    ones, zeros = g.constant(np.ones(groups)), g.constant(np.zeros(groups))
    grouped = g.reshape(x, [0, groups, -1])
    grouped = g.op("InstanceNormalization", grouped, ones, zeros, epsilon=epsilon)
    normal = g.op("Reshape", grouped, g.op("Shape", x))
    scaled = g.mul(normal, g.constant(np.reshape(params["scale"], (channels, 1, 1))))
    return g.add(scaled, g.constant(np.reshape(params["bias"], (channels, 1, 1))))
