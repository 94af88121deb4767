"""ONNX nodes from simulated depth to the prior c (ddg_jax/prior.py, window.py); pictures are (B, 1, H, W).

OpenCV's filters are written out: a median by exchanges of two, a bilateral filter neighbour by neighbour.
"""

import math
from functools import partial

import cv2
import numpy as np
from onnx import TensorProto

from ddg_jax.inverse_depth import NORMALISED_LIMIT, STATISTICS_STRIDE
from ddg_jax.network_prior import NETWORKS
from ddg_jax.prior import NEAREST_M, MetricInverseDepthPrior
from ddgrasp.config import BOX, PIECEWISE, DDGConfig, GraftConfig
from ddgrasp.errors import UserError
from export.builder import GraphBuilder
from sensors.statistics import holes

HEIGHT, WIDTH = 2, 3
"""Axes."""


def check_prior(config: DDGConfig) -> None:
    """UserError for a prior that a graph cannot hold: a network on colour pictures, a Gaussian that reaches
    across the whole map, which ONNX does not reflect more than once.
    """
    if config.prior.source in NETWORKS and config.prior.in_sim == "rgb":
        raise UserError(
            f"ddg.prior.source is {config.prior.source} on rgb, which the ONNX file cannot hold: export a "
            "generator fitted with --ddg.prior.in-sim depth or a built-in prior."
        )
    blur_px = 0.0 if config.prior.source in NETWORKS else config.prior.blur_px
    least = min(config.depth.height_px, config.depth.width_px)
    window_px, is_box = config.graft.window_px, config.graft.window_shape == BOX
    if is_box and window_px // 2 >= least:
        raise UserError(
            f"ddg.graft.window_px is {window_px:g}: the ONNX file cannot hold a box that reaches across all "
            f"of the map's {least} pixels: export a generator with less than {2 * least:g}."
        )
    for name, sigma_px in (("prior.blur_px", blur_px), ("graft.window_px", 0.0 if is_box else window_px)):
        if _blur_length(sigma_px) // 2 >= least:
            raise UserError(
                f"ddg.{name} is {sigma_px:g}: the ONNX file cannot hold a Gaussian that reaches across "
                f"all of the map's {least} pixels: export a generator with {(least - 1) / 4:g} or less."
            )


def write_prior(g: GraphBuilder, depth: str, config: DDGConfig) -> str:
    """Clean depth at the generator's size, metres, to c: every frame a sequence of its own."""
    size, prior = (config.depth.height_px, config.depth.width_px), config.prior
    inverse = write_inverse(g, depth)
    if prior.source in NETWORKS:
        return write_normalised(g, inverse, size)
    if config.depth.surface != PIECEWISE:
        inverse = write_bilateral(g, write_median(g, inverse, size), size)
    if prior.blur_px > 0:
        inverse = write_blur(g, inverse, prior.blur_px)
    if prior.source == MetricInverseDepthPrior.name:
        nearest = g.op("Min", inverse, g.constant(1 / NEAREST_M))
        return g.op("Sub", g.mul(nearest, g.constant(2.0)), g.constant(2.0))
    return write_normalised(g, inverse, size)


def write_inverse(g: GraphBuilder, depth: str) -> str:
    """1/d, 0 where depth is 0: `ddgrasp.depth.inverse_depth`."""
    valid = g.op("Greater", depth, g.constant(0.0))
    inverse = g.op("Div", g.constant(1.0), g.op("Where", valid, depth, g.constant(1.0)))
    return g.op("Where", valid, inverse, g.constant(0.0))


def write_normalised(g: GraphBuilder, inverse: str, size: tuple[int, int]) -> str:
    """`inverse_depth.normalise` of each frame."""
    pixels = np.arange(0, size[0] * size[1], STATISTICS_STRIDE)
    sample = g.op("Gather", g.reshape(inverse, [0, -1]), g.integers(pixels.tolist()), axis=1)
    upper = len(pixels) // 2 + 1
    largest = g.op("TopK", sample, g.integers([upper]), spare=1, axis=1)
    middle = 1 if len(pixels) % 2 else 2
    median = g.slice(largest, [upper - middle], [upper], [1])
    median = g.op("ReduceMean", median, g.integers([1]), keepdims=1)
    spread = g.op("ReduceMean", g.op("Abs", g.op("Sub", sample, median)), g.integers([1]), keepdims=1)
    scale = g.add(g.mul(spread, g.constant(2.0)), g.constant(1e-6))
    median, scale = (g.reshape(value, [0, 1, 1, 1]) for value in (median, scale))
    made = g.op("Div", g.op("Sub", inverse, median), scale)
    return g.op("Clip", made, g.constant(-NORMALISED_LIMIT), g.constant(NORMALISED_LIMIT))


# --- filters ---------------------------------------------------------------------------------------


def write_window(g: GraphBuilder, depth: str, graft: GraftConfig) -> str:
    """`window.mixed`: inverse depth averaged over valid pixels by a Gaussian or a box."""
    if graft.window_px == 0:
        return depth
    averaged = partial(write_box, width_px=int(graft.window_px))
    if graft.window_shape != BOX:
        averaged = partial(write_blur, sigma_px=graft.window_px)
    valid = g.op("Greater", depth, g.constant(0.0))
    weight = averaged(g, g.op("Cast", valid, to=TensorProto.FLOAT))
    mean = averaged(g, write_inverse(g, depth))
    return g.op("Where", valid, g.op("Div", weight, mean), g.constant(0.0))


def write_blur(g: GraphBuilder, x: str, sigma_px: float) -> str:
    """cv2.GaussianBlur of float pictures, whose kernel reaches four standard deviations."""
    length = _blur_length(sigma_px)
    return _write_separable(g, x, cv2.getGaussianKernel(length, sigma_px, cv2.CV_32F).ravel())


def write_box(g: GraphBuilder, x: str, width_px: int) -> str:
    """cv2.blur of float pictures over an odd number of pixels."""
    return _write_separable(g, x, np.full(width_px, 1 / width_px, np.float32))


def _write_separable(g: GraphBuilder, x: str, kernel: np.ndarray) -> str:
    """`x` through a kernel of odd length along columns, then rows, reflected at the border."""
    length = len(kernel)
    x = _write_padded(g, x, length // 2, "reflect")
    for shape in ((length, 1), (1, length)):
        weights = g.constant(kernel.reshape(1, 1, *shape))
        x = g.op("Conv", x, weights, kernel_shape=shape)
    return x


def _blur_length(sigma_px: float) -> int:
    return round(8 * sigma_px + 1) | 1


def write_bilateral(g: GraphBuilder, x: str, size: tuple[int, int]) -> str:
    """cv2.bilateralFilter as `holes.smooth_surface` calls it: round window, reflected at the border."""
    radius = holes.BILATERAL_PX // 2
    padded = _write_padded(g, x, radius, "reflect")
    per_square = g.constant(-0.5 / holes.BILATERAL_PER_M**2)
    total = weights = None
    for row in range(-radius, radius + 1):
        for column in range(-radius, radius + 1):
            if (distance := math.hypot(row, column)) > radius:
                continue
            seen = _write_part(g, padded, radius + row, radius + column, size)
            apart = g.op("Sub", seen, x)
            spatial = -0.5 * (distance / holes.BILATERAL_SPATIAL_PX) ** 2
            exponent = g.add(g.mul(g.mul(apart, apart), per_square), g.constant(spatial))
            weight = g.op("Exp", exponent)
            value = g.mul(weight, seen)
            total = value if total is None else g.add(total, value)
            weights = weight if weights is None else g.add(weights, weight)
    assert total is not None and weights is not None
    return g.op("Div", total, weights)


def write_median(g: GraphBuilder, x: str, size: tuple[int, int]) -> str:
    """cv2.medianBlur with a window of five, the border repeated."""
    n = holes.MEDIAN_PX
    padded = _write_padded(g, x, n // 2, "edge")
    wide = (size[0], size[1] + 2 * (n // 2))
    columns = _sorted(g, [_write_part(g, padded, i, 0, wide) for i in range(n)])
    rows = [_sorted(g, [_write_part(g, column, 0, j, size) for j in range(n)]) for column in columns]
    return _median(g, [rows[i][j] for i, j in median_candidates(n)])


def median_candidates(n: int) -> list[tuple[int, int]]:
    """Places that may hold the median of n x n numbers (n odd), once columns, then rows are sorted.

    (i, j) is at least as large as (i + 1) (j + 1) of them and at most as large as (n - i) (n - j).
    """
    most = (n * n + 1) // 2
    every = [(i, j) for i in range(n) for j in range(n)]
    return [(i, j) for i, j in every if (i + 1) * (j + 1) <= most and (n - i) * (n - j) <= most]


def _sorted(g: GraphBuilder, values: list[str]) -> list[str]:
    """The pictures in order at every pixel, least first (odd-even transposition)."""
    values = list(values)
    for round_ in range(len(values)):
        for i in range(round_ % 2, len(values) - 1, 2):
            values[i], values[i + 1] = _exchanged(g, values[i], values[i + 1])
    return values


def _median(g: GraphBuilder, values: list[str]) -> str:
    """The middle one of an odd number, forgetting the least and the largest of as many as must hold them."""
    held, rest = values[: len(values) // 2 + 2], values[len(values) // 2 + 2 :]
    while len(held) > 1:
        held = _without_extremes(g, held) + rest[:1]
        rest = rest[1:]
    return held[0]


def _without_extremes(g: GraphBuilder, values: list[str]) -> list[str]:
    """All but the least and the largest: pairs first, then the best of either side."""
    values = list(values)
    for i in range(len(values) // 2):
        values[i], values[-1 - i] = _exchanged(g, values[i], values[-1 - i])
    half = (len(values) + 1) // 2  # the least is among the first ones, the largest among the last ones
    for i in range(1, half):
        values[0], values[i] = _exchanged(g, values[0], values[i])
    for i in range(len(values) // 2, len(values) - 1):
        values[i], values[-1] = _exchanged(g, values[i], values[-1])
    return values[1:-1]


def _exchanged(g: GraphBuilder, a: str, b: str) -> tuple[str, str]:
    return g.op("Min", a, b), g.op("Max", a, b)


def _write_padded(g: GraphBuilder, x: str, by: int, mode: str) -> str:
    return g.op("Pad", x, g.integers([0, 0, by, by, 0, 0, by, by]), mode=mode)


def _write_part(g: GraphBuilder, x: str, row: int, column: int, size: tuple[int, int]) -> str:
    return g.slice(x, [row, column], [row + size[0], column + size[1]], [HEIGHT, WIDTH])


# --- sizes -----------------------------------------------------------------------------------------


def write_resized(g: GraphBuilder, x: str, size: tuple[str, str]) -> str:
    """`depth.resize_nearest` to rows and columns that are scalar int64 tensors."""
    for axis, length in zip((HEIGHT, WIDTH), size, strict=True):
        had = write_length(g, x, axis)
        one, two = (g.scalar(number) for number in (1, 2))
        numbers = g.op("Range", g.scalar(0), length, one)
        centres = g.mul(g.add(g.mul(numbers, two), one), had)
        x = g.op("Gather", x, g.op("Div", centres, g.mul(length, two)), axis=axis)
    return x


def write_length(g: GraphBuilder, x: str, axis: int) -> str:
    """The length of an axis, a scalar int64."""
    return g.op("Squeeze", g.op("Shape", x, start=axis, end=axis + 1))
