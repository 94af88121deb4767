"""The student as one ONNX graph, written from its parameter tree.

Mirrors student_jax module by module (the parity test compares them); pictures are NCHW here, NHWC there.
The DDIM loop is unrolled: the diffusion step is then a constant, so its embedding folds into the biases and
what depends on the observation alone is computed once.
"""

from collections.abc import Mapping

import onnx
from onnx import TensorProto

from ddgrasp import contract
from ddgrasp.config import ExportConfig, StudentConfig
from ddgrasp.contract import CameraProfile
from ddgrasp.errors import UserError
from ddgrasp.policy_metadata import PolicyMetadata
from export.builder import GraphBuilder, tensor
from export.condition_graph import write_condition
from export.encoder_graph import write_encoder
from export.layers import Params
from export.sampler_graph import write_sampler
from student_jax import policy, preprocess


def build_model(
    params: Params,
    student: StudentConfig,
    export: ExportConfig,
    profile: CameraProfile,
    metadata: PolicyMetadata,
) -> onnx.ModelProto:
    """The whole policy: raw depth, state and noise in, action chunk out.

    Args:
        params: tree of `student_jax.policy.init_params`.
        student: the configuration `params` belong to.
        export: that of the file.
        profile: the camera's.
        metadata: what the file shall say about itself (`ddgrasp.policy_metadata.describe`).

    Raises:
        UserError: more denoising iterations than diffusion steps, or parameters of another configuration.
    """
    check_steps(student, export)
    check_params(params, student, profile)
    g = GraphBuilder()
    picture, planes = write_picture(g, contract.ONNX_INPUT_DEPTH, student, export, profile)
    features = write_encoder(g, picture, planes, params["encoder"], student, profile)
    cond = write_condition(g, features, picture, contract.ONNX_INPUT_STATE, params, student, profile)
    write_sampler(g, cond, params["denoiser"], student, export.ddim_steps or student.head.ddim_steps)
    depth_type = TensorProto.UINT16 if export.depth_dtype == "uint16_mm" else TensorProto.FLOAT
    chunk = ["batch", student.head.chunk, contract.ACTION_SIZE]
    frames = ["batch", contract.DEPTH_FRAMES, profile.height_px, profile.width_px]
    return g.model(
        [
            tensor(contract.ONNX_INPUT_DEPTH, frames, depth_type),
            tensor(contract.ONNX_INPUT_STATE, ["batch", contract.POLICY_STATE_SIZE]),
            tensor(contract.ONNX_INPUT_NOISE, chunk),
        ],
        [tensor(contract.ONNX_OUTPUT_ACTION, chunk)],
        {contract.ONNX_METADATA_KEY: metadata.to_json()},
    )


# --- checks ------------------------------------------------------------------------------------


def check_steps(student: StudentConfig, export: ExportConfig) -> None:
    """UserError for more denoising iterations than the student has diffusion steps."""
    if export.ddim_steps > student.head.diffusion_steps:
        raise export.error("ddim_steps", f"1 to {student.head.diffusion_steps} (diffusion_steps)")


def check_params(params: Params, student: StudentConfig, profile: CameraProfile) -> None:
    """UserError naming the first array that does not belong to this configuration."""
    expected = _shapes(policy.param_shapes(student, profile))
    given = _shapes(params)
    for name in sorted(expected.keys() | given.keys()):
        if expected.get(name) != given.get(name):
            raise UserError(
                f"Student parameters do not fit the configuration: {name} has shape {given.get(name)}, "
                f"expected {expected.get(name)}. Export with the configuration that trained them."
            )


def _shapes(tree: Params, prefix: str = "") -> dict[str, tuple[int, ...]]:
    shapes = {}
    for name, value in tree.items():
        path = f"{prefix}/{name}" if prefix else name
        shapes |= _shapes(value, path) if isinstance(value, Mapping) else {path: tuple(value.shape)}
    return shapes


# --- picture (student_jax/preprocess.py) --------------------------------------------------------


def write_picture(
    g: GraphBuilder, raw: str, student: StudentConfig, export: ExportConfig, profile: CameraProfile
) -> tuple[str, tuple[str, str]]:
    """Raw depth (B, 3, H, W) to the picture (B, 3C, h, w) and its (relief, valid), each (B, 3, h, w)."""
    window = preprocess.plan_window(profile, student)
    first = preprocess.first_pixel(None, profile, student)[0]
    last = first + [window.rows.length, window.columns.length]
    depth = g.slice(raw, first.tolist(), last.tolist(), [2, 3])
    if export.depth_dtype == "uint16_mm":  # as `ddgrasp.depth.to_metres`
        depth = g.mul(g.op("Cast", depth, to=TensorProto.FLOAT), g.constant(contract.DEPTH_UNIT_M))
    near = g.op("GreaterOrEqual", depth, g.constant(student.picture.min_depth_m))
    usable = g.op("And", near, g.op("LessOrEqual", depth, g.constant(student.picture.max_depth_m)))
    depth = g.op("Where", usable, depth, g.constant(0.0))
    valid = g.op("Cast", usable, to=TensorProto.FLOAT)
    table = preprocess.table_depth(profile, student.picture.max_depth_m)[
        first[0] : last[0], first[1] : last[1]
    ]
    relief = g.op("Sub", g.constant(table[None, None]), depth)
    relief = g.op("Div", relief, g.constant(preprocess.RELIEF_SCALE_M))
    relief, depth, valid = _write_resize(g, relief, depth, valid, window)
    if student.picture.fill_holes:
        size = (student.picture.height_px, student.picture.width_px)
        relief = _write_filled(g, relief, valid, size)
        depth = _write_filled(g, depth, valid, size) if "depth" in student.picture.channels else depth
        some = g.op("ReduceMax", valid, g.integers([2, 3]))
        valid = g.op("Expand", some, g.op("Shape", valid))
    relief = g.op("Clip", relief, g.constant(preprocess.RELIEF_MIN), g.constant(preprocess.RELIEF_MAX))
    planes = {"relief": g.mul(relief, valid), "valid": valid, "depth": depth}
    stacked = g.concat(
        [g.op("Unsqueeze", planes[c], g.integers([2])) for c in student.picture.channels], axis=2
    )
    count = contract.DEPTH_FRAMES * len(student.picture.channels)
    picture = g.reshape(stacked, [0, count, student.picture.height_px, student.picture.width_px])
    return picture, (planes["relief"], planes["valid"])


def _write_filled(g: GraphBuilder, plane: str, valid: str, size: tuple[int, int]) -> str:
    """`preprocess.filled` of (B, 3, *size). Pools are means where there are sums: only quotients count."""
    has = g.op("Greater", valid, g.constant(0.0))
    known = g.op("Where", has, plane, g.constant(0.0))
    rows, columns = size
    if rows % 2 or columns % 2:
        total, count = (g.op("ReduceSum", x, g.integers([2, 3])) for x in (known, valid))
        return g.op("Where", has, known, g.op("Div", total, g.op("Max", count, g.constant(1.0))))
    total, count = (g.op("AveragePool", x, kernel_shape=[2, 2], strides=[2, 2]) for x in (known, valid))
    means, some = _write_mean(g, total, count, 4)
    coarse = _write_filled(g, means, g.op("Cast", some, to=TensorProto.FLOAT), (rows // 2, columns // 2))
    around = g.op(
        "Resize", coarse, "", g.constant([1.0, 1.0, 2.0, 2.0]),
        mode="linear", coordinate_transformation_mode="half_pixel",
    )  # fmt: skip
    total, count = (
        g.op("AveragePool", x, kernel_shape=[3, 3], pads=[1] * 4, count_include_pad=1) for x in (known, valid)
    )
    beside, some = _write_mean(g, total, count, 9)
    return g.op("Where", has, known, g.op("Where", some, beside, around))


def _write_mean(g: GraphBuilder, total: str, count: str, pixels: int) -> tuple[str, str]:
    """Mean over the valid ones of `pixels`, and whether any is; `total` and `count` are means over all."""
    some = g.op("Greater", count, g.constant(0.5 / pixels))
    return g.op("Div", total, g.op("Max", count, g.constant(1.0 / pixels))), some


def _write_resize(
    g: GraphBuilder, relief: str, depth: str, valid: str, window: preprocess.ResizeWindow
) -> tuple[str, str, str]:
    """resize(x * valid) / resize(valid), as `preprocess._resize_masked`."""

    def resize(image: str) -> str:
        if window.rows.matrix is not None:
            image = g.op("MatMul", g.constant(window.rows.matrix), image)
        if window.columns.matrix is not None:
            image = g.op("MatMul", image, g.constant(window.columns.matrix.T))
        return image

    relief = g.mul(relief, valid)
    if window.rows.matrix is None and window.columns.matrix is None:
        return relief, depth, valid
    coverage = resize(valid)
    least = g.constant(preprocess.COVERAGE_MIN)
    resized_valid = g.op("Cast", g.op("GreaterOrEqual", coverage, least), to=TensorProto.FLOAT)
    weight = g.op("Div", resized_valid, g.op("Max", coverage, least))
    return g.mul(resize(relief), weight), g.mul(resize(depth), weight), resized_valid
