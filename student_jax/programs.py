"""The student's jitted steps with the shapes that a configuration calls them with."""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from ddgrasp import contract
from ddgrasp.config import Config
from learning.programs import Program, key, shape
from student_jax import policy, train
from student_jax.act import act_on_depth


def encode(config: Config) -> Program:
    """Perception alone, for the head's last training."""
    count = config.student.training.batch_size
    depth, state, _ = _pictures(config, count)
    return train.encode, (*_network(config), depth, state, _crops(count), key())


def train_step(config: Config) -> Program:
    """An optimiser step on pictures."""
    student, profile, params = _network(config)
    count, steps = student.training.batch_size, max(1, student.training.steps)
    depth, state, action = _pictures(config, count)
    batch = train.Batch(depth, _crops(count), state, action, _seen(config, count).aux)
    trained, frozen = train.split(student, params)
    start = jax.eval_shape(partial(train.init_state, student, steps, 0), trained)
    return train.train_step, (student, profile, steps, start, frozen, batch)


def head_step(config: Config) -> Program:
    """An optimiser step of the action head on what perception reports."""
    student, profile, params = _network(config)
    count, steps = student.head.batch_size, max(1, student.head.train_steps)
    start = jax.eval_shape(partial(train.init_state, student, steps, 0), train.head_of(params))
    _, state, action = _pictures(config, count)
    return train.head_step, (student, profile, steps, start, _seen(config, count), state, action)


def acting(config: Config, count: int) -> Program:
    """The student's actions for `count` environments."""
    return act_on_depth, (*_network(config), *_pictures(config, count))


def acting_on_poses(config: Config) -> Program:
    """The head's actions from noisy true poses."""
    student, profile, params = _network(config)
    count = student.poses.episodes
    _, state, action = _pictures(config, count)
    return train.act_on_seen, (student, profile, train.head_of(params), _seen(config, count), state, action)


def _network(config: Config) -> tuple[Any, Any, dict]:
    """(student's configuration, camera, parameters)."""
    profile = config.world.profile
    return config.student, profile, policy.param_shapes(config.student, profile)


def _pictures(config: Config, count: int) -> tuple[Any, Any, Any]:
    """(depth stacks, joint states, action chunks)."""
    profile = config.world.profile
    size = (count, contract.DEPTH_FRAMES, profile.height_px, profile.width_px)
    chunk = shape(count, config.student.head.chunk, contract.ACTION_SIZE)
    return shape(*size, dtype=jnp.uint16), shape(count, contract.POLICY_STATE_SIZE), chunk


def _crops(count: int) -> Any:
    return shape(count, 2, dtype=jnp.int32)


def _seen(config: Config, count: int) -> Any:
    aux = policy.Aux(shape(count, 3), shape(count, 2), shape(count))
    return policy.Seen(shape(count, policy.feature_count(config.student)), aux)
