"""What fitting the generator and drawing from it takes, by shapes alone."""

from functools import partial

import jax
import jax.numpy as jnp

from ddg_jax import representation
from ddg_jax.data import frames_bytes
from ddg_jax.sample import sample
from ddg_jax.train import init_state, train_step
from ddgrasp.config import Config, DDGConfig
from learning.memory import Need, traced_bytes


def need(config: Config, frames: int | None = None) -> Need:
    """What stage `ddg` takes on so many frames; without a number those of the rig's recordings."""
    ddg, count = config.ddg, "record.frames" if frames is None else "the number of frames"
    if frames is None:
        frames = config.record.trajectories * config.record.frames
    device = max(training_bytes(ddg), sampling_bytes(ddg))
    remedy = f"ddg.training.batch_size, ddg.sampling.batch_size or {count}"
    return Need("ddg", device, frames_bytes(ddg, frames), remedy=remedy)


def training_bytes(config: DDGConfig) -> int:
    """What an optimiser step takes."""
    state = jax.eval_shape(partial(init_state, config), _key_data())
    return traced_bytes(train_step, config, state, *_maps(config, config.training.batch_size))


def sampling_bytes(config: DDGConfig) -> int:
    """What drawing a batch of maps takes."""
    params = jax.eval_shape(partial(init_state, config), _key_data()).params
    count = config.sampling.batch_size
    numbers = jax.ShapeDtypeStruct((count,), jnp.int32)
    draw = jax.jit(partial(sample, config, steps=config.sampling.steps))
    key = jax.eval_shape(lambda: jax.random.key(0))
    return traced_bytes(draw, key, params, _maps(config, count)[1], numbers, numbers)


def _maps(config: DDGConfig, count: int) -> tuple[jax.ShapeDtypeStruct, jax.ShapeDtypeStruct]:
    size = (count, config.depth.height_px, config.depth.width_px)
    maps = jax.ShapeDtypeStruct((*size, representation.channels(config)), jnp.float32)
    return maps, jax.ShapeDtypeStruct(size, jnp.float32)


def _key_data() -> jax.ShapeDtypeStruct:
    return jax.eval_shape(lambda: jax.random.key_data(jax.random.key(0)))
