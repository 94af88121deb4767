"""DDPM training of the generator (paper III-B1): a pure step, whole-state checkpoints, exact resume."""

from functools import partial
from pathlib import Path
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
import optax
import orbax.checkpoint as ocp
from jax import Array
from jax.typing import DTypeLike

from ddg_jax import schedule as diffusion
from ddg_jax.data import Frames, make_batch
from ddg_jax.unet import UNet
from ddgrasp.config import DDGConfig
from ddgrasp.errors import unknown_name
from ddgrasp.progress import Progress, Task

Params = Any
"""Nested dict of arrays."""
WARMUP_STEPS = 50
FINAL_LEARNING_RATE = 0.05
"""Share of the learning rate left at the end."""
MAX_GRAD_NORM = 1.0
SNR_LIMITS = (1.0, 5.0)
LOG_EVERY = 10
_CHECKPOINTS_KEPT = 2


@flax.struct.dataclass
class TrainState:
    """Everything training needs to go on: this is what a checkpoint holds."""

    step: Array
    params: Params
    ema: Params
    """Exponential moving average of `params`: the weights that are used."""
    opt_state: optax.OptState
    key: Array
    """Raw key data (uint32); the step's key is fold_in(key, step)."""


def make_unet(config: DDGConfig, dtype: DTypeLike = jnp.float32) -> UNet:
    """The noise-prediction network of the configuration."""
    return UNet(config.widths, config.blocks, config.attention_heads, config.space_to_depth, dtype)


def make_optimizer(config: DDGConfig) -> optax.GradientTransformation:
    """AdamW with warm-up and cosine decay."""
    warmup = min(WARMUP_STEPS, max(1, config.train_steps // 10))
    rate = optax.warmup_cosine_decay_schedule(
        0.0,
        config.learning_rate,
        warmup,
        max(config.train_steps, warmup + 1),
        config.learning_rate * FINAL_LEARNING_RATE,
    )
    return optax.chain(
        optax.clip_by_global_norm(MAX_GRAD_NORM), optax.adamw(rate, weight_decay=config.weight_decay)
    )


def init_params(config: DDGConfig, key: Array) -> Params:
    """Fresh parameters of the network."""
    picture = jnp.zeros((1, config.height_px, config.width_px))
    return make_unet(config).init(key, picture, picture, jnp.zeros((1,), jnp.int32))["params"]


@partial(jax.jit, static_argnums=0)
def init_state(config: DDGConfig, key: Array) -> TrainState:
    """State before the first step. `key` is raw key data."""
    params = init_params(config, jax.random.fold_in(jax.random.wrap_key_data(key), 0))
    return TrainState(jnp.zeros((), jnp.int32), params, params, make_optimizer(config).init(params), key)


def config_schedule(config: DDGConfig) -> diffusion.Schedule:
    """The forward process of the configuration."""
    return diffusion.make_schedule(config.schedule, config.diffusion_steps, config.log_snr_shift)


def predict_noise(config: DDGConfig, params: Params, x_k: Array, c: Array, step: Array) -> Array:
    """eps_theta(d_k (+) c, k), (B, H, W).

    The U-Net's output enters as the clean map that explains x_k, and eps is what remains: depth given c is
    smooth but for its holes, so a small network can draw it, while white noise at full resolution would have
    to pass through all of its bottlenecks.
    """
    x_0: Any = make_unet(config).apply({"params": params}, x_k, c, step)
    return diffusion.eps_from_x_0(config_schedule(config), x_k, step, x_0)


def loss_weight(config: DDGConfig, step: Array) -> Array:
    """Weight of each step's noise error, (B,).

    "uniform" is the paper's 1. "truncated" is clip(SNR, 1, 5) / SNR: per unit of error in x_0 no step weighs
    less than the others' floor (Salimans & Ho 2022, section 4) nor more than a cap (Hang et al. 2023).
    """
    if config.loss_weight == "uniform":
        return jnp.ones(step.shape)
    if config.loss_weight == "truncated":
        snr = diffusion.signal_to_noise(config_schedule(config), step)
        return jnp.clip(snr, *SNR_LIMITS) / snr
    raise unknown_name("loss weight", config.loss_weight, ("uniform", "truncated"))


def noise_loss(config: DDGConfig, params: Params, x_0: Array, c: Array, step: Array, eps: Array) -> Array:
    """mean w_k |eps - eps_theta(d_k (+) c, k)|^2 (paper eq. 4; w_k: `loss_weight`). x_0, c, eps (B, H, W);
    step (B,) int.
    """
    made = config_schedule(config)
    x_k = diffusion.q_sample(made, x_0, step, eps)
    error = jnp.mean((eps - predict_noise(config, params, x_k, c, step)) ** 2, axis=(1, 2))
    return jnp.mean(loss_weight(config, step) * error)


def averaged(ema: Params, params: Params, step: Array, decay: float) -> Params:
    """EMA update; the decay starts small so that the first, random weights are forgotten."""
    now = jnp.minimum(decay, (1 + step) / (10 + step))
    return jax.tree.map(lambda old, new: now * old + (1 - now) * new, ema, params)


@partial(jax.jit, static_argnums=0, donate_argnums=1)
def train_step(
    config: DDGConfig, state: TrainState, x_0: Array, c: Array
) -> tuple[TrainState, dict[str, Array]]:
    """One optimiser step on x_0, c (B, H, W). Pure: noise comes from fold_in(state.key, state.step)."""
    key = jax.random.fold_in(jax.random.wrap_key_data(state.key), state.step + 1)
    eps_key, step_key, prior_key = jax.random.split(key, 3)
    eps = jax.random.normal(eps_key, x_0.shape)
    k = jax.random.randint(step_key, x_0.shape[:1], 0, config.diffusion_steps)
    c = c + config.prior_noise * jax.random.normal(prior_key, c.shape)
    loss, grads = jax.value_and_grad(lambda p: noise_loss(config, p, x_0, c, k, eps))(state.params)
    updates, opt_state = make_optimizer(config).update(grads, state.opt_state, state.params)
    params = optax.apply_updates(state.params, updates)
    ema = averaged(state.ema, params, state.step, config.ema_decay)
    metrics = {"loss": loss, "grad_norm": optax.global_norm(grads)}
    return TrainState(state.step + 1, params, ema, opt_state, state.key), metrics


def fit(config: DDGConfig, frames: Frames, directory: Path, seed: int, progress: Progress) -> Params:
    """Trains for `config.train_steps` and returns the averaged parameters.

    Checkpoints go to `directory`/checkpoints; if some are there, training continues after the latest one
    and ends with the parameters an uninterrupted run would have. On Ctrl-C the current state is saved
    first.
    """
    options = ocp.CheckpointManagerOptions(max_to_keep=_CHECKPOINTS_KEPT, enable_async_checkpointing=False)
    with ocp.CheckpointManager((directory / "checkpoints").absolute(), options=options) as manager:
        state = _latest(config, manager, seed)
        done = int(state.step)
        with progress.task("fitting the generator", config.train_steps) as task:
            task.start_at(done)
            try:
                for step in range(done, config.train_steps):
                    batch = make_batch(frames, config, seed, step)
                    state, metrics = train_step(config, state, batch.x_0, batch.c)
                    _report(config, step + 1, metrics, task, progress)
                    if (step + 1) % config.checkpoint_every == 0:
                        _save(manager, state)
            finally:
                # Donated buffers of an interrupted step are gone: then the last checkpoint stands.
                if not any(leaf.is_deleted() for leaf in jax.tree.leaves(state)):
                    _save(manager, state)
    return jax.tree.map(np.asarray, state.ema)


def _report(config: DDGConfig, step: int, metrics: dict[str, Array], task: Task, progress: Progress) -> None:
    if step % LOG_EVERY and step != config.train_steps:
        task.advance()
        return
    values = {name: float(value) for name, value in metrics.items()}
    progress.scalars(step, **values)
    task.advance(loss=values["loss"])


def _latest(config: DDGConfig, manager: ocp.CheckpointManager, seed: int) -> TrainState:
    state = init_state(config, jax.random.key_data(jax.random.key(seed)))
    step = manager.latest_step()
    if step is None:
        return state
    restored: Any = manager.restore(step, args=ocp.args.StandardRestore(state))
    return restored


def _save(manager: ocp.CheckpointManager, state: TrainState) -> None:
    if manager.latest_step() != int(state.step):
        manager.save(int(state.step), args=ocp.args.StandardSave(state), force=True)
        manager.wait_until_finished()
