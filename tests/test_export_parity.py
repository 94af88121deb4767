"""The ONNX file computes what JAX computes, for every option, unit, batch size and kind of bad pixel."""

from dataclasses import replace
from functools import cache
from typing import get_args

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from ddgrasp import contract
from ddgrasp import policy_metadata as metadata
from ddgrasp.config import (
    EncoderConfig,
    ExportConfig,
    HandViewConfig,
    HeadConfig,
    PictureConfig,
    StudentConfig,
)
from ddgrasp.config.student import Conditioning
from ddgrasp.errors import UserError
from ddgrasp.gripper import CLOSE
from ddgrasp.layout import ACTION
from ddgrasp.policy_metadata import POLICY_FILE
from demos.rollout import Scene
from deploy.policy import OnnxPolicy
from export import graph, parity
from learning.diffusion import q_sample
from student_jax import policy
from student_jax.act import StudentActor, keep_clean

PROFILE = contract.D455.scaled(0.125)
SMALL = StudentConfig(
    picture=PictureConfig(height_px=56, width_px=72),
    encoder=EncoderConfig(width=8, stage_blocks=(1, 1), keypoints=8, features=32),
    head=HeadConfig(state_features=16, width=48, blocks=2, time_features=16, chunk=3),
    hand_view=HandViewConfig(size_px=16, pitch_m=0.008, width=8, blocks=1, channels=2, features=16),
)
OPTIONS = {
    "keypoints, trimmed crop": (SMALL, ExportConfig(depth_dtype="uint16_mm")),
    "keypoints, resized, floats, padded cells": (
        replace(
            SMALL,
            picture=replace(SMALL.picture, height_px=40, width_px=52, fill_holes=True),
            encoder=replace(SMALL.encoder, output_stride=16, stage_blocks=(1, 1, 1)),
        ),
        ExportConfig(depth_dtype="float32_m", ddim_steps=4),
    ),
    "tokens, conv7, concat, all channels": (
        replace(
            SMALL,
            encoder=replace(SMALL.encoder, pooling="tokens", stem="conv7", keypoints=2),
            head=replace(SMALL.head, conditioning="concat", features_to_head=True),
            picture=replace(
                SMALL.picture,
                channels=("depth", "relief", "valid"),
                height_px=48,
                width_px=64,
                fill_holes=True,
            ),
            hand_view=replace(SMALL.hand_view, pitch_m=0.002),
        ),
        ExportConfig(depth_dtype="float32_m"),
    ),
    "mean, no norm, no auxiliary": (
        replace(
            SMALL,
            encoder=replace(SMALL.encoder, pooling="mean", norm="none"),
            hand_view=replace(SMALL.hand_view, size_px=0),
            head=replace(SMALL.head, features_to_head=True, aux_to_head=False),
        ),
        ExportConfig(depth_dtype="uint16_mm"),
    ),
    **{
        f"conditioning {name}": (replace(SMALL, head=replace(SMALL.head, conditioning=name)), ExportConfig())
        for name in get_args(Conditioning)
        if name not in ("film", "concat")  # above
    },
}


@cache
def initial(config: StudentConfig) -> dict:
    return policy.init_params(jax.random.key(0), config, PROFILE)


@cache
def trained(config: StudentConfig) -> dict:
    """Parameters by which a policy can be told from another. To be left as they are."""
    return trained_head(jittered(initial(config)), config)


def jittered(params: dict, seed: int = 0) -> dict:
    """No parameter keeps a special value such as zero or one, which could hide a mistake."""
    rng = np.random.default_rng(seed)
    return jax.tree.map(lambda a: np.asarray(a + rng.normal(0, 0.05, a.shape), np.float32), params)


def trained_head(params: dict, config: StudentConfig) -> dict:
    """Denoiser trained on moderate actions: an untrained one saturates at +-1, where all policies agree."""
    net = policy.StudentPolicy(config, PROFILE)
    frames, state = jnp.zeros((1, 3, 90, 160)), jnp.zeros((1, 9))

    def condition():
        seen = net.apply({"params": params}, frames, state, method="encode")
        return net.apply({"params": params}, seen, state, method="condition")

    size, schedule = jax.eval_shape(condition).shape[-1], policy.noise_schedule(config)
    optimiser = optax.adam(3e-3)

    def loss(head, key):
        keys = jax.random.split(key, 4)
        cond = jax.random.normal(keys[0], (64, size))
        action = 0.6 * jnp.tanh(cond[:, :8])[:, None] * jnp.ones((1, config.head.chunk, 1))
        k = jax.random.randint(keys[1], (64,), 0, config.head.diffusion_steps)
        noise = jax.random.normal(keys[2], action.shape)
        noisy = q_sample(schedule, action, k, noise)
        predicted = net.apply({"params": {**params, "denoiser": head}}, noisy, k, cond, method="denoise")
        return jnp.mean((predicted - noise) ** 2)

    @jax.jit
    def train(head):
        def body(carry, key):
            head, moments = carry
            update, moments = optimiser.update(jax.grad(loss)(head, key), moments, head)
            return (optax.apply_updates(head, update), moments), None

        keys = jax.random.split(jax.random.key(3), 300)
        return jax.lax.scan(body, (head, optimiser.init(head)), keys)[0][0]

    return {**params, "denoiser": jax.tree.map(np.asarray, train(params["denoiser"]))}


def export(config: StudentConfig, options: ExportConfig, params: dict):
    described = metadata.describe(config, options, PROFILE)
    model = graph.build_model(params, config, options, PROFILE, described)
    return parity.open_session(model.SerializeToString())


@pytest.mark.parametrize("name", OPTIONS)
def test_onnx_equals_jax(name):
    config, options = OPTIONS[name]
    params = trained(config)
    session = export(config, options, params)
    reference = parity.jax_policy(params, config, PROFILE, options.ddim_steps)
    rng = np.random.default_rng(0)
    inputs = [parity.random_inputs(rng, n, config, PROFILE, options.depth_dtype) for n in [4] * 12 + [1] * 4]
    inputs[0].depth[0] = 0  # nothing seen at all
    actions = np.concatenate([parity.run_onnx(session, one) for one in inputs])
    assert actions.shape == (52, config.head.chunk, 8)
    assert np.mean(np.abs(actions) < 0.95) > 0.5  # a saturated policy would agree with anything
    assert parity.max_abs_diff(session, reference, iter(inputs)) <= 1e-4


def test_a_student_acts_in_training_as_its_file_does_on_a_robot(tmp_path):
    """Six control steps of two robots, of which every second plays a chunk on; a closing that lasts."""
    config = replace(SMALL, head=replace(SMALL.head, execute_steps=2, closing_steps=3))
    params = trained(SMALL)
    options = ExportConfig(depth_dtype="uint16_mm")
    described = metadata.describe(config, options, PROFILE)
    path = tmp_path / POLICY_FILE
    path.write_bytes(graph.build_model(params, config, options, PROFILE, described).SerializeToString())
    robots = [OnnxPolicy(path), OnnxPolicy(path)]
    rng, unused = np.random.default_rng(0), np.random.default_rng(1)
    student = StudentActor(params, config, PROFILE, keep_clean, unused, noise="zero", teacher_share=0.0)
    nobody = np.full((2, 8), np.nan), np.zeros((2, 40)), np.zeros(2, bool)
    grips = []
    for step in range(6):
        given = parity.random_inputs(rng, 2, config, PROFILE, "uint16_mm")
        depth, state = given.depth[:, 0], given.state[:, :8]
        ours = student(Scene(depth, state, *nobody, step))
        theirs = np.stack([robot.act(*seen) for robot, *seen in zip(robots, depth, state, strict=True)])
        np.testing.assert_allclose(ours, theirs, atol=1e-4)
        assert np.mean(np.abs(ours[:, ACTION.arm]) < 0.95) > 0.5
        grips.append(ours[:, ACTION.gripper])
    grips = np.array(grips)
    assert (grips == CLOSE).any() and (grips < 0).any()  # the first is a closing that goes on


def test_parity_check_sees_one_changed_weight():
    config, options = OPTIONS["keypoints, trimmed crop"]
    params = trained(config)
    reference = parity.jax_policy(params, config, PROFILE)
    changed = jax.tree.map(np.copy, params)
    changed["encoder"]["features"]["kernel"] *= 1.05
    rng = np.random.default_rng(0)
    inputs = [parity.random_inputs(rng, 4, config, PROFILE, options.depth_dtype)]
    assert parity.max_abs_diff(export(config, options, changed), reference, iter(inputs)) > 1e-4


def test_units_agree_and_bad_pixels_are_the_same_as_none():
    """500 mm is 0.5 m; NaN, infinity, negative and absurd readings all act like 0."""
    params = jittered(initial(SMALL))
    millimetres = export(SMALL, ExportConfig(depth_dtype="uint16_mm"), params)
    metres = export(SMALL, ExportConfig(depth_dtype="float32_m"), params)
    rng = np.random.default_rng(0)
    raw = parity.random_inputs(rng, 2, SMALL, PROFILE, "uint16_mm")
    floats = replace(raw, depth=parity.depth_in_metres(raw.depth))
    for number, value in enumerate(parity.NOT_FINITE):
        row = 20 + 5 * number
        floats.depth[:, :, row] = value
        raw.depth[:, :, row] = 0
    np.testing.assert_allclose(parity.run_onnx(millimetres, raw), parity.run_onnx(metres, floats), atol=1e-6)


def test_options_and_parameters_that_do_not_fit_are_refused():
    params = initial(SMALL)

    def build(config, options):
        graph.build_model(params, config, options, PROFILE, metadata.describe(SMALL, ExportConfig(), PROFILE))

    with pytest.raises(UserError, match="Did you mean 'tokens'"):
        build(replace(SMALL, encoder=replace(SMALL.encoder, pooling="token")), ExportConfig())
    with pytest.raises(UserError, match="Unknown export.depth_dtype 'uint8'. Known: float32_m, uint16_mm"):
        build(SMALL, ExportConfig(depth_dtype="uint8"))
    with pytest.raises(UserError, match="ddim_steps is 51; expected 1 to 50"):
        build(SMALL, ExportConfig(ddim_steps=51))
    with pytest.raises(UserError, match=r"aux_hidden/bias has shape \(32,\), expected \(24,\)"):
        build(replace(SMALL, encoder=replace(SMALL.encoder, features=24)), ExportConfig())
