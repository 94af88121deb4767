"""ONNX nodes of the second look around the hand (student_jax/hand_view.py)."""

import numpy as np

from ddgrasp import contract
from ddgrasp.config import StudentConfig
from ddgrasp.contract import CameraProfile
from export import layers
from export.builder import GraphBuilder
from export.layers import Params
from student_jax import hand_view


def write_grip(g: GraphBuilder, state: str) -> str:
    """(B, 3) the point between the finger pads (m) from the raw state (B, 9): `policy.grip_position`."""
    point = g.op(
        "Expand", g.constant(hand_view.grip_tip()[None]), g.op("Shape", g.columns(state, slice(0, 3)))
    )
    for joint, (rotation, offset) in reversed(list(enumerate(hand_view.grip_chain()))):
        angle = g.column(state, joint)
        cosine, sine = g.op("Cos", angle), g.op("Sin", angle)
        x, y, z = (g.column(point, i) for i in range(3))
        turned_x = g.op("Sub", g.mul(cosine, x), g.mul(sine, y))
        turned_y = g.add(g.mul(sine, x), g.mul(cosine, y))
        point = g.affine(g.concat([turned_x, turned_y, z], axis=1), rotation.T, offset)
    return point


def write_hand_view(
    g: GraphBuilder, picture: str, grip: str, params: Params, student: StudentConfig, profile: CameraProfile
) -> str:
    """Picture (B, C, h, w) and grip point (B, 3) to (B, hand_view.features)."""
    view = _write_cut(g, picture, grip, student, profile)
    x = layers.write_stem(g, view, params["stem"], hand_view.STEM)
    for block in range(student.hand_view.blocks):
        x = layers.write_block(g, x, params[f"block{block}"], 1)
    kernel, bias = params["cells"]["kernel"], params["cells"]["bias"]
    cells = g.relu(g.conv(x, np.asarray(kernel)[None, None], bias))
    flat = g.op("Flatten", g.op("Transpose", cells, perm=[0, 2, 3, 1]))
    return g.relu(g.dense(flat, params["features"]))


def _write_cut(
    g: GraphBuilder, picture: str, grip: str, student: StudentConfig, profile: CameraProfile
) -> str:
    """(B, C, n, n) part of the picture around the hand, as `hand_view.place` and `hand_view.cut`."""
    view = hand_view.projection(profile, student)
    point = g.affine(grip, view.rotation.T, view.offset_m)
    depth = g.op("Max", g.column(point, 2), g.constant(hand_view.MIN_CAMERA_DEPTH_M))
    origin = np.array(profile.crop_origin_px) * view.shrink
    samples = []
    for axis, (column, length) in enumerate(((1, student.picture.height_px), (0, student.picture.width_px))):
        per_metre = g.op("Div", g.constant(view.focal_px[axis]), depth)  # (B, 1)
        centre = g.mul(g.column(point, column), per_metre)
        centre = g.add(centre, g.constant(view.centre_px[axis] - origin[axis]))
        samples.append(_write_sampling(g, centre, per_metre, length, student))
    rows, columns = samples
    seen = g.op("MatMul", g.op("Unsqueeze", rows, g.integers([1])), picture)  # (B, C, n, w)
    columns = g.op("Unsqueeze", g.op("Transpose", columns, perm=[0, 2, 1]), g.integers([1]))
    seen = g.op("MatMul", seen, columns)  # (B, C, n, n)
    count, kinds = student.hand_view.size_px, len(student.picture.channels)
    frames = g.reshape(seen, [0, contract.DEPTH_FRAMES, kinds, count, count])
    valid = student.picture.channels.index("valid")
    coverage = g.slice(frames, [valid], [valid + 1], [2])
    divisor = g.op("Max", coverage, g.constant(hand_view.MIN_COVERAGE))
    parts = [
        coverage if i == valid else g.op("Div", g.slice(frames, [i], [i + 1], [2]), divisor)
        for i in range(kinds)
    ]
    return g.reshape(g.concat(parts, axis=2), [0, contract.DEPTH_FRAMES * kinds, count, count])


def _write_sampling(g: GraphBuilder, centre: str, per_metre: str, length: int, student: StudentConfig) -> str:
    """(B, n, length) weights from centre and scale (B, 1), as `hand_view.sampling_matrix`."""
    count = student.hand_view.size_px
    offsets = (np.arange(count) - (count - 1) / 2) * student.hand_view.pitch_m
    place = g.add(centre, g.mul(per_metre, g.constant(offsets[None])))  # (B, n)
    support = g.op("Max", g.mul(per_metre, g.constant(student.hand_view.pitch_m)), g.constant(1.0))
    support = g.op("Unsqueeze", support, g.integers([2]))  # (B, 1, 1)
    pixels = (np.arange(length) + 0.5)[None, None]
    distance = g.op("Abs", g.op("Sub", g.op("Unsqueeze", place, g.integers([2])), g.constant(pixels)))
    weight = g.op("Sub", g.constant(1.0), g.op("Div", distance, support))
    return g.op("Div", g.relu(weight), support)
