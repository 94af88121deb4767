"""The foundation networks as ONNX graphs, for onnxruntime to run beside JAX: fixed shapes, NCHW, float32.

Mirrors foundation/ module by module; the benchmark prints how far the two are apart.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import onnx

from export.builder import GraphBuilder, tensor
from foundation import dpt, inception, resnet, temporal, vit
from foundation.depth import DepthNetwork

Params = Mapping[str, Any]
INPUT, OUTPUT = "x", "y"


class NetworkBuilder(GraphBuilder):
    """Operators that the networks are made of."""

    def transpose(self, x: str, order: Sequence[int]) -> str:
        """Axes in another order."""
        return self.op("Transpose", x, perm=list(order))

    def linear(self, x: str, params: Params) -> str:
        """Flax Dense over the last axis of any rank."""
        x = self.op("MatMul", x, self.constant(params["kernel"]))
        return self.add(x, self.constant(params["bias"])) if "bias" in params else x

    def layer_norm(self, x: str, params: Params, epsilon: float) -> str:
        """Over the last axis."""
        scale, bias = self.constant(params["scale"]), self.constant(params["bias"])
        return self.op("LayerNormalization", x, scale, bias, axis=-1, epsilon=epsilon)

    def gelu(self, x: str) -> str:
        """x (1 + erf(x / sqrt 2)) / 2."""
        erf = self.op("Erf", self.mul(x, self.constant(np.sqrt(0.5))))
        return self.mul(self.mul(x, self.add(erf, self.constant(1.0))), self.constant(0.5))

    def attention(self, q: str, k: str, v: str, heads: int, shape: Sequence[int]) -> str:
        """softmax(q k^T / sqrt d) v of (N, T, C) inputs, `shape` = (N, T, C)."""
        count, steps, channels = shape
        split = [count, steps, heads, channels // heads]
        q, v = (self.transpose(self.reshape(part, split), (0, 2, 1, 3)) for part in (q, v))
        k = self.transpose(self.reshape(k, split), (0, 2, 3, 1))
        logits = self.mul(self.op("MatMul", q, k), self.constant((channels // heads) ** -0.5))
        mixed = self.op("MatMul", self.op("Softmax", logits, axis=-1), v)
        return self.reshape(self.transpose(mixed, (0, 2, 1, 3)), shape)

    def resize(self, x: str, size: Sequence[int], mode: str = "align_corners") -> str:
        """Bilinear, (N, C, h, w) with all of `size` = (N, C, H, W) given."""
        return self.op(
            "Resize", x, "", "", self.integers(size), mode="linear", coordinate_transformation_mode=mode
        )

    def conv_params(self, x: str, params: Params, *, stride: int = 1, pad: int = 0) -> str:
        """Flax Conv."""
        return self.conv(x, params["kernel"], params.get("bias"), stride=stride, pad=pad)

    def batch_norm(self, x: str, params: Params, statistics: Params, epsilon: float) -> str:
        """With stored statistics."""
        values = (params["scale"], params["bias"], statistics["mean"], statistics["var"])
        return self.op("BatchNormalization", x, *(self.constant(v) for v in values), epsilon=epsilon)

    def finished(self, shape: Sequence[int], result: str, result_shape: Sequence[int]) -> onnx.ModelProto:
        """The model from INPUT of `shape` to OUTPUT."""
        self.nodes.append(onnx.helper.make_node("Identity", [result], [OUTPUT]))
        return self.model([tensor(INPUT, shape)], [tensor(OUTPUT, result_shape)], {})


# --- depth ---------------------------------------------------------------------------------------


def depth_model(network: DepthNetwork, params: Params, shape: Sequence[int]) -> onnx.ModelProto:
    """Standardised (B * T, 3, H, W) -> (B * T, 1, H, W); for the video network B = 1."""
    g = NetworkBuilder()
    count, _, height, width = shape
    grid = (height // vit.PATCH_PX, width // vit.PATCH_PX)
    taps = _write_vit(g, network, params["pretrained"], count, grid)
    head = params[network.head]
    motion = _Motion(g, head, count) if network.video else None
    maps = [g.conv_params(tap, head[f"projects.{i}"]) for i, tap in enumerate(taps)]
    for i, factor in enumerate(dpt.UPSCALING):
        kernel = np.transpose(head[f"resize_layers.{i}"]["transposed_kernel"], (2, 3, 0, 1))
        bias = g.constant(head[f"resize_layers.{i}"]["bias"])
        maps[i] = g.op(
            "ConvTranspose",
            maps[i],
            g.constant(kernel),
            bias,
            strides=[factor] * 2,
            kernel_shape=[factor] * 2,
        )
    maps[3] = g.conv_params(maps[3], head["resize_layers.3"], stride=2, pad=1)
    sides = [
        (4 * grid[0], 4 * grid[1]),
        (2 * grid[0], 2 * grid[1]),
        grid,
        (-(-grid[0] // 2), -(-grid[1] // 2)),
    ]
    channels, features = network.size.channels, network.size.features
    if motion:
        maps[2] = motion.write(0, maps[2], channels[2], sides[2])
        maps[3] = motion.write(1, maps[3], channels[3], sides[3])
    layers = [g.conv_params(x, head[f"scratch.layer{i + 1}_rn"], pad=1) for i, x in enumerate(maps)]
    targets = [(2 * sides[0][0], 2 * sides[0][1]), *sides[:3]]
    path = ""
    for i in (3, 2, 1, 0):
        fusion = head[f"scratch.refinenet{i + 1}"]
        x = g.add(path, _write_residual(g, layers[i], fusion["resConfUnit1"])) if path else layers[i]
        x = g.resize(_write_residual(g, x, fusion["resConfUnit2"]), [count, features, *targets[i]])
        path = g.conv_params(x, fusion["out_conv"])
        if motion and i >= 2:
            path = motion.write(5 - i, path, features, targets[i])
    x = g.conv_params(path, head["scratch.output_conv1"], pad=1)
    x = g.resize(x, [count, features // 2, height, width])
    x = g.relu(g.conv_params(x, head["scratch.output_conv2.0"], pad=1))
    x = g.relu(g.conv_params(x, head["scratch.output_conv2.2"]))
    return g.finished(shape, x, [count, 1, height, width])


def _write_vit(
    g: NetworkBuilder, network: DepthNetwork, params: Params, count: int, grid: tuple[int, int]
) -> list[str]:
    size, steps = network.size, grid[0] * grid[1]
    x = g.conv_params(INPUT, params["patch_embed.proj"], stride=vit.PATCH_PX)
    x = g.transpose(g.reshape(x, [count, size.width, steps]), (0, 2, 1))
    x = g.concat([g.constant(np.repeat(params["cls_token"], count, 0)), x], axis=1)
    x = g.add(x, g.constant(vit.resize_positions(params["pos_embed"], grid)))
    shape, taps = [count, steps + 1, size.width], []
    for i in range(size.taps[-1] + 1):
        block = params[f"blocks.{i}"]
        y = g.layer_norm(x, block["norm1"], vit.NORM_EPSILON)
        kernels = np.split(np.asarray(block["attn"]["qkv"]["kernel"]), 3, axis=1)
        biases = np.split(np.asarray(block["attn"]["qkv"]["bias"]), 3)
        q, k, v = (
            g.linear(y, {"kernel": kernel, "bias": bias})
            for kernel, bias in zip(kernels, biases, strict=True)
        )
        y = g.linear(g.attention(q, k, v, size.heads, shape), block["attn"]["proj"])
        x = g.add(x, g.mul(y, g.constant(block["ls1"]["gamma"])))
        y = g.linear(g.layer_norm(x, block["norm2"], vit.NORM_EPSILON), block["mlp"]["fc1"])
        x = g.add(x, g.mul(g.linear(g.gelu(y), block["mlp"]["fc2"]), g.constant(block["ls2"]["gamma"])))
        if i in size.taps:
            y = g.slice(g.layer_norm(x, params["norm"], vit.NORM_EPSILON), [1], [steps + 1], [1])
            taps.append(g.reshape(g.transpose(y, (0, 2, 1)), [count, size.width, *grid]))
    return taps


def _write_residual(g: NetworkBuilder, x: str, params: Params) -> str:
    y = g.relu(g.conv_params(g.relu(x), params["conv1"], pad=1))
    return g.add(x, g.conv_params(y, params["conv2"], pad=1))


class _Motion:
    """Writes motion modules for one clip of `frames`."""

    def __init__(self, g: NetworkBuilder, head: Params, frames: int):
        self._g, self._head, self._frames = g, head, frames

    def write(self, index: int, x: str, channels: int, sides: tuple[int, int]) -> str:
        """(T, C, h, w) -> the same."""
        g, prefix = self._g, "temporal_transformer"
        params = self._head[f"motion_modules.{index}"]
        places, groups = sides[0] * sides[1], temporal.GROUPS
        y = g.reshape(x, [self._frames, groups, -1])
        ones, zeros = g.constant(np.ones(groups)), g.constant(np.zeros(groups))
        y = g.op("InstanceNormalization", y, ones, zeros, epsilon=temporal.GROUP_NORM_EPSILON)
        y = g.transpose(g.reshape(y, [self._frames, channels, places]), (2, 0, 1))  # (h w, T, C)
        norm = params[f"{prefix}.norm"]
        y = g.add(g.mul(y, g.constant(norm["scale"])), g.constant(norm["bias"]))
        y = self._block(
            g.linear(y, params[f"{prefix}.proj_in"]), params[f"{prefix}.transformer_blocks.0"], places
        )
        y = g.transpose(g.linear(y, params[f"{prefix}.proj_out"]), (1, 2, 0))
        return g.add(x, g.reshape(y, [self._frames, channels, *sides]))

    def _block(self, x: str, params: Params, places: int) -> str:
        g = self._g
        for i in range(temporal.ATTENTIONS):
            attention = params[f"attention_blocks.{i}"]
            y = g.layer_norm(x, params[f"norms.{i}"], temporal.LAYER_NORM_EPSILON)
            y = g.add(y, g.constant(np.asarray(attention["pos_encoder.pe"])[:, : self._frames]))
            q, k, v = (g.linear(y, attention[name]) for name in ("to_q", "to_k", "to_v"))
            channels = attention["to_q"]["kernel"].shape[0]
            y = g.attention(q, k, v, temporal.HEADS, [places, self._frames, channels])
            x = g.add(x, g.linear(y, attention["to_out.0"]))
        y = g.layer_norm(x, params["ff_norm"], temporal.LAYER_NORM_EPSILON)
        inner, bias = (np.asarray(params["ff"]["net.0.proj"][name]) for name in ("kernel", "bias"))
        half = inner.shape[1] // 2
        value = g.linear(y, {"kernel": inner[:, :half], "bias": bias[:half]})
        gate = g.linear(y, {"kernel": inner[:, half:], "bias": bias[half:]})
        return g.add(x, g.linear(g.mul(value, g.gelu(gate)), params["ff"]["net.2"]))


# --- classifiers ---------------------------------------------------------------------------------


def resnet18_model(variables: Params, shape: Sequence[int]) -> onnx.ModelProto:
    """Standardised (B, 3, H, W) -> features (B, 512)."""
    g, params, statistics = NetworkBuilder(), variables["params"], variables["batch_stats"]

    def norm(x: str, name: str, params: Params = params, statistics: Params = statistics) -> str:
        return g.batch_norm(x, params[name], statistics[name], resnet.NORM_EPSILON)

    x = g.relu(norm(g.conv_params(INPUT, params["conv1"], stride=2, pad=3), "bn1"))
    x = g.op("MaxPool", x, kernel_shape=[3, 3], strides=[2, 2], pads=[1, 1, 1, 1])
    for stage in range(len(resnet.STAGE_CHANNELS)):
        for block in range(resnet.BLOCKS):
            name, stride = f"layer{stage + 1}.{block}", 2 if stage > 0 and block == 0 else 1
            here, seen = params[name], statistics[name]
            y = g.relu(norm(g.conv_params(x, here["conv1"], stride=stride, pad=1), "bn1", here, seen))
            y = norm(g.conv_params(y, here["conv2"], pad=1), "bn2", here, seen)
            if "downsample.0" in here:
                x = norm(g.conv_params(x, here["downsample.0"], stride=stride), "downsample.1", here, seen)
            x = g.relu(g.add(x, y))
    return g.finished(
        shape, g.op("Flatten", g.op("GlobalAveragePool", x)), [shape[0], resnet.STAGE_CHANNELS[-1]]
    )


def inception_model(variables: Params, shape: Sequence[int]) -> onnx.ModelProto:
    """(B, 3, H, W) in [0, 1] -> features (B, 2048)."""
    g = NetworkBuilder()
    writer = _Inception(g, variables["params"], variables["batch_stats"])
    x = g.resize(INPUT, [shape[0], 3, inception.SIDE_PX, inception.SIDE_PX], "half_pixel")
    x = g.add(g.mul(x, g.constant(2.0)), g.constant(-1.0))
    features = g.op("Flatten", g.op("GlobalAveragePool", writer.write(x)))
    return g.finished(shape, features, [shape[0], inception.FEATURES])


class _Inception:
    """Follows `FidInception`, whose modules' names are in the parameters; strides and pads are its rules."""

    def __init__(self, g: NetworkBuilder, params: Params, statistics: Params):
        self._g, self._params, self._statistics = g, params, statistics

    def write(self, x: str) -> str:
        conv, pool = self._conv, self._pool
        x = conv(x, "Conv2d_1a_3x3", stride=2, pad=False)
        x = conv(x, "Conv2d_2a_3x3", pad=False)
        x = pool("MaxPool", conv(x, "Conv2d_2b_3x3"), 2)
        x = conv(conv(x, "Conv2d_3b_1x1"), "Conv2d_4a_3x3", pad=False)
        x = pool("MaxPool", x, 2)
        for name in ("5b", "5c", "5d"):
            x = self._mixed(x, name, [["branch1x1"], _chain("branch5x5", 2), _chain("branch3x3dbl", 3)])
        x = self._reduction(x, "6a", [["branch3x3"], _chain("branch3x3dbl", 3)])
        for name in ("6b", "6c", "6d", "6e"):
            x = self._mixed(x, name, [["branch1x1"], _chain("branch7x7", 3), _chain("branch7x7dbl", 5)])
        x = self._reduction(x, "7a", [_chain("branch3x3", 2), _chain("branch7x7x3", 4)])
        forks = [_chain("branch3x3", 1), _chain("branch3x3dbl", 2)]
        for name, kind in (("7b", "AveragePool"), ("7c", "MaxPool")):
            x = self._forked(x, name, forks, kind)
        return x

    def _mixed(self, x: str, name: str, chains: list[list[str]]) -> str:
        parts = [self._run(x, name, chain) for chain in chains]
        pooled = self._conv(self._pool("AveragePool", x, 1), f"Mixed_{name}", "branch_pool")
        return self._g.concat([*parts, pooled], axis=1)

    def _reduction(self, x: str, name: str, chains: list[list[str]]) -> str:
        parts = [self._run(x, name, chain, last_stride=2) for chain in chains]
        return self._g.concat([*parts, self._pool("MaxPool", x, 2)], axis=1)

    def _forked(self, x: str, name: str, forks: list[list[str]], kind: str) -> str:
        parts = [self._run(x, name, ["branch1x1"])]
        for fork, number in zip(forks, (2, 3), strict=True):
            stem = self._run(x, name, fork)
            base = fork[0].rpartition("_")[0]
            parts += [self._conv(stem, f"Mixed_{name}", f"{base}_{number}{side}") for side in "ab"]
        pooled = self._conv(self._pool(kind, x, 1), f"Mixed_{name}", "branch_pool")
        return self._g.concat([*parts, pooled], axis=1)

    def _run(self, x: str, name: str, chain: list[str], last_stride: int = 1) -> str:
        for i, branch in enumerate(chain):
            stride = last_stride if i == len(chain) - 1 else 1
            x = self._conv(x, f"Mixed_{name}", branch, stride=stride, pad=stride == 1)
        return x

    def _conv(self, x: str, *path: str, stride: int = 1, pad: bool = True) -> str:
        params, statistics = self._params, self._statistics
        for name in path:
            params, statistics = params[name], statistics[name]
        kernel = np.transpose(params["conv"]["kernel"], (3, 2, 0, 1))
        rows, columns = (side // 2 if pad else 0 for side in kernel.shape[2:])
        x = self._g.op(
            "Conv", x, self._g.constant(kernel), strides=[stride] * 2, pads=[rows, columns, rows, columns]
        )
        return self._g.relu(self._g.batch_norm(x, params["bn"], statistics["bn"], inception.NORM_EPSILON))

    def _pool(self, kind: str, x: str, stride: int) -> str:
        pads = [1 if stride == 1 else 0] * 4
        return self._g.op(kind, x, kernel_shape=[3, 3], strides=[stride] * 2, pads=pads)


def _chain(name: str, length: int) -> list[str]:
    return [f"{name}_{number}" for number in range(1, length + 1)]
