"""DDPM training of the generator (paper III-B1): a pure step on x_0 and c; learning/loop.py repeats it.

What the network's first channel is depends on `ddg.training.hole_loss`:

squared, the paper's equation 8: the clean value, trained by its squared error like every other channel.

cross_entropy, for representation deviation, whose first channel is -1 (hole) or +1 (valid): log odds. A
pixel's own noisy value says something exact about them (`valid_log_odds`), so the network need not carry
single pixels past its bottlenecks, only what neighbours and c say. Squared errors of confident mistakes have
no gradient left; cross-entropy, with the same minimum, has.
"""

from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax import Array
from jaxtyping import Float, Int, Key, UInt32

from ddg_jax.data import Frames, make_batch
from ddg_jax.representation import channels
from ddg_jax.unet import UNet
from ddgrasp.arrays import AnyArray
from ddgrasp.config import CROSS_ENTROPY, SQUARED, UNIFORM, DDGConfig
from ddgrasp.progress import Progress
from learning import diffusion
from learning.convolutions import compiler_options
from learning.loop import run_steps
from learning.optimizers import adamw
from learning.params import Params
from learning.train_state import TrainState, first_state, step_key, updated

WARMUP_STEPS = 50
FINAL_LEARNING_RATE = 0.05
"""Share of the learning rate left at the end."""
LOG_ODDS_PER_OUTPUT = 4.0
"""The network's outputs are of the order of 1, log odds of what it is sure of 10."""
CHECKPOINTS = "checkpoints"


def make_unet(config: DDGConfig) -> UNet:
    """The noise-prediction network of the configuration."""
    return UNet(
        config.unet.widths,
        config.unet.blocks,
        config.unet.attention_heads,
        config.unet.space_to_depth,
        config.unet.position,
    )


def make_optimizer(config: DDGConfig, steps: int, scale: float = 1.0) -> optax.GradientTransformation:
    """AdamW with warm-up and cosine decay over `steps`; `scale` times the configuration's learning rate."""
    return adamw(
        scale * config.training.learning_rate,
        steps,
        warmup=WARMUP_STEPS,
        final_share=FINAL_LEARNING_RATE,
        weight_decay=config.training.weight_decay,
    )


@partial(jax.jit, static_argnums=0)
def init_params(config: DDGConfig, key: Key[Array, ""]) -> Params:
    """Fresh parameters of the network."""
    c = jnp.zeros((1, config.depth.height_px, config.depth.width_px))
    x = jnp.zeros((*c.shape, channels(config)))
    return make_unet(config).init(key, x, c, jnp.zeros((1,), jnp.int32))["params"]


@partial(jax.jit, static_argnums=0)
def init_state(config: DDGConfig, key: UInt32[Array, " words"]) -> TrainState:
    """State before the first step. `key` is raw key data."""
    params = init_params(config, jax.random.fold_in(jax.random.wrap_key_data(key), 0))
    return first_state(params, make_optimizer(config, config.training.steps), key)


def config_schedule(config: DDGConfig) -> diffusion.Schedule:
    """The forward process of the configuration."""
    return diffusion.make_schedule(
        config.diffusion.schedule, config.diffusion.steps, config.diffusion.log_snr_shift
    )


def predict_clean(
    config: DDGConfig,
    params: Params,
    x_k: Float[AnyArray, "B H W C"],
    c: Float[AnyArray, "B H W"],
    step: Int[AnyArray, " B"],
) -> Float[Array, "B H W C"]:
    """The clean map x_0 (B, H, W, C) that the network sees in x_k; c (B, H, W), step (B,) int."""
    out = _output(config, params, x_k, c, step)
    if config.training.hole_loss == SQUARED:
        return out
    valid = jnp.tanh(valid_log_odds(config, out, x_k, step) / 2)  # E[x_0]: 2 sigmoid(log odds) - 1
    return jnp.concatenate([valid[..., None], out[..., 1:]], axis=-1)


def _output(config: DDGConfig, params: Params, x_k: AnyArray, c: AnyArray, step: AnyArray) -> Array:
    out: Any = make_unet(config).apply({"params": params}, x_k, c, step)
    return out


def valid_log_odds(
    config: DDGConfig,
    output: Float[AnyArray, "B H W C"],
    x_k: Float[AnyArray, "B H W C"],
    step: Int[AnyArray, " B"],
) -> Float[Array, "B H W"]:
    """log P(valid | x_k, c) - log P(hole | x_k, c), (B, H, W); output, x_k (B, H, W, C), step (B,) int.

    Bayes' rule: what the network makes of the neighbours and c, plus the pixel's own likelihood ratio,
    log N(x_k; a, 1 - a^2) - log N(x_k; -a, 1 - a^2) = 2 a x_k / (1 - a^2) with a^2 = alpha_bar_k.
    """
    alpha_bar = diffusion.alpha_bar_at(config_schedule(config), step, x_k)[..., 0]
    own = 2 * jnp.sqrt(alpha_bar) / (1 - alpha_bar) * x_k[..., 0]
    return LOG_ODDS_PER_OUTPUT * output[..., 0] + own


def predict_noise(
    config: DDGConfig,
    params: Params,
    x_k: Float[AnyArray, "B H W C"],
    c: Float[AnyArray, "B H W"],
    step: Int[AnyArray, " B"],
) -> Float[Array, "B H W C"]:
    """eps_theta(d_k (+) c, k), (B, H, W, C).

    The U-Net's output enters as the clean map that explains x_k, and eps is what remains: depth given c is
    smooth but for its holes, so a small network can draw it, while white noise at full resolution would have
    to pass through all of its bottlenecks.
    """
    x_0 = predict_clean(config, params, x_k, c, step)
    return diffusion.eps_from_x_0(config_schedule(config), x_k, step, x_0)


def loss_weight(config: DDGConfig, step: Int[AnyArray, " B"]) -> Float[Array, " B"]:
    """Weight of each step's noise error, (B,).

    "uniform" is the paper's 1. "truncated" is clip(SNR, *config.training.snr_limits) / SNR: per unit of error
    in x_0 no step weighs less than the floor (Salimans & Ho 2022, section 4) nor more than a cap (Hang et al.
    2023).
    """
    if config.training.loss_weight == UNIFORM:
        return jnp.ones(step.shape)
    snr = diffusion.signal_to_noise(config_schedule(config), step)
    return jnp.clip(snr, *config.training.snr_limits) / snr


def noise_loss(
    config: DDGConfig,
    params: Params,
    x_0: Float[AnyArray, "B H W C"],
    c: Float[AnyArray, "B H W"],
    step: Int[AnyArray, " B"],
    eps: Float[AnyArray, "B H W C"],
) -> Float[Array, ""]:
    """mean w_k |eps - eps_theta(d_k (+) c, k)|^2 (paper eq. 8; w_k: `loss_weight`). x_0, eps (B, H, W, C);
    c (B, H, W); step (B,) int.

    |eps - eps_theta|^2 is SNR times the squared error in x_0. With `hole_loss` cross_entropy twice the
    cross-entropy takes that error's place in the first channel.
    """
    made = config_schedule(config)
    x_k = diffusion.q_sample(made, x_0, step, eps)
    out = _output(config, params, x_k, c, step)
    error = (x_0 - out) ** 2
    if config.training.hole_loss == CROSS_ENTROPY:
        wrong = -jnp.sign(x_0[..., 0]) * valid_log_odds(config, out, x_k, step)
        error = error.at[..., 0].set(2 * jax.nn.softplus(wrong))
    weight = loss_weight(config, step) * diffusion.signal_to_noise(made, step)
    return jnp.mean(weight * jnp.mean(error, axis=(1, 2, 3)))


def step_keys(state: TrainState) -> Key[Array, "3"]:
    """(3,) keys of the step that `state` takes next: for eps, k and the noise on c."""
    return jax.random.split(step_key(state, ahead=1), 3)


@partial(jax.jit, static_argnums=0, donate_argnums=1, compiler_options=compiler_options())
def train_step(
    config: DDGConfig, state: TrainState, x_0: Float[AnyArray, "B H W C"], c: Float[AnyArray, "B H W"]
) -> tuple[TrainState, dict[str, Float[Array, ""]]]:
    """One optimiser step on x_0 (B, H, W, C), c (B, H, W). Pure: its noise comes from `step_keys`. `state` is
    donated: its arrays are gone afterwards."""
    eps_key, step_key, prior_key = step_keys(state)
    eps = jax.random.normal(eps_key, x_0.shape)
    k = jax.random.randint(step_key, x_0.shape[:1], 0, config.diffusion.steps)
    c = c + config.prior.noise * jax.random.normal(prior_key, c.shape)
    loss, grads = jax.value_and_grad(lambda p: noise_loss(config, p, x_0, c, k, eps))(state.params)
    state = updated(state, make_optimizer(config, config.training.steps), grads, config.training.ema_decay)
    return state, {"loss": loss, "grad_norm": optax.global_norm(grads)}


def fit(
    config: DDGConfig, frames: Frames, directory: Path, seed: int, progress: Progress, curve: str = ""
) -> Params:
    """Trains for `config.training.steps` and returns the averaged parameters.

    Checkpoints go to `directory`/checkpoints, curves are named `curve` + scalar (see `loop.run_steps`).
    """

    def step_once(state: TrainState, step: int) -> tuple[TrainState, dict[str, Array]]:
        batch = make_batch(frames, config, seed, step)
        return train_step(config, state, batch.x_0, batch.c)

    state, _ = run_steps(
        init_state(config, jax.random.key_data(jax.random.key(seed))),
        config.training.steps,
        step_once,
        directory / CHECKPOINTS,
        every=config.training.checkpoint_every,
        label="fitting the generator",
        progress=progress,
        curve=curve,
    )
    return jax.tree.map(np.asarray, state.ema)
