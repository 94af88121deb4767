"""The networks under pretrained/ load and do what they did when their numbers here were taken."""

from pathlib import Path

import jax
import numpy as np

from ddgrasp import artifacts
from foundation import depth_features
from learning.params import load_params
from ppo import policy as teacher_policy
from student_jax import policy

PRETRAINED = Path(__file__).parents[1] / "pretrained"


def test_the_students_action():
    config = artifacts.config_from_json(artifacts.read_manifest(PRETRAINED / "student").config)
    student, profile = config.student, config.world.profile
    shapes = policy.param_shapes(student, profile)
    params = load_params(PRETRAINED / "student" / policy.PARAMS_FILE, shapes)
    rng = np.random.default_rng(0)
    depth_m = rng.uniform(0.4, 1.2, (2, 3, profile.height_px, profile.width_px)).astype(np.float32)
    depth_m[rng.random(depth_m.shape) < 0.05] = 0
    joints = rng.uniform(-0.5, 0.5, (2, 7)) + np.array([0, 0, 0, -1.8, 0, 2, 0.7])
    state = np.concatenate([joints, np.full((2, 2), [0.05, -0.01])], axis=1).astype(np.float32)
    noise = rng.standard_normal((2, student.head.chunk, 8)).astype(np.float32)

    @jax.jit
    def act(params, depth_m, state, noise):
        return policy.sample_actions(params, depth_m, state, noise, student, profile)

    expected = [0.3304, 0.132009, 0.164877, -0.892972, -1.0, 0.653573, -0.016821, -0.988628]
    np.testing.assert_allclose(act(params, depth_m, state, noise)[0, 0], expected, atol=2e-5)


def test_the_teachers_action():
    observation = np.random.default_rng(0).normal(size=(5, 40)).astype(np.float32)
    expected = [-0.999988, -0.247901, 1.0, -1.0, 1.0, 0.99988, -0.980106, -1.0]
    action = teacher_policy.load(PRETRAINED / "teacher")(observation)
    np.testing.assert_allclose(action[0], expected, atol=2e-5)


def test_the_depth_features():
    depth_m = np.broadcast_to(np.linspace(1.4, 0.6, 180)[:, None], (180, 320)).astype(np.float32).copy()
    depth_m[70:120, 130:190] = 0.7
    expected = [-0.339549, -0.508891, 0.552862, -0.793659, -0.430956, -0.735014, -0.70651, -0.613973]
    features = depth_features.load(PRETRAINED / depth_features.NAME)(depth_m[None])
    np.testing.assert_allclose(features[0, :8], expected, atol=2e-4)
