"""What a place depends on is float32 where products are by default in TF32, as on NVIDIA GPUs."""

from functools import cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ddgrasp import contract
from ddgrasp.config import RandomConfig
from ddgrasp.presets import PRESETS
from export import parity, stage
from mjx_envs import inverse_kinematics, randomize
from mjx_envs.camera import nominal_camera
from mjx_envs.physics import backends, interface
from mjx_envs.precision import exact
from student_jax import encoder, hand_view, preprocess
from student_jax.policy import init_params, sample_actions
from tests import tf32
from tests.test_export_parity import jittered

DEBUG = PRESETS["debug"]


def test_products_are_rounded_unless_they_ask_not_to_be():
    a = jnp.asarray(np.random.default_rng(0).normal(size=(32, 32)), jnp.float32)
    wanted = np.asarray(a, np.float64) @ np.asarray(a, np.float64)

    def error(function) -> float:
        return float(np.abs(np.asarray(jax.jit(function)(a)) - wanted).max())

    with tf32.by_default():
        assert 1e-3 < error(lambda x: x @ x) < 0.1
        assert error(exact(lambda x: x @ x)) < 2e-5
    assert error(lambda x: x @ x) < 2e-5


def _shapes(*sizes: tuple[int, ...]) -> list[jax.ShapeDtypeStruct]:
    return [jax.ShapeDtypeStruct(size, jnp.float32) for size in sizes]


def _physics() -> tuple[Any, Any]:
    backend = backends.make_physics("jax", 0.005)
    table = randomize.ObjectTable(("cube",))
    key = jax.ShapeDtypeStruct((2,), jnp.uint32)
    params, _ = jax.eval_shape(lambda k: randomize.sample_params(k, RandomConfig(), table, 0), key)
    state = jax.eval_shape(interface.initial_state, *_shapes((16,)))
    return backend.step, (params, state, *_shapes((9,)))


@cache
def _places() -> dict[str, tuple[Any, Any]]:
    """Functions that say where something is, with the shapes of their arguments."""
    student, profile = DEBUG.student, DEBUG.world.profile
    size, frame = student.picture, (profile.height_px, profile.width_px)
    crops = jax.ShapeDtypeStruct((2, 2), jnp.int32)
    channels = len(size.channels) * contract.DEPTH_FRAMES
    seen = {"profile": profile, "config": student}
    return {
        "picture": (partial(preprocess.prepare_depth, **seen), (*_shapes((2, 3, *frame)), crops)),
        "hand": (partial(hand_view.place, **seen), (*_shapes((2, 3)), crops)),
        "hand view": (
            partial(hand_view.cut, config=student),
            _shapes((2, size.height_px, size.width_px, channels), (2, 2), (2, 2)),
        ),
        "keypoints": (encoder.spatial_softmax, _shapes((2, 12, 4), (2, 12), (2, 12, 8))),
        "cells": (partial(encoder.cell_maps, **seen), (crops,)),
        "joints": (inverse_kinematics.solve, _shapes((7,), (3,), (4,))),
        "physics": _physics(),
    }


@pytest.mark.parametrize("name", ["picture", "hand", "hand view", "keypoints", "cells", "joints", "physics"])
def test_a_place_is_no_product_in_less_than_float32(name):
    function, shapes = _places()[name]
    text = jax.jit(function).trace(*shapes).lower(lowering_platforms=("cuda",)).as_text()
    assert "dot_general" in text
    assert not [line for line in text.splitlines() if "dot_general" in line and "DEFAULT" in line]


def test_cameras_are_turned_and_not_bent():
    pose = nominal_camera(DEBUG.world.profile).T_world_cam
    draw = partial(randomize.sample_camera, config=RandomConfig(), T_world_cam=pose)
    with tf32.by_default():
        T = np.asarray(jax.jit(jax.vmap(draw))(jax.random.split(jax.random.PRNGKey(0), 64)), np.float64)
    bent = np.abs(T[:, :3, :3] @ T[:, :3, :3].transpose(0, 2, 1) - np.eye(3)).max()
    assert bent < 2e-6


def test_an_exported_policy_is_compared_in_float32():
    student, profile = DEBUG.student, DEBUG.world.profile
    params = jittered(init_params(jax.random.key(0), student, profile))
    session = parity.open_session(stage.export_policy(DEBUG, params))
    inputs = parity.random_inputs(np.random.default_rng(0), 4, student, profile, DEBUG.export.depth_dtype)

    def as_a_gpu_would(batch: parity.Inputs) -> np.ndarray:
        depth_m = parity.depth_in_metres(batch.depth)
        act = jax.jit(lambda *seen: sample_actions(params, *seen, student, profile))
        return np.asarray(act(depth_m, batch.state, batch.noise))

    with tf32.by_default():
        compared = parity.max_abs_diff(session, parity.jax_policy(params, student, profile), iter([inputs]))
        unlike = parity.max_abs_diff(session, as_a_gpu_would, iter([inputs]))
    assert compared < 0.1 * unlike and compared < DEBUG.export.max_abs_diff
