"""The generator's jitted steps with the shapes that a configuration calls them with."""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from ddg_jax import data, distil, representation, train
from ddg_jax.sample import sample
from ddgrasp.config import DDGConfig
from learning.convolutions import compiler_options
from learning.programs import Program, key, key_data, shape


def encode(config: DDGConfig) -> Program:
    """A training batch to diffusion space."""
    _, depth = _maps(config, config.training.batch_size)
    return data.encode_batch, (config, depth, depth)


def train_step(config: DDGConfig) -> Program:
    """An optimiser step."""
    return train.train_step, (config, _state(config), *_maps(config, config.training.batch_size))


def distil_step(config: DDGConfig) -> Program:
    """An optimiser step of progressive distillation."""
    params = _state(config).params
    optimizer = train.make_optimizer(config, config.training.distil_steps)
    state = jax.eval_shape(lambda p, k: train.first_state(p, optimizer, k), params, key_data())
    batch = config.training.batch_size
    path = shape(3, batch, dtype=jnp.int32)
    return distil.distil_step, (config, state, params, shape(), path, *_maps(config, batch))


def sampler(config: DDGConfig) -> Program:
    """Drawing a batch of maps."""
    count = config.sampling.batch_size
    numbers = shape(count, dtype=jnp.int32)
    draw = jax.jit(partial(sample, config, steps=config.sampling.steps), compiler_options=compiler_options())
    return draw, (key(), _state(config).params, _maps(config, count)[1], numbers, numbers)


def _state(config: DDGConfig) -> Any:
    return train.init_state.eval_shape(config, key_data())


def _maps(config: DDGConfig, count: int) -> tuple[Any, Any]:
    """(maps in diffusion space, their prior)."""
    size = (count, config.depth.height_px, config.depth.width_px)
    return shape(*size, representation.channels(config)), shape(*size)
