"""Training steps and frames per second of generator and student, on batches that lie on the device."""

import time
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.programs import PROGRAMS, Program
from ddg_jax import train as ddg_train
from ddgrasp.config import Config
from student_jax import train as student_train
from student_jax.policy import init_params


def generator(config: Config, steps: int) -> dict[str, float]:
    """{"train_steps_per_s", "sampled_frames_per_s"} of the generator, at the configuration's sizes."""
    jitted, (static, _, *batch) = PROGRAMS["generator: train step"](config)
    state = ddg_train.init_state(config.ddg, jax.random.key_data(jax.random.key(0)))
    params = jax.tree.map(jnp.array, state.params)
    rate = _steps_per_s(partial(jitted, static), state, filled(batch), steps)
    draw = PROGRAMS[f"sampler: {config.ddg.sampling.sampler}"](config)
    frames = config.ddg.sampling.batch_size * _calls_per_s(draw, params, max(1, steps // 10))
    return {"train_steps_per_s": rate, "sampled_frames_per_s": frames}


def student(config: Config, steps: int) -> dict[str, float]:
    """{"train_steps_per_s", "train_frames_per_s"} of the student on pictures."""
    jitted, (*static, _, _, batch) = PROGRAMS["student: train step"](config)
    params = init_params(jax.random.key(0), config.student, config.world.profile)
    trained, frozen = student_train.split(config.student, params)
    state = student_train.init_state(config.student, static[-1], 0, trained)
    rate = _steps_per_s(partial(jitted, *static), state, (frozen, *filled((batch,))), steps)
    return {"train_steps_per_s": rate, "train_frames_per_s": rate * config.student.training.batch_size}


def filled(shapes: Any) -> Any:
    """Arrays of these shapes with plausible values: small floats, metres in the depth, whole numbers low."""
    rng = np.random.default_rng(0)

    def fill(leaf: jax.ShapeDtypeStruct) -> jax.Array:
        if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
            return jax.random.key(0)
        if jnp.issubdtype(leaf.dtype, jnp.floating):
            return jnp.asarray(rng.normal(size=leaf.shape), leaf.dtype)
        low, high = (400, 1500) if leaf.dtype == jnp.uint16 else (0, 8)
        return jnp.asarray(rng.integers(low, high, leaf.shape), leaf.dtype)

    return jax.tree.map(fill, shapes)


def _steps_per_s(step: Any, state: Any, batch: Any, steps: int) -> float:
    """Of `steps` steps after two that compile: the first result may have other types than the start."""
    for _ in range(2):
        state, metrics = step(state, *batch)
    jax.block_until_ready(metrics)
    start = time.perf_counter()
    for _ in range(steps):
        state, metrics = step(state, *batch)
    jax.block_until_ready(metrics)
    return steps / (time.perf_counter() - start)


def _calls_per_s(program: Program, params: Any, calls: int) -> float:
    """Of `calls` calls of a sampler, whose second argument `params` takes the place of."""
    jitted, (key, _, *rest) = program
    arguments = (*filled((key,)), params, *filled(tuple(rest)))
    jax.block_until_ready(jitted(*arguments))
    start = time.perf_counter()
    for _ in range(calls):
        made = jitted(*arguments)
    jax.block_until_ready(made)
    return calls / (time.perf_counter() - start)
