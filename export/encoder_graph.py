"""ONNX nodes of the encoder: picture to features (student_jax/encoder.py)."""

import numpy as np

from ddgrasp import contract
from ddgrasp.config import StudentConfig
from ddgrasp.contract import CameraProfile
from export import layers
from export.builder import GraphBuilder
from export.layers import Params
from student_jax import encoder


def write_encoder(
    g: GraphBuilder,
    picture: str,
    planes: tuple[str, str],
    params: Params,
    student: StudentConfig,
    profile: CameraProfile,
) -> str:
    """Picture to features (B, encoder.features)."""
    x = layers.write_stem(g, picture, params["stem"], student.encoder.stem)
    for index, (_, stride) in enumerate(encoder.stage_plan(student)):
        for block in range(student.encoder.stage_blocks[index]):
            x = layers.write_block(g, x, params[f"stage{index}_block{block}"], stride if block == 0 else 1)
    if student.encoder.pooling == "mean":
        means = g.op("Flatten", g.op("GlobalAveragePool", x))
        return _dense_with_centre(g, means, params["features"], profile)
    kernel, bias = params["cells"]["kernel"], params["cells"]["bias"]
    cells = g.conv(x, np.asarray(kernel)[None, None], bias)
    cells = g.reshape(cells, [0, student.encoder.keypoints, -1])  # (B, K, P)
    if student.encoder.pooling == "tokens":
        return _write_tokens(g, cells, params["features"], profile)
    points = _write_keypoints(g, cells, planes, student, profile)
    return g.relu(g.dense(points, params["features"]))


def _write_tokens(g: GraphBuilder, cells: str, params: Params, profile: CameraProfile) -> str:
    """Every cell's channels, flattened."""
    tokens = g.op("Flatten", g.relu(g.op("Transpose", cells, perm=[0, 2, 1])))
    return g.relu(_dense_with_centre(g, tokens, params, profile))


def _dense_with_centre(g: GraphBuilder, x: str, params: Params, profile: CameraProfile) -> str:
    """Dense of `x` and the centred crop's coordinates, which are a constant: part of the bias."""
    kernel = np.asarray(params["kernel"])
    centre = encoder.static_crop_centre(profile)
    bias = np.asarray(params["bias"]) + centre @ kernel[-len(centre) :]
    return g.affine(x, kernel[: -len(centre)], bias)


def _write_keypoints(
    g: GraphBuilder, cells: str, planes: tuple[str, str], student: StudentConfig, profile: CameraProfile
) -> str:
    """(B, K, P) logits to (B, K * 6) keypoints, as `encoder.spatial_softmax`."""
    maps = encoder.static_cell_maps(profile, student)
    coordinates, table, per_relief = maps[:, :2], maps[:, 2:5], maps[:, 5:]
    attention = g.op("Softmax", cells, axis=-1)
    relief = _write_cell_relief(g, planes, student)  # (B, 1, P)
    seen = g.op("MatMul", g.mul(attention, relief), g.constant(np.c_[np.ones(len(maps)), per_relief]))
    fixed = g.op("MatMul", attention, g.constant(np.c_[coordinates, table]))  # (B, K, 5)
    world = g.add(g.slice(fixed, [2], [5], [2]), g.slice(seen, [1], [4], [2]))
    points = [g.slice(fixed, [0], [2], [2]), g.slice(seen, [0], [1], [2]), world]
    return g.op("Flatten", g.concat(points, axis=2))


def _write_cell_relief(g: GraphBuilder, planes: tuple[str, str], student: StudentConfig) -> str:
    """(B, 1, P) mean relief of the newest frame's valid pixels in each cell, as `encoder.cell_relief`."""
    stride = encoder.map_stride(student)
    below, right = -student.picture.height_px % stride, -student.picture.width_px % stride

    newest = contract.DEPTH_FRAMES - 1

    def share(frames: str) -> str:
        image = g.slice(frames, [newest], [newest + 1], [1])
        image = g.op("Pad", image, g.integers([0, 0, 0, 0, 0, 0, below, right]))
        return g.op("AveragePool", image, kernel_shape=[stride] * 2, strides=[stride] * 2)

    relief, valid = planes
    one_pixel = g.constant(1.0 / stride**2)
    mean = g.op("Div", share(relief), g.op("Max", share(valid), one_pixel))  # relief is 0 where invalid
    return g.reshape(mean, [0, 1, -1])
