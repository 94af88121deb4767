"""Every preset's networks, training steps, samplers and exported graph can be built: by shape, uncompiled."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ddg_jax import distil, representation
from ddg_jax import sample as ddg_sample
from ddg_jax import train as ddg_train
from ddgrasp import contract
from ddgrasp.policy_metadata import describe_run
from ddgrasp.presets import PRESETS
from export import graph
from mjx_envs.grasp_env import AutoReset, GraspEnv
from ppo import learner
from ppo.train import training_world
from student_jax import policy
from student_jax import train as student_train
from student_jax.preprocess import plan_window

NAMES = sorted(PRESETS)


def shape(*sizes: int, dtype=jnp.float32) -> jax.ShapeDtypeStruct:
    return jax.ShapeDtypeStruct(sizes, dtype)


def sizes(tree) -> list[tuple[int, ...]]:
    return [leaf.shape for leaf in jax.tree.leaves(tree)]


def key_data() -> jax.ShapeDtypeStruct:
    return jax.eval_shape(lambda: jax.random.key_data(jax.random.key(0)))


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
    batch, size = config.training.batch_size, (config.depth.height_px, config.depth.width_px)
    maps = (*size, representation.channels(config))
    state = jax.eval_shape(partial(ddg_train.init_state, config), key_data())
    step = ddg_train.train_step.eval_shape
    trained, metrics = step(config, state, shape(batch, *maps), shape(batch, *size))
    assert sizes(trained.params) == sizes(state.params)
    assert metrics["loss"].shape == ()

    count, frame = config.sampling.batch_size, shape(config.sampling.batch_size, dtype=jnp.int32)
    draw = partial(ddg_sample.sample, config, steps=config.sampling.steps)
    episode = shape(dtype=jnp.int32)
    drawn = jax.eval_shape(draw, jax.random.key(0), state.params, shape(count, *size), episode, frame)
    assert drawn.shape == (count, *maps)
    if config.sampling.sampler == "progressive":
        assert distil.rounds(config)[-1] == config.sampling.steps


@pytest.mark.parametrize("name", NAMES)
def test_the_student_its_training_steps_and_its_sampler(name):
    config = PRESETS[name]
    student, profile, chunk = config.student, config.world.profile, config.student.head.chunk
    params = policy.param_shapes(student, profile)

    def batch_of(count: int) -> tuple[jax.ShapeDtypeStruct, ...]:
        frames = shape(count, contract.DEPTH_FRAMES, profile.height_px, profile.width_px, dtype=jnp.uint16)
        return frames, shape(count, contract.POLICY_STATE_SIZE), shape(count, chunk, contract.ACTION_SIZE)

    depth, state, action = batch_of(student.training.batch_size)
    seen = jax.eval_shape(partial(student_train.encode, student, profile), params, depth, state, None)
    batch = student_train.Batch(
        depth_mm=depth, crop_rc=shape(depth.shape[0], 2, dtype=jnp.int32),
        state=state, action=action, aux=seen.aux,
    )  # fmt: skip
    steps = max(1, student.training.steps)
    trained, frozen = student_train.split(student, params)
    start = jax.eval_shape(partial(student_train.init_state, student, steps, 0), trained)
    step = student_train.train_step.eval_shape
    after, terms = step(student, profile, steps, start, frozen, batch)
    assert sizes(after.params) == sizes(trained)
    assert ("action" in terms) == (student.training.action_weight > 0)

    head = student_train.head_of(params)
    start = jax.eval_shape(partial(student_train.init_state, student, steps, 0), head)
    after, metrics = jax.eval_shape(
        partial(student_train.head_step, student, profile, steps), start, seen, state, action
    )
    assert sizes(after.params) == sizes(head) and metrics["loss"].shape == ()

    act = partial(policy.sample_actions, config=student, profile=profile)
    metres = shape(*depth.shape)
    assert jax.eval_shape(act, params, metres, state, action).shape == action.shape


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
