"""Every jitted step of training, sampling and rendering with the shapes it is called with, by name.

The one table that the tests lower for accelerators, `benchmarks.costs` prices, and memory is read from:

    jitted, arguments = PROGRAMS["student train step"](config)
    jitted.trace(*arguments).lower(lowering_platforms=("cuda",))

Nothing is computed: arrays are stood in for by their shapes. Physics is MJX-JAX (the C engine is a host
callback, MJX-Warp a foreign kernel), the renderer the project's own.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial
from typing import Any

import jax
import jax.numpy as jnp

from ddg_jax import data, distil, representation, sample
from ddg_jax import train as ddg_train
from ddg_jax.sensor import make_sensor
from ddgrasp import contract
from ddgrasp.config import (
    CROSS_ENTROPY,
    PROGRESSIVE,
    SAMPLERS,
    SQUARED,
    Config,
    Sampler,
    Sensor,
    SensorConfig,
)
from demos.rollout import Roller
from learning.convolutions import compiler_options
from mjx_envs import devices
from mjx_envs.grasp_env import AutoReset, GraspEnv
from ppo import evaluate, policy, rollout, train
from student_jax import act, depth_source
from student_jax import policy as student_policy
from student_jax import train as student_train

Program = tuple[Any, tuple[Any, ...]]
"""A jitted function, and its arguments: shapes, and values where they are static."""


def shape(*sizes: int, dtype: Any = jnp.float32) -> Any:
    """Stands for an array: a jax.ShapeDtypeStruct."""
    return jax.ShapeDtypeStruct(sizes, dtype)


def lower(program: Program, platform: str) -> jax.stages.Lowered:
    """The program for "cpu", "cuda" or "tpu", whether there is one or not."""
    jitted, arguments = program
    return jitted.trace(*arguments).lower(lowering_platforms=(platform,))


# --- teacher --------------------------------------------------------------------------------------


def _on_jax(config: Config) -> Config:
    return replace(config, world=replace(config.world, backend="jax", renderer="jax"))


@cache
def _training_env(config: Config) -> AutoReset:
    return AutoReset(GraspEnv(train.training_world(_on_jax(config))), devices.make_mesh())


@cache
def _ppo(config: Config) -> dict[str, Program]:
    """All parts: each is traced for the shapes of the next."""
    return train.programs(config, _training_env(config))


def ppo(piece: str, config: Config) -> Program:
    """A part of an iteration of PPO, by its name in `ppo.train.programs`."""
    return _ppo(config)[piece]


def control_step(config: Config) -> Program:
    """One control step of the teacher's environments, without learning."""
    env = _training_env(config)
    state = jax.eval_shape(train.initial(config, env)).env_state
    return jax.jit(env.step), (state, shape(config.teacher.num_envs, contract.ACTION_SIZE))


def evaluation_rollout(config: Config) -> Program:
    """Whole episodes of the deterministic teacher."""
    env = GraspEnv(_on_jax(config).world)
    layers, mean = _teacher_shapes(config)
    mesh, keys = devices.make_mesh(), shape(config.evaluation.teacher_trials, 2, dtype=jnp.uint32)
    start = jax.eval_shape(partial(rollout.begin, env, mesh), keys)
    return rollout.roll_out_from, (env, mesh, evaluate.motion_of, layers, mean, mean, start)


def _teacher_shapes(config: Config) -> tuple[list[tuple[Any, Any]], Any]:
    sizes = (contract.OBSERVATION_SIZE, *config.teacher.hidden, 2 * contract.ACTION_SIZE)
    layers = [(shape(a, b), shape(b)) for a, b in zip(sizes[:-1], sizes[1:], strict=True)]
    return layers, shape(contract.OBSERVATION_SIZE)


# --- demos ----------------------------------------------------------------------------------------


def _roller(piece: str, config: Config) -> Program:
    layers, mean = _teacher_shapes(config)
    zeros = partial(jax.tree.map, lambda leaf: jnp.zeros(leaf.shape))
    teacher = policy.TeacherPolicy(zeros(mean), zeros(mean), zeros(layers))
    return Roller(_on_jax(config), teacher, config.demos.parallel, with_rgb=True).programs()[piece]


# --- generator ------------------------------------------------------------------------------------


def _maps(config: Config, count: int) -> tuple[Any, Any]:
    size = (count, config.ddg.depth.height_px, config.ddg.depth.width_px)
    return shape(*size, representation.channels(config.ddg)), shape(*size)


def _key_data() -> Any:
    return jax.eval_shape(lambda: jax.random.key_data(jax.random.key(0)))


def _key() -> Any:
    return jax.eval_shape(lambda: jax.random.key(0))


def _ddg_state(config: Config) -> Any:
    return jax.eval_shape(partial(ddg_train.init_state, config.ddg), _key_data())


def generator_step(config: Config) -> Program:
    """An optimiser step of the generator."""
    return ddg_train.train_step, (
        config.ddg, _ddg_state(config), *_maps(config, config.ddg.training.batch_size),
    )  # fmt: skip


def generator_encode(config: Config) -> Program:
    """A training batch to diffusion space."""
    _, depth = _maps(config, config.ddg.training.batch_size)
    return data.encode_batch, (config.ddg, depth, depth)


def distil_step(config: Config) -> Program:
    """An optimiser step of progressive distillation."""
    ddg = _sampled_by(config, PROGRESSIVE)
    params = _ddg_state(config).params
    optimizer = ddg_train.make_optimizer(ddg, ddg.training.distil_steps)
    state = jax.eval_shape(lambda p, key: ddg_train.first_state(p, optimizer, key), params, _key_data())
    batch = ddg.training.batch_size
    path = shape(3, batch, dtype=jnp.int32)
    return distil.distil_step, (ddg, state, params, shape(), path, *_maps(config, batch))


def _sampled_by(config: Config, sampler: Sampler) -> Any:
    """The generator's configuration with another sampler; squared hole loss, which all of them take."""
    ddg, training = config.ddg, config.ddg.training
    if sampler == PROGRESSIVE:
        training = replace(training, distil_from=16)
        if training.hole_loss == CROSS_ENTROPY:
            training = replace(training, hole_loss=SQUARED)
    sampling = replace(ddg.sampling, sampler=sampler)
    if sampler == PROGRESSIVE:
        sampling = replace(sampling, steps=4, spacing="quadratic")
    return replace(ddg, training=training, sampling=sampling)


def sampler(name: Sampler, config: Config) -> Program:
    """A batch of maps by one of the samplers."""
    ddg = _sampled_by(config, name)
    count = ddg.sampling.batch_size
    frames = shape(count, dtype=jnp.int32)
    drawn = jax.jit(
        partial(sample.sample, ddg, steps=ddg.sampling.steps), compiler_options=compiler_options()
    )
    return drawn, (_key(), _ddg_state(config).params, _maps(config, count)[1], frames, frames)


def graft(config: Config) -> Program:
    """Generated maps onto clean depth, an episode's."""
    profile, count = config.world.profile, config.world.episode_steps
    size = (count, profile.height_px, profile.width_px)
    return sample.graft_maps, (config.ddg, shape(*size), shape(*size, representation.channels(config.ddg)))


def camera_model(name: Sensor, config: Config) -> Program:
    """A procedural camera model on a batch of clean pictures."""
    profile, count = config.world.profile, depth_source.BATCH
    sense = make_sensor(SensorConfig(name=name), profile)
    depth, number = shape(count, profile.height_px, profile.width_px), shape(count, dtype=jnp.int32)
    return depth_source.sense_batch, (sense, _key(), depth, None, number, number)


# --- student --------------------------------------------------------------------------------------


def _pictures(config: Config, count: int) -> tuple[Any, Any, Any]:
    """(depth stacks, joint states, action chunks)."""
    profile = config.world.profile
    size = (count, contract.DEPTH_FRAMES, profile.height_px, profile.width_px)
    chunk = shape(count, config.student.head.chunk, contract.ACTION_SIZE)
    return shape(*size, dtype=jnp.uint16), shape(count, contract.POLICY_STATE_SIZE), chunk


def _student_params(config: Config) -> dict:
    return student_policy.param_shapes(config.student, config.world.profile)


def features(config: Config) -> Program:
    """Perception alone, for the head's last training."""
    depth, state, _ = _pictures(config, config.student.training.batch_size)
    crops = shape(depth.shape[0], 2, dtype=jnp.int32)
    settings = (config.student, config.world.profile, _student_params(config))
    return student_train.encode, (*settings, depth, state, crops, _key())


def student_step(config: Config) -> Program:
    """An optimiser step on pictures."""
    student, profile = config.student, config.world.profile
    depth, state, action = _pictures(config, student.training.batch_size)
    jitted, arguments = features(config)
    seen = jax.eval_shape(partial(jitted, *arguments[:2]), *arguments[2:])
    batch = student_train.Batch(depth, arguments[5], state, action, seen.aux)
    steps = max(1, student.training.steps)
    trained, frozen = student_train.split(student, arguments[2])
    start = jax.eval_shape(partial(student_train.init_state, student, steps, 0), trained)
    return student_train.train_step, (student, profile, steps, start, frozen, batch)


def _seen(config: Config, count: int) -> Any:
    aux = student_policy.Aux(shape(count, 3), shape(count, 2), shape(count))
    return student_policy.Seen(shape(count, student_policy.feature_count(config.student)), aux)


def head_step(config: Config) -> Program:
    """An optimiser step of the action head on what perception reports."""
    student, count = config.student, config.student.head.batch_size
    steps = max(1, student.head.train_steps)
    head = student_train.head_of(_student_params(config))
    start = jax.eval_shape(partial(student_train.init_state, student, steps, 0), head)
    _, state, action = _pictures(config, count)
    samples = (_seen(config, count), state, action)
    return student_train.head_step, (student, config.world.profile, steps, start, *samples)


def dagger_acting(config: Config) -> Program:
    """The student's actions for all environments of a DAgger round."""
    settings = (config.student, config.world.profile, _student_params(config))
    return act.act_on_depth, (*settings, *_pictures(config, config.student.dagger.episodes))


def pose_acting(config: Config) -> Program:
    """The head's actions from noisy true poses."""
    count = config.student.poses.episodes
    settings = (config.student, config.world.profile, student_train.head_of(_student_params(config)))
    _, state, action = _pictures(config, count)
    return student_train.act_on_seen, (*settings, _seen(config, count), state, action)


PROGRAMS: dict[str, Callable[[Config], Program]] = {
    "PPO: new episodes": partial(ppo, "refresh"),
    "PPO: experience": partial(ppo, "collect"),
    "PPO: gradient steps": partial(ppo, "improve"),
    "control step": control_step,
    "evaluation rollout": evaluation_rollout,
    "demo rollout: begin": partial(_roller, "begin"),
    "demo rollout: look": partial(_roller, "look"),
    "demo rollout: advance": partial(_roller, "advance"),
    "rendering: geometry": partial(_roller, "pose"),
    "rendering: depth": partial(_roller, "depth"),
    "rendering: colour": partial(_roller, "rgb"),
    "generator: batch": generator_encode,
    "generator: train step": generator_step,
    "generator: distillation step": distil_step,
    **{f"sampler: {name}": partial(sampler, name) for name in SAMPLERS},
    "graft": graft,
    "camera model: ideal": partial(camera_model, "ideal"),
    "camera model: dextrah": partial(camera_model, "dextrah"),
    "camera model: kinect": partial(camera_model, "kinect"),
    "student: features": features,
    "student: train step": student_step,
    "student: head step": head_step,
    "student: DAgger acting": dagger_acting,
    "student: acting on poses": pose_acting,
}
"""Name -> maker of the program for a configuration."""
