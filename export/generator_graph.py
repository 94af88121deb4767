"""The generator as one ONNX graph: clean depth and noise in, what the camera would report out.

Mirrors `ddg_jax.sample.generate`, every frame an episode of its own; the parity test compares them. The
sampler is a Loop, so that the number of network evaluations is an input.
"""

import math

import onnx
from onnx import TensorProto

from ddg_jax import representation
from ddg_jax.distil import X_LIMIT
from ddg_jax.train import LOG_ODDS_PER_OUTPUT
from ddgrasp import generator_metadata as names
from ddgrasp.config import DEPTH, PROGRESSIVE, SQUARED, DDGConfig
from ddgrasp.generator_metadata import GeneratorMetadata
from export import prior_graph
from export.builder import GraphBuilder, tensor
from export.layers import Params
from export.sampler_tables import Row, is_stochastic, sampler_tables
from export.unet_graph import UNetWriter


def build_model(params: Params, config: DDGConfig, metadata: GeneratorMetadata) -> onnx.ModelProto:
    """The whole generator.

    Args:
      params: of the network that `config.sampling` samples with.
      config: the generator's.
      metadata: what the file shall say about itself.

    Raises:
      UserError: a prior that needs colour.
    """
    prior_graph.check_prior(config)
    g, channels = GraphBuilder(), representation.channels(config)
    size = (config.depth.height_px, config.depth.width_px)
    depth = g.op("Unsqueeze", names.INPUT_DEPTH, g.integers([1]))
    depth = prior_graph.write_window(g, depth, config.graft)
    inside = prior_graph.write_resized(g, depth, (g.scalar(size[0]), g.scalar(size[1])))
    c = prior_graph.write_prior(g, inside, config)
    own = g.mul(g.slice(names.INPUT_NOISE, [0], [1], [1]), g.constant(config.prior.noise))
    x = _write_sampler(g, g.add(c, own), params, config)
    lengths = prior_graph.write_length(g, depth, 2), prior_graph.write_length(g, depth, 3)
    _write_graft(g, prior_graph.write_resized(g, x, lengths), depth, config)
    frames = ["batch", "rows", "columns"]
    inputs = [
        tensor(names.INPUT_DEPTH, frames),
        tensor(names.INPUT_NOISE, ["batch", "planes", *size]),
    ]
    if config.sampling.sampler != PROGRESSIVE:
        inputs.append(tensor(names.INPUT_STEPS, [], TensorProto.INT64))
    outputs = [
        tensor(names.OUTPUT_DEPTH, frames),
        tensor(names.OUTPUT_PREDICTED, frames),
        tensor(names.OUTPUT_MASK, frames, TensorProto.BOOL),
    ]
    assert channels == metadata.channels
    return g.model(inputs, outputs, {names.METADATA_KEY: metadata.to_json()}, name="generator")


# --- the sampler -----------------------------------------------------------------------------------


def _write_sampler(g: GraphBuilder, c: str, params: Params, config: DDGConfig) -> str:
    """Maps x (B, C, h, w) from the noise input and the prior c (B, 1, h, w)."""
    channels, tables = representation.channels(config), sampler_tables(config)
    network = UNetWriter(g, config, params, channels, c)
    one = g.scalar(1)
    if config.sampling.sampler == PROGRESSIVE:
        trips, table = g.scalar(config.sampling.steps), g.constant(tables[0])
    else:
        trips = names.INPUT_STEPS
        table = g.op("Gather", g.constant(tables), g.op("Sub", trips, one), axis=0)
    last = g.op("Sub", trips, one)
    start = g.slice(names.INPUT_NOISE, [1], [1 + channels], [1])

    def step(number: str, carried: list[str]) -> list[str]:
        x, before = carried
        values = g.op("Gather", table, number, axis=0)
        row = Row(*(g.slice(values, [i], [i + 1], [0]) for i in range(len(Row._fields))))
        x_0 = _write_clean(g, network.write(x, g.reshape(row.step, [1, 1])), x, row, config)
        clipped = g.op("Clip", x_0, g.constant(-X_LIMIT), g.constant(X_LIMIT))
        parts = [g.mul(x, row.x), g.mul(x_0, row.x_0), g.mul(clipped, row.clipped), g.mul(before, row.before)]
        if is_stochastic(config):
            parts.append(g.mul(_write_fresh(g, g.op("Min", g.add(number, one), last), channels), row.noise))
        total = parts[0]
        for part in parts[1:]:
            total = g.add(total, part)
        return [total, clipped]

    return g.loop(trips, [start, start], step)[0]


def _write_fresh(g: GraphBuilder, number: str, channels: int) -> str:
    """The noise planes of one step: block `number` of those behind the prior's plane."""
    per_step, one = g.integers([channels]), g.integers([1])
    first = g.add(g.mul(g.op("Unsqueeze", number, g.integers([0])), per_step), one)
    return g.op("Slice", names.INPUT_NOISE, first, g.add(first, per_step), one)


def _write_clean(g: GraphBuilder, out: str, x: str, row: Row, config: DDGConfig) -> str:
    """`train.predict_clean`: the network's output, or the expected validity and the other channels."""
    if config.training.hole_loss == SQUARED:
        return out
    own = g.mul(g.slice(x, [0], [1], [1]), row.own)
    odds = g.add(g.mul(g.slice(out, [0], [1], [1]), g.constant(LOG_ODDS_PER_OUTPUT)), own)
    valid = g.op("Tanh", g.mul(odds, g.constant(0.5)))
    return g.concat([valid, g.slice(out, [1], [representation.channels(config)], [1])], axis=1)


# --- from maps to depth ----------------------------------------------------------------------------


def _write_graft(g: GraphBuilder, x: str, depth: str, config: DDGConfig) -> None:
    """`representation.decode` and `graft.graft` of x (B, C, H, W) on depth (B, 1, H, W), to the outputs."""
    zero, first = g.constant(0.0), g.slice(x, [0], [1], [1])
    hole = g.op("Less", first, g.constant(config.graft.noise_threshold))
    if config.depth.representation == DEPTH:
        predicted, mask = g.op("Where", hole, zero, _write_depth(g, first, config)), hole
    else:
        deviation = _write_deviation(g, g.slice(x, [1], [2], [1]))
        nearest = g.op("Max", depth, g.constant(1e-3))
        inverse = g.add(g.op("Div", g.constant(1.0), nearest), deviation)
        seen = g.op("Div", g.constant(1.0), g.op("Max", inverse, g.constant(1 / representation.FARTHEST_M)))
        nothing = g.op("Or", hole, g.op("LessOrEqual", depth, zero))
        predicted = g.op("Where", nothing, zero, seen)
        threshold = g.constant(config.graft.deviation_threshold)
        mask = g.op("Or", hole, g.op("GreaterOrEqual", g.op("Abs", deviation), threshold))
    grafted = g.op("Where", mask, predicted, depth)
    for name, value in (
        (names.OUTPUT_DEPTH, grafted), (names.OUTPUT_PREDICTED, predicted), (names.OUTPUT_MASK, mask)
    ):  # fmt: skip
        g.output(name, g.op("Squeeze", value, g.integers([1])))


def _write_deviation(g: GraphBuilder, x: str) -> str:
    """KNEE sinh(x asinh(L / KNEE)), x clipped to [-1, 1]; sinh by exponentials, which every device has."""
    spread = math.asinh(representation.LIMIT_PER_M / representation.KNEE_PER_M)
    y = g.mul(g.op("Clip", x, g.constant(-1.0), g.constant(1.0)), g.constant(spread))
    difference = g.op("Sub", g.op("Exp", y), g.op("Exp", g.op("Neg", y)))
    return g.mul(difference, g.constant(representation.KNEE_PER_M / 2))


def _write_depth(g: GraphBuilder, x: str, config: DDGConfig) -> str:
    """Inverse depth between near and far to metres."""
    far, near = 1 / config.depth.far_m, 1 / config.depth.near_m
    inverse = g.mul(g.op("Clip", x, g.constant(0.0), g.constant(1.0)), g.constant(near - far))
    return g.op("Div", g.constant(1.0), g.add(inverse, g.constant(far)))
