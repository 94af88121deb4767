"""Every jitted step of training, sampling and rendering with the shapes it is called with, by name.

The one table that the tests lower for accelerators, `benchmarks.costs` prices, and memory is read from:

    jitted, arguments = PROGRAMS["student: train step"](config)
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

from ddg_jax import piecewise, representation, sample
from ddg_jax import programs as ddg
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
from ddgrasp.config.features import DepthFeatureConfig
from demos.rollout import Roller
from foundation import depth_feature_training
from foundation.depth_feature_data import MEASURED
from learning.programs import Program, key, shape
from mjx_envs import devices
from mjx_envs.grasp_env import AutoReset, GraspEnv
from mjx_envs.render.visual import Viewer
from ppo import evaluate, policy, rollout, train, warmup
from student_jax import act, depth_source, device_frames
from student_jax import programs as student
from student_jax.data import Window


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


def cloning(config: Config) -> Program:
    """The optimiser steps of a round of cloning the guide."""
    return warmup.program(config.teacher, jax.eval_shape(train.initial(config, _training_env(config))))


def object_pixels(config: Config) -> Program:
    """Pixels of the object in the student's crop, for as many scenes as demos are drawn together."""
    _, drawn = _roller("depth", config)
    layout = GraspEnv(_on_jax(config).world).table.layout
    return jax.jit(Viewer(config.world.profile, layout, "jax").object_pixels), drawn


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


def distil_step(config: Config) -> Program:
    """An optimiser step of progressive distillation."""
    return ddg.distil_step(_sampled_by(config, PROGRESSIVE))


def _sampled_by(config: Config, sampler: Sampler) -> Any:
    """The generator's configuration with another sampler; squared hole loss, which all of them take."""
    training = config.ddg.training
    if sampler == PROGRESSIVE:
        training = replace(training, distil_from=16)
        if training.hole_loss == CROSS_ENTROPY:
            training = replace(training, hole_loss=SQUARED)
    sampling = replace(config.ddg.sampling, sampler=sampler)
    if sampler == PROGRESSIVE:
        sampling = replace(sampling, steps=4, spacing="quadratic")
    return replace(config.ddg, training=training, sampling=sampling)


def sampler(name: Sampler, config: Config) -> Program:
    """A batch of maps by one of the samplers."""
    return ddg.sampler(_sampled_by(config, name))


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
    return depth_source.sense_batch, (sense, key(), depth, None, number, number)


# --- student --------------------------------------------------------------------------------------


def perceiving(config: Config) -> Program:
    """What perception reports of an episode's frames."""
    _, (*settings, depth, state, _) = student.acting(config, config.world.episode_steps)
    return act.perceived, (*settings, depth, state)


def frames_put(config: Config) -> Program:
    """A block of training frames into the device's memory."""
    rows, window = _frames_on_device(config)
    size = dict(dtype=jnp.uint16)
    blocks = (shape(rows, *window.shape, **size), shape(device_frames.BLOCK, *window.shape, **size))
    return device_frames.put, (*blocks, shape(dtype=jnp.int32))


def frames_gathered(config: Config) -> Program:
    """The pictures of a batch out of the device's memory, where they take more than one array."""
    rows, window = _frames_on_device(config)
    part, count = shape(rows, *window.shape, dtype=jnp.uint16), config.student.training.batch_size
    index = shape(count * contract.DEPTH_FRAMES, dtype=jnp.int32)
    return device_frames.gathered, (rows, window.margins, (part, part), index)


def _frames_on_device(config: Config) -> tuple[int, Window]:
    """(frames in one array, what is kept of each)."""
    window = Window.seen(config.world.profile, config.student.training.crop_shift_px)
    height, width = window.shape
    return device_frames.PART_ELEMENTS // (height * width), window


def dagger_acting(config: Config) -> Program:
    """The student's actions for all environments of a DAgger round."""
    return student.acting(config, config.student.dagger.episodes)


# --- score ----------------------------------------------------------------------------------------


def feature_step(config: Config) -> Program:
    """An optimiser step of the score's own features, at their own sizes."""
    del config
    features = DepthFeatureConfig()
    count, width = features.batch_size, features.width_px
    state = jax.eval_shape(lambda: depth_feature_training.init_state(features))
    depth, family = shape(count, width * 3 // 4, width), shape(count, dtype=jnp.int32)
    return depth_feature_training.train_step, (features, state, depth, family, shape(count, len(MEASURED)))


PROGRAMS: dict[str, Callable[[Config], Program]] = {
    "cloning the guide": cloning,
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
    "rendering: object pixels": object_pixels,
    "generator: piecewise surfaces": lambda config: piecewise.program(
        config.ddg.depth.height_px, config.ddg.depth.width_px
    ),
    "generator: batch": lambda config: ddg.encode(config.ddg),
    "generator: train step": lambda config: ddg.train_step(config.ddg),
    "generator: distillation step": distil_step,
    **{f"sampler: {name}": partial(sampler, name) for name in SAMPLERS},
    "graft": graft,
    "camera model: ideal": partial(camera_model, "ideal"),
    "camera model: dextrah": partial(camera_model, "dextrah"),
    "camera model: kinect": partial(camera_model, "kinect"),
    "student: features": student.encode,
    "student: train step": student.train_step,
    "student: head step": student.head_step,
    "student: frames to the device": frames_put,
    "student: frames out of the device's memory": frames_gathered,
    "student: DAgger acting": dagger_acting,
    "student: perceiving": perceiving,
    "student: acting on poses": student.acting_on_poses,
    "features: train step": feature_step,
}
"""Name -> maker of the program for a configuration."""
