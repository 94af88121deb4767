"""Every preset's networks, training steps, samplers and exported graph can be built: by shape, uncompiled."""

from functools import partial

import jax
import numpy as np
import pytest

from ddg_jax import distil, representation
from ddg_jax import programs as generator
from ddgrasp import contract
from ddgrasp.policy_metadata import describe_run
from ddgrasp.presets import PRESETS
from export import graph
from mjx_envs.grasp_env import AutoReset, GraspEnv
from ppo import learner
from ppo.train import training_world
from student_jax import policy
from student_jax import programs as student
from student_jax.preprocess import plan_window

NAMES = sorted(PRESETS)


def sizes(tree) -> list[tuple[int, ...]]:
    return [leaf.shape for leaf in jax.tree.leaves(tree)]


@pytest.mark.parametrize("name", NAMES)
def test_the_teachers_networks_and_its_environments(name):
    config = PRESETS[name]
    learner.check_divisible(config.teacher, 1)
    env = AutoReset(GraspEnv(training_world(config)))
    state = jax.eval_shape(partial(learner.init, config.teacher, env), jax.random.PRNGKey(0))
    first = state.params.policy["params"]["hidden_0"]["kernel"]
    assert first.shape == (contract.OBSERVATION_SIZE, config.teacher.hidden[0])
    assert state.env_state.obs.shape == (config.teacher.num_envs, contract.OBSERVATION_SIZE)


@pytest.mark.parametrize("name", NAMES)
def test_the_generator_its_training_step_and_its_sampler(name):
    config = PRESETS[name].ddg
    step, arguments = generator.train_step(config)
    trained, metrics = step.eval_shape(*arguments)
    assert sizes(trained.params) == sizes(arguments[1].params)
    assert metrics["loss"].shape == ()

    draw, arguments = generator.sampler(config)
    size = (config.depth.height_px, config.depth.width_px, representation.channels(config))
    assert draw.eval_shape(*arguments).shape == (config.sampling.batch_size, *size)
    if config.sampling.sampler == "progressive":
        assert distil.rounds(config)[-1] == config.sampling.steps


@pytest.mark.parametrize("name", NAMES)
def test_the_student_its_training_steps_and_its_sampler(name):
    config = PRESETS[name]
    step, arguments = student.train_step(config)
    after, terms = step.eval_shape(*arguments)
    *_, start, _, batch = arguments
    assert sizes(after.params) == sizes(start.params)
    assert ("action" in terms) == (config.student.training.action_weight > 0)

    encode, arguments = student.encode(config)
    seen = encode.eval_shape(*arguments)
    assert sizes(seen.aux) == sizes(batch.aux)

    step, arguments = student.head_step(config)
    after, metrics = step.eval_shape(*arguments)
    *_, start, expected, _, _ = arguments
    assert sizes(after.params) == sizes(start.params) and metrics["loss"].shape == ()
    assert seen.features.shape[1:] == expected.features.shape[1:]

    act, arguments = student.acting(config, 2)
    assert act.eval_shape(*arguments).shape == (2, config.student.head.chunk, contract.ACTION_SIZE)


@pytest.mark.parametrize("name", NAMES)
def test_the_exported_graph(name):
    config = PRESETS[name]
    shapes = policy.param_shapes(config.student, config.world.profile)
    params = jax.tree.map(lambda leaf: np.zeros(leaf.shape, leaf.dtype), shapes)
    metadata = describe_run(config, project_version="test", student_manifest_hash="")
    model = graph.build_model(params, config.student, config.export, config.world.profile, metadata)
    action = model.graph.output[0].type.tensor_type.shape.dim
    assert [dim.dim_value for dim in action[1:]] == [config.student.head.chunk, contract.ACTION_SIZE]


def test_the_paper_presets_picture_is_trimmed_not_resampled():
    config = PRESETS["paper"]
    window = plan_window(config.world.profile, config.student)
    assert [axis.matrix for axis in window] == [None, None]
    assert [axis.length for axis in window] == [224, 288]
