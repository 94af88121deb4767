"""The student as one ONNX graph, written from its parameter tree.

Mirrors student_jax module by module (the parity test compares them); pictures are NCHW here, NHWC there.
The DDIM loop is unrolled: the diffusion step is then a constant, so its embedding folds into the biases and
what depends on the observation alone is computed once.
"""

from collections.abc import Mapping

import numpy as np
import onnx
from onnx import TensorProto

from ddgrasp import contract
from ddgrasp.config import ExportConfig, StudentConfig
from ddgrasp.contract import CameraProfile
from ddgrasp.errors import UserError
from export.builder import GraphBuilder, tensor
from export.metadata import PolicyMetadata, check_depth_dtype
from student_jax import denoiser, diffusion, encoder, hand_view, policy, preprocess

Params = Mapping


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
        student, export, profile: the configuration `params` belong to.
        metadata: what the file shall say about itself (`export.metadata.describe`).

    Raises:
        UserError: an option that does not exist, or parameters of another configuration.
    """
    check_options(student, export)
    check_params(params, student, profile)
    g = GraphBuilder()
    picture, planes = write_picture(g, contract.ONNX_INPUT_DEPTH, student, export, profile)
    features = write_encoder(g, picture, planes, params["encoder"], student, profile)
    cond = write_condition(g, features, picture, contract.ONNX_INPUT_STATE, params, student, profile)
    write_sampler(g, cond, params["denoiser"], student, export.ddim_steps or student.ddim_steps)
    depth_type = TensorProto.UINT16 if export.depth_dtype == "uint16_mm" else TensorProto.FLOAT
    chunk = ["batch", student.chunk, contract.ACTION_SIZE]
    frames = ["batch", contract.DEPTH_FRAMES, profile.height_px, profile.width_px]
    return g.model(
        [
            tensor(contract.ONNX_INPUT_DEPTH, frames, depth_type),
            tensor(contract.ONNX_INPUT_STATE, ["batch", contract.STATE_SIZE]),
            tensor(contract.ONNX_INPUT_NOISE, chunk),
        ],
        [tensor(contract.ONNX_OUTPUT_ACTION, chunk)],
        {contract.ONNX_METADATA_KEY: metadata.to_json()},
    )


# --- checks ------------------------------------------------------------------------------------


def check_options(student: StudentConfig, export: ExportConfig) -> None:
    """UserError for an option that the graph cannot express."""
    preprocess.check_channels(student)
    encoder.check_encoder(student)
    policy.check_head(student)
    hand_view.check_hand_view(student)
    denoiser.check_denoiser(student)
    check_depth_dtype(export.depth_dtype)
    steps = export.ddim_steps or student.ddim_steps
    if not 1 <= steps <= student.diffusion_steps:
        raise UserError(f"ddim_steps is {steps}; expected 1 to {student.diffusion_steps} (diffusion_steps).")


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
    first = np.array(profile.crop_origin_px) + [window.rows.start, window.columns.start]
    last = first + [window.rows.length, window.columns.length]
    depth = g.slice(raw, first.tolist(), last.tolist(), [2, 3])
    if export.depth_dtype == "uint16_mm":
        depth = g.mul(g.op("Cast", depth, to=TensorProto.FLOAT), g.constant(contract.DEPTH_UNIT_M))
    near = g.op("GreaterOrEqual", depth, g.constant(student.min_depth_m))
    usable = g.op("And", near, g.op("LessOrEqual", depth, g.constant(student.max_depth_m)))
    depth = g.op("Where", usable, depth, g.constant(0.0))
    valid = g.op("Cast", usable, to=TensorProto.FLOAT)
    table = preprocess.table_depth(profile, student.max_depth_m)[first[0] : last[0], first[1] : last[1]]
    relief = g.op("Sub", g.constant(table[None, None]), depth)
    relief = g.op("Div", relief, g.constant(preprocess.RELIEF_SCALE_M))
    relief, depth, valid = _write_resize(g, relief, depth, valid, window)
    relief = g.op("Clip", relief, g.constant(preprocess.RELIEF_MIN), g.constant(preprocess.RELIEF_MAX))
    planes = {"relief": g.mul(relief, valid), "valid": valid, "depth": depth}
    stacked = g.concat([g.op("Unsqueeze", planes[c], g.integers([2])) for c in student.channels], axis=2)
    count = contract.DEPTH_FRAMES * len(student.channels)
    picture = g.reshape(stacked, [0, count, student.input_height_px, student.input_width_px])
    return picture, (planes["relief"], planes["valid"])


def _write_resize(
    g: GraphBuilder, relief: str, depth: str, valid: str, window: preprocess.Window
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


# --- encoder (student_jax/encoder.py) -----------------------------------------------------------


def write_encoder(
    g: GraphBuilder,
    picture: str,
    planes: tuple[str, str],
    params: Params,
    student: StudentConfig,
    profile: CameraProfile,
) -> str:
    """Picture to features (B, feature_size)."""
    x = _write_stem(g, picture, params["stem"], student.stem)
    for index, (_, stride) in enumerate(encoder.stage_plan(student)):
        for block in range(student.stage_blocks[index]):
            x = _write_block(g, x, params[f"stage{index}_block{block}"], stride if block == 0 else 1)
    if student.pooling == "mean":
        pooled = g.op("Flatten", g.op("GlobalAveragePool", x))
        return g.relu(g.dense(pooled, params["features"]))
    kernel, bias = params["cells"]["kernel"], params["cells"]["bias"]
    cells = g.conv(x, np.asarray(kernel)[None, None], bias)
    cells = g.reshape(cells, [0, student.keypoints, -1])  # (B, K, P)
    if student.pooling == "tokens":
        return _write_tokens(g, cells, params["features"], profile)
    points = _write_keypoints(g, cells, planes, student, profile)
    return g.relu(g.dense(points, params["features"]))


def _write_stem(g: GraphBuilder, x: str, params: Params, kind: str) -> str:
    if kind == "conv7":
        x = g.relu(_write_conv_norm(g, x, params["conv7"], 2))
        return g.op("MaxPool", x, kernel_shape=[3, 3], strides=[2, 2], pads=[1, 1, 1, 1])
    size = encoder.STEM_STRIDE
    kernel = np.asarray(params["patch"]["kernel"])
    patches = kernel.reshape(size, size, -1, kernel.shape[1])  # (dy, dx, in, out)
    x = g.conv(x, patches, params["patch"].get("bias"), stride=size)
    return g.relu(_write_norm(g, x, params.get("norm")))


def _write_block(g: GraphBuilder, x: str, params: Params, stride: int) -> str:
    y = g.relu(_write_conv_norm(g, x, params["first"], stride))
    y = _write_conv_norm(g, y, params["second"], 1)
    shortcut = _write_conv_norm(g, x, params["shortcut"], stride) if "shortcut" in params else x
    return g.relu(g.add(shortcut, y))


def _write_conv_norm(g: GraphBuilder, x: str, params: Params, stride: int) -> str:
    kernel = np.asarray(params["conv"]["kernel"])
    x = g.conv(x, kernel, params["conv"].get("bias"), stride=stride, pad=kernel.shape[0] // 2)
    return _write_norm(g, x, params.get("norm"))


def _write_norm(g: GraphBuilder, x: str, params: Params | None) -> str:
    """GroupNorm: InstanceNormalization over groups, then scale and bias per channel."""
    if params is None:
        return x
    channels = len(params["scale"])
    groups = channels // encoder.GROUP_CHANNELS
    ones, zeros = g.constant(np.ones(groups)), g.constant(np.zeros(groups))
    grouped = g.reshape(x, [0, groups, -1])
    grouped = g.op("InstanceNormalization", grouped, ones, zeros, epsilon=encoder.EPSILON)
    normal = g.op("Reshape", grouped, g.op("Shape", x))
    scaled = g.mul(normal, g.constant(np.reshape(params["scale"], (channels, 1, 1))))
    return g.add(scaled, g.constant(np.reshape(params["bias"], (channels, 1, 1))))


def _write_tokens(g: GraphBuilder, cells: str, params: Params, profile: CameraProfile) -> str:
    """Every cell's channels, flattened; the centred crop's coordinates are a constant: part of the bias."""
    tokens = g.op("Flatten", g.relu(g.op("Transpose", cells, perm=[0, 2, 1])))
    kernel = np.asarray(params["kernel"])
    centre = encoder.static_crop_centre(profile)
    bias = np.asarray(params["bias"]) + centre @ kernel[-len(centre) :]
    return g.relu(g.affine(tokens, kernel[: -len(centre)], bias))


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
    below, right = -student.input_height_px % stride, -student.input_width_px % stride

    newest = contract.DEPTH_FRAMES - 1

    def share(frames: str) -> str:
        image = g.slice(frames, [newest], [newest + 1], [1])
        image = g.op("Pad", image, g.integers([0, 0, 0, 0, 0, 0, below, right]))
        return g.op("AveragePool", image, kernel_shape=[stride] * 2, strides=[stride] * 2)

    relief, valid = planes
    one_pixel = g.constant(1.0 / stride**2)
    mean = g.op("Div", share(relief), g.op("Max", share(valid), one_pixel))  # relief is 0 where invalid
    return g.reshape(mean, [0, 1, -1])


# --- hand view (student_jax/hand_view.py) --------------------------------------------------------


def write_grip(g: GraphBuilder, state: str) -> str:
    """(B, 3) the point between the finger pads (m) from the raw state (B, 8): `policy.grip_position`."""
    point = g.op("Expand", g.constant(hand_view.grip_tip()[None]), g.op("Shape", _columns(g, state, 0, 3)))
    for joint, (rotation, offset) in reversed(list(enumerate(hand_view.grip_chain()))):
        angle = _columns(g, state, joint, joint + 1)
        cosine, sine = g.op("Cos", angle), g.op("Sin", angle)
        x, y, z = (_columns(g, point, i, i + 1) for i in range(3))
        turned_x = g.op("Sub", g.mul(cosine, x), g.mul(sine, y))
        turned_y = g.add(g.mul(sine, x), g.mul(cosine, y))
        point = g.affine(g.concat([turned_x, turned_y, z], axis=1), rotation.T, offset)
    return point


def write_hand_view(
    g: GraphBuilder, picture: str, grip: str, params: Params, student: StudentConfig, profile: CameraProfile
) -> str:
    """Picture (B, C, h, w) and grip point (B, 3) to (B, hand_view_features)."""
    view = _write_cut(g, picture, grip, student, profile)
    x = _write_stem(g, view, params["stem"], hand_view.STEM)
    for block in range(student.hand_view_blocks):
        x = _write_block(g, x, params[f"block{block}"], 1)
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
    depth = g.op("Max", _columns(g, point, 2, 3), g.constant(hand_view.MIN_CAMERA_DEPTH_M))
    origin = np.array(profile.crop_origin_px) * view.shrink
    samples = []
    for axis, (column, length) in enumerate(((1, student.input_height_px), (0, student.input_width_px))):
        per_metre = g.op("Div", g.constant(view.focal_px[axis]), depth)  # (B, 1)
        centre = g.mul(_columns(g, point, column, column + 1), per_metre)
        centre = g.add(centre, g.constant(view.centre_px[axis] - origin[axis]))
        samples.append(_write_sampling(g, centre, per_metre, length, student))
    rows, columns = samples
    seen = g.op("MatMul", g.op("Unsqueeze", rows, g.integers([1])), picture)  # (B, C, n, w)
    columns = g.op("Unsqueeze", g.op("Transpose", columns, perm=[0, 2, 1]), g.integers([1]))
    seen = g.op("MatMul", seen, columns)  # (B, C, n, n)
    count, kinds = student.hand_view_px, len(student.channels)
    frames = g.reshape(seen, [0, contract.DEPTH_FRAMES, kinds, count, count])
    valid = student.channels.index("valid")
    coverage = g.slice(frames, [valid], [valid + 1], [2])
    divisor = g.op("Max", coverage, g.constant(hand_view.MIN_COVERAGE))
    parts = [
        coverage if i == valid else g.op("Div", g.slice(frames, [i], [i + 1], [2]), divisor)
        for i in range(kinds)
    ]
    return g.reshape(g.concat(parts, axis=2), [0, contract.DEPTH_FRAMES * kinds, count, count])


def _write_sampling(g: GraphBuilder, centre: str, per_metre: str, length: int, student: StudentConfig) -> str:
    """(B, n, length) weights from centre and scale (B, 1), as `hand_view.sampling_matrix`."""
    count = student.hand_view_px
    offsets = (np.arange(count) - (count - 1) / 2) * student.hand_view_pitch_m
    place = g.add(centre, g.mul(per_metre, g.constant(offsets[None])))  # (B, n)
    support = g.op("Max", g.mul(per_metre, g.constant(student.hand_view_pitch_m)), g.constant(1.0))
    support = g.op("Unsqueeze", support, g.integers([2]))  # (B, 1, 1)
    pixels = (np.arange(length) + 0.5)[None, None]
    distance = g.op("Abs", g.op("Sub", g.op("Unsqueeze", place, g.integers([2])), g.constant(pixels)))
    weight = g.op("Sub", g.constant(1.0), g.op("Div", distance, support))
    return g.op("Div", g.relu(weight), support)


def _columns(g: GraphBuilder, x: str, first: int, last: int) -> str:
    return g.slice(x, [first], [last], [1])


# --- condition and sampler (student_jax/policy.py, denoiser.py, diffusion.py) ---------------------


def write_condition(
    g: GraphBuilder,
    features: str,
    picture: str,
    state: str,
    params: Params,
    student: StudentConfig,
    profile: CameraProfile,
) -> str:
    """Features (B, F), picture and raw state (B, 8) to the condition (B, D)."""
    span = denoiser.STATE_UPPER - denoiser.STATE_LOWER
    joints = g.op(
        "Div", g.mul(g.op("Sub", state, g.constant(denoiser.STATE_LOWER)), g.constant(2.0)), g.constant(span)
    )
    joints = g.op("Sub", joints, g.constant(1.0))
    grip_m = write_grip(g, state)
    centre = g.constant(encoder.POSITION_CENTER_M)
    grip = g.op("Div", g.op("Sub", grip_m, centre), g.constant(encoder.POSITION_SCALE_M))
    known = [joints]
    if student.hand_view_px:
        beside = write_hand_view(g, picture, grip_m, params["hand_view"], student, profile)
        features = g.concat([features, beside], axis=1)
        known.append(grip)
    stream = params["state_stream"]
    parts = [g.relu(g.dense(g.relu(g.dense(joints, stream["first"])), stream["second"]))]
    if student.features_to_head:
        parts.append(features)
    if student.aux_to_head:
        hidden = g.relu(g.dense(g.concat([features, *known], axis=1), params["aux_hidden"]))
        raw = g.dense(hidden, params["aux_output"])
        position = _columns(g, raw, 0, 3)
        if student.hand_view_px:
            offset = g.mul(_columns(g, raw, 6, 9), g.constant(policy.BESIDE_SCALE))
            near = g.op("Sigmoid", _columns(g, raw, 9, 10))
            far = g.op("Sub", g.constant(1.0), near)
            position = g.add(g.mul(near, g.add(grip, offset)), g.mul(far, position))
        beside = g.op("Div", g.op("Sub", position, grip), g.constant(policy.BESIDE_SCALE))
        held = g.op("Sigmoid", _columns(g, raw, 5, 6))
        parts += [position, _columns(g, raw, 3, 5), held, beside]
    return g.concat(parts, axis=1)


def write_sampler(
    g: GraphBuilder, cond: str, params: Params, student: StudentConfig, iterations: int
) -> None:
    """DDIM from the noise input to the action output."""
    schedule = policy.noise_schedule(student)
    network = _Denoiser(g, cond, params, student)
    size = student.chunk * contract.ACTION_SIZE
    x = g.reshape(contract.ONNX_INPUT_NOISE, [0, size])
    for k, row in zip(
        diffusion.ddim_timesteps(schedule.steps, iterations),
        diffusion.ddim_coefficients(schedule, iterations),
        strict=True,
    ):
        x = _write_ddim_step(g, x, network.predict(x, int(k)), row)
    shape = g.integers([0, student.chunk, contract.ACTION_SIZE])
    g.nodes.append(onnx.helper.make_node("Reshape", [x, shape], [contract.ONNX_OUTPUT_ACTION], name="action"))


def _write_ddim_step(g: GraphBuilder, x: str, eps: str, row: np.ndarray) -> str:
    """One step of `diffusion.ddim_step`; the last one is x0 itself."""
    scaled = g.mul(x, g.constant(row[0]))
    x0 = g.op("Sub", scaled, g.mul(eps, g.constant(row[1])))
    x0 = g.op("Clip", x0, g.constant(-1.0), g.constant(1.0))
    if row[3] == 0:
        return x0
    agreeing = g.op("Div", g.op("Sub", scaled, x0), g.constant(row[1]))
    return g.add(g.mul(x0, g.constant(row[2])), g.mul(agreeing, g.constant(row[3])))


class _Denoiser:
    """Writes the denoiser once per diffusion step, sharing all that does not depend on the step.

    A Dense over the concatenation [cond, time] is cond @ its upper rows (shared) + time @ its lower rows
    (a constant).
    """

    def __init__(self, g: GraphBuilder, cond: str, params: Params, student: StudentConfig):
        self.g, self.params, self.student = g, params, student
        self.film = student.conditioning == "film"
        self.action_size = student.chunk * contract.ACTION_SIZE
        blocks = range(student.denoiser_blocks) if self.film else []
        self.films = [self._shared(cond, np.asarray(params[f"block{i}"]["film"]["kernel"])) for i in blocks]
        if not self.film:
            self.input = self._shared(cond, np.asarray(params["input"]["kernel"])[self.action_size :])

    def _shared(self, cond: str, kernel: np.ndarray) -> str:
        return self.g.op("MatMul", cond, self.g.constant(kernel[: -self.student.time_features]))

    def predict(self, x: str, k: int) -> str:
        """Noise predicted for the flattened chunk x (B, chunk * 8) at diffusion step k."""
        g, params = self.g, self.params
        time = self._time(k)
        kernel, bias = np.asarray(params["input"]["kernel"]), np.asarray(params["input"]["bias"])
        if self.film:
            x = g.affine(x, kernel, bias)
        else:
            fixed = bias + time @ kernel[-len(time) :]
            x = g.add(g.affine(x, kernel[: self.action_size], fixed), self.input)
        for index in range(self.student.denoiser_blocks):
            x = self._block(x, index, time)
        return g.dense(g.silu(self._layer_norm(x, params["norm"])), params["output"])

    def _time(self, k: int) -> np.ndarray:
        """The embedded step after its two Dense layers."""
        angles = k * denoiser.time_frequencies(self.student.time_features)
        first, second = self.params["time_first"], self.params["time_second"]
        hidden = np.concatenate([np.sin(angles), np.cos(angles)]) @ first["kernel"] + first["bias"]
        hidden = hidden / (1.0 + np.exp(-hidden))
        return np.asarray(hidden @ second["kernel"] + second["bias"])

    def _block(self, x: str, index: int, time: np.ndarray) -> str:
        g, params = self.g, self.params[f"block{index}"]
        y = g.dense(self._layer_norm(x, params["norm"]), params["first"])
        if self.film:
            width = self.student.denoiser_width
            fixed = (
                np.asarray(params["film"]["bias"]) + time @ np.asarray(params["film"]["kernel"])[-len(time) :]
            )
            one_plus = np.concatenate([1.0 + fixed[:width], fixed[width:]])
            film = g.add(self.films[index], g.constant(one_plus))
            y = g.mul(y, g.slice(film, [0], [width], [1]))
            y = g.add(y, g.slice(film, [width], [2 * width], [1]))
        return g.add(x, g.dense(g.silu(y), params["second"]))

    def _layer_norm(self, x: str, params: Params) -> str:
        scale, bias = self.g.constant(params["scale"]), self.g.constant(params["bias"])
        return self.g.op("LayerNormalization", x, scale, bias, axis=-1, epsilon=denoiser.LAYER_NORM_EPSILON)
