"""ONNX nodes of the condition: what the action head is told (student_jax/policy.py)."""

from ddgrasp.config import StudentConfig
from ddgrasp.contract import CameraProfile
from export.builder import GraphBuilder
from export.hand_view_graph import write_grip, write_hand_view
from export.layers import Params
from student_jax import denoiser, encoder, policy
from student_jax.policy import AUX, AUX_BESIDE


def write_condition(
    g: GraphBuilder,
    features: str,
    picture: str,
    state: str,
    params: Params,
    student: StudentConfig,
    profile: CameraProfile,
) -> str:
    """Features (B, F), picture and raw state (B, 9) to the condition (B, D)."""
    span = denoiser.STATE_UPPER - denoiser.STATE_LOWER
    joints = g.op(
        "Div", g.mul(g.op("Sub", state, g.constant(denoiser.STATE_LOWER)), g.constant(2.0)), g.constant(span)
    )
    joints = g.op("Sub", joints, g.constant(1.0))
    grip_m = write_grip(g, state)
    centre = g.constant(encoder.POSITION_CENTER_M)
    grip = g.op("Div", g.op("Sub", grip_m, centre), g.constant(encoder.POSITION_SCALE_M))
    known = [joints]
    if student.hand_view.size_px:
        beside = write_hand_view(g, picture, grip_m, params["hand_view"], student, profile)
        features = g.concat([features, beside], axis=1)
        known.append(grip)
    stream = params["state_stream"]
    parts = [g.relu(g.dense(g.relu(g.dense(joints, stream["first"])), stream["second"]))]
    if student.head.features_to_head:
        parts.append(features)
    if student.head.aux_to_head:
        hidden = g.relu(g.dense(g.concat([features, *known], axis=1), params["aux_hidden"]))
        raw = g.dense(hidden, params["aux_output"])
        position = g.columns(raw, AUX.position)
        if student.hand_view.size_px:
            offset = g.mul(g.columns(raw, AUX_BESIDE.beside), g.constant(policy.BESIDE_SCALE))
            near = g.op("Sigmoid", g.columns(raw, AUX_BESIDE.near))
            far = g.op("Sub", g.constant(1.0), near)
            position = g.add(g.mul(near, g.add(grip, offset)), g.mul(far, position))
        beside = g.op("Div", g.op("Sub", position, grip), g.constant(policy.BESIDE_SCALE))
        held = g.op("Sigmoid", g.columns(raw, AUX.held))
        parts += [position, g.columns(raw, AUX.yaw), held, beside]
    return g.concat(parts, axis=1)
