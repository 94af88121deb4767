"""Training the student: diffusion loss on the teacher's labels, privileged auxiliary losses (III-C3)."""

from functools import partial
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax import Array

from ddgrasp import contract
from ddgrasp.config import StudentConfig
from ddgrasp.contract import CameraProfile
from student_jax import diffusion
from student_jax.data import Frames, random_crops, sharpen_gripper
from student_jax.policy import Aux, StudentPolicy, alpha_bar, init_params, position_from_world

MAX_GRAD_NORM = 1.0
WARMUP_STEPS = 100


@flax.struct.dataclass
class TrainState:
    """Everything training needs to go on."""

    step: Array
    params: Any
    ema: Any
    """Exponential moving average of `params`: the weights that are used."""
    opt_state: Any
    key: Array
    """Raw key data; a step's key is fold_in(key, step)."""


@flax.struct.dataclass
class Batch:
    """B training samples."""

    depth_mm: Array
    """(B, 3, H, W) uint16."""
    crop_rc: Array
    """(B, 2) int32."""
    state: Array
    action: Array
    """(B, chunk, 8)."""
    aux: Aux
    """Targets; `held_logit` holds 0 or 1."""


def make_batch(
    frames: Frames, index: np.ndarray, rng: np.random.Generator, config: StudentConfig, profile: CameraProfile
) -> Batch:
    """The samples at `index` (B,), cropped at random."""
    return Batch(
        depth_mm=jnp.asarray(frames.depth_stack(index)),
        crop_rc=jnp.asarray(random_crops(rng, len(index), profile, config.crop_shift_px)),
        state=jnp.asarray(frames.state[index]),
        action=jnp.asarray(sharpen_gripper(frames.action_chunks(index, config.chunk))),
        aux=Aux(
            position_from_world(jnp.asarray(frames.position_m[index])),
            jnp.asarray(frames.yaw[index]),
            jnp.asarray(frames.held[index]),
        ),
    )


def make_optimizer(config: StudentConfig, steps: int) -> optax.GradientTransformation:
    """AdamW with warm-up and cosine decay over `steps`."""
    warmup = min(WARMUP_STEPS, max(1, steps // 10))
    rate = optax.warmup_cosine_decay_schedule(
        0.0, config.learning_rate, warmup, max(steps, warmup + 1), 0.02 * config.learning_rate
    )
    return optax.chain(
        optax.clip_by_global_norm(MAX_GRAD_NORM), optax.adamw(rate, weight_decay=config.weight_decay)
    )


def init_state(
    config: StudentConfig, profile: CameraProfile, steps: int, seed: int, params=None
) -> TrainState:
    """State before the first of `steps` steps, from fresh or given parameters."""
    key = jax.random.key(seed)
    params = init_params(key, config, profile) if params is None else jax.tree.map(jnp.asarray, params)
    optimizer = make_optimizer(config, steps)
    copy = jax.tree.map(jnp.copy, params)
    return TrainState(
        jnp.zeros((), jnp.int32), params, copy, optimizer.init(params), jax.random.key_data(key)
    )


def diffusion_loss(config, policy, params, cond, action, key) -> Array:
    """mean |eps - eps_theta(a_k, k, s)|^2 (paper Eq. 6) over `noise_draws` noises for each condition."""
    draws = config.noise_draws
    cond, action = (jnp.repeat(x, draws, axis=0) for x in (cond, action))
    k_step, k_noise = jax.random.split(key)
    k = jax.random.randint(k_step, (len(cond),), 0, config.diffusion_steps)
    eps = jax.random.normal(k_noise, action.shape)
    noisy = diffusion.q_sample(action, eps, k, alpha_bar(config))
    predicted = policy.apply({"params": params}, noisy, k, cond, method="denoise")
    return jnp.mean((eps - predicted) ** 2)


def aux_losses(seen: Aux, target: Aux) -> dict[str, Array]:
    """Position (Huber, network units), yaw (squared), held (cross-entropy)."""
    return {
        "position": jnp.mean(optax.huber_loss(seen.position, target.position, delta=0.1)) * 10.0,
        "yaw": jnp.mean((seen.yaw - target.yaw) ** 2),
        "held": jnp.mean(optax.sigmoid_binary_cross_entropy(seen.held_logit, target.held_logit)),
    }


@partial(jax.jit, static_argnums=(0, 1, 2), donate_argnums=3)
def train_step(
    config: StudentConfig, profile: CameraProfile, steps: int, state: TrainState, batch: Batch
) -> tuple[TrainState, dict[str, Array]]:
    """One optimiser step. Pure: noise comes from fold_in(state.key, state.step)."""
    policy = StudentPolicy(config, profile)
    key = jax.random.fold_in(jax.random.wrap_key_data(state.key), state.step)
    depth_m = batch.depth_mm.astype(jnp.float32) * contract.DEPTH_UNIT_M

    def loss_fn(params):
        seen = policy.apply({"params": params}, depth_m, batch.state, batch.crop_rc, method="encode")
        terms = aux_losses(seen.aux, batch.aux)  # pyright: ignore[reportAttributeAccessIssue]
        terms["action"] = diffusion_loss(config, policy, params, seen.cond, batch.action, key)  # pyright: ignore
        total = terms["action"] + config.aux_weight * (terms["position"] + terms["yaw"] + 0.3 * terms["held"])
        error_m = 0.2 * jnp.linalg.norm(seen.aux.position - batch.aux.position, axis=-1)  # pyright: ignore
        return total, terms | {"position_error_mm": 1000 * jnp.median(error_m)}

    (total, terms), grads = jax.value_and_grad(loss_fn, has_aux=True)(state.params)
    updates, opt_state = make_optimizer(config, steps).update(grads, state.opt_state, state.params)
    params = optax.apply_updates(state.params, updates)
    decay = jnp.minimum(config.ema_decay, (1 + state.step) / (10 + state.step))
    ema = jax.tree.map(lambda old, new: decay * old + (1 - decay) * new, state.ema, params)
    return TrainState(state.step + 1, params, ema, opt_state, state.key), terms | {"total": total}


# --- the action head alone, on cached conditions ---------------------------------------------------


@partial(jax.jit, static_argnums=(0, 1))
def encode(
    config: StudentConfig, profile: CameraProfile, params, depth_mm: Array, state: Array, crop_rc: Array
) -> Any:
    """(B, D) conditions and auxiliary predictions of a batch."""
    depth_m = depth_mm.astype(jnp.float32) * contract.DEPTH_UNIT_M
    return StudentPolicy(config, profile).apply({"params": params}, depth_m, state, crop_rc, method="encode")


@partial(jax.jit, static_argnums=(0, 1, 2), donate_argnums=3)
def head_step(
    config: StudentConfig, profile: CameraProfile, steps: int, state: TrainState, cond: Array, action: Array
) -> tuple[TrainState, Array]:
    """One optimiser step on the denoiser's parameters alone; `state.params` is that subtree."""
    key = jax.random.fold_in(jax.random.wrap_key_data(state.key), state.step)
    policy = StudentPolicy(config, profile)

    def loss_fn(head):
        return diffusion_loss(config, policy, {"denoiser": head}, cond, action, key)

    loss, grads = jax.value_and_grad(loss_fn)(state.params)
    updates, opt_state = make_optimizer(config, steps).update(grads, state.opt_state, state.params)
    params = optax.apply_updates(state.params, updates)
    decay = jnp.minimum(config.ema_decay, (1 + state.step) / (10 + state.step))
    ema = jax.tree.map(lambda old, new: decay * old + (1 - decay) * new, state.ema, params)
    return TrainState(state.step + 1, params, ema, opt_state, state.key), loss
