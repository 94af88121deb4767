"""Training the student: diffusion loss on the teacher's labels, privileged auxiliary losses (III-C3)."""

from functools import partial
from typing import Any, cast

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax import Array
from jaxtyping import Float, Int, Key, UInt16

from ddgrasp.arrays import AnyArray
from ddgrasp.config import StudentConfig
from ddgrasp.config.student import StudentTrainingConfig
from ddgrasp.contract import CameraProfile
from ddgrasp.depth import to_metres
from learning.convolutions import compiler_options
from learning.diffusion import q_sample
from learning.optimizers import adamw
from learning.train_state import TrainState, first_state, step_key, updated
from student_jax.augment import disparity_noise, unseen_objects
from student_jax.data import Frames, aux_targets, random_crops, sharpen_gripper
from student_jax.encoder import POSITION_SCALE_M
from student_jax.policy import (
    HEAD_PARAMS,
    Aux,
    Seen,
    StudentPolicy,
    noise_schedule,
    position_to_world,
    sample_from_seen,
)
from student_jax.preprocess import cut, first_pixel, plan_window

WARMUP_STEPS = 100
FINAL_LEARNING_RATE = 0.02
"""Share of the learning rate left at the end."""
POSITION_DELTA, POSITION_WEIGHT = 0.05, 40.0
"""Huber's bound in network units (one centimetre); with the weight, centimetres count as much as yaw."""


@flax.struct.dataclass
class Batch:
    """B training samples."""

    depth_mm: Array
    """(B, 3, H, W) uint16."""
    crop_rc: Array
    """(B, 2) int32."""
    state: Array
    """(B, 9): `layout.POLICY_STATE`."""
    action: Array
    """(B, chunk, 8)."""
    aux: Aux
    """Targets; `held_logit` holds 0 or 1."""


def make_batch(
    frames: Frames,
    index: Int[np.ndarray, " B"],
    rng: np.random.Generator,
    config: StudentConfig,
    profile: CameraProfile,
) -> Batch:
    """The samples at `index` (B,), cropped at random."""
    return Batch(
        depth_mm=jnp.asarray(frames.depth_stack(index)),
        crop_rc=jnp.asarray(random_crops(rng, len(index), profile, config.training.crop_shift_px)),
        state=jnp.asarray(frames.state[index]),
        action=jnp.asarray(sharpen_gripper(frames.action_chunks(index, config.head.chunk))),
        aux=aux_targets(frames.observation[index], frames.held[index]),
    )


def make_optimizer(config: StudentConfig, steps: int) -> optax.GradientTransformation:
    """AdamW with warm-up and cosine decay over `steps`."""
    return adamw(
        config.training.learning_rate,
        steps,
        warmup=WARMUP_STEPS,
        final_share=FINAL_LEARNING_RATE,
        weight_decay=config.training.weight_decay,
    )


def split(config: StudentConfig, params: dict) -> tuple[dict, dict]:
    """(trained, frozen) on pictures: without an action loss the head keeps what it learnt from poses."""
    names = set(params) if config.training.action_weight else set(params) - set(HEAD_PARAMS)
    return {k: v for k, v in params.items() if k in names}, {
        k: v for k, v in params.items() if k not in names
    }


def head_of(params: dict) -> dict:
    """The parameters that act."""
    return {name: params[name] for name in HEAD_PARAMS}


def init_state(config: StudentConfig, steps: int, seed: int, params: dict, phase: int = 0) -> TrainState:
    """State before the first of `steps` steps on `params`; each `phase` of a plan draws its own numbers."""
    key = jax.random.key_data(jax.random.fold_in(jax.random.key(seed), phase))
    return first_state(params, make_optimizer(config, steps), key)


def diffusion_loss(
    config: StudentConfig,
    policy: StudentPolicy,
    params: dict,
    seen: Seen,
    state: Float[Array, "B 9"],
    action: Float[Array, "B chunk 8"],
    key: Key[Array, ""],
) -> Float[Array, ""]:
    """mean |eps - eps_theta(a_k, k, s)|^2 (paper eq. 10) over `noise_draws` noises for each sample."""
    known: Any = policy.apply({"params": params}, seen, state, method="condition")
    draws = config.training.noise_draws
    cond, action = (jnp.repeat(x, draws, axis=0) for x in (known, action))
    k_step, k_noise = jax.random.split(key)
    k = jax.random.randint(k_step, (len(cond),), 0, config.head.diffusion_steps)
    eps = jax.random.normal(k_noise, action.shape)
    noisy = q_sample(noise_schedule(config), action, k, eps)
    predicted: Any = policy.apply({"params": params}, noisy, k, cond, method="denoise")
    return jnp.mean((eps - predicted) ** 2)


def told(training: StudentTrainingConfig) -> tuple[str, ...]:
    """Terms of `train_step` that people want to watch: those that are trained."""
    perception = ("position_error_mm", "yaw", "held") if training.aux_weight else ()
    return (*perception, "action") if training.action_weight else perception


def _ripples(config: StudentConfig) -> bool:
    return bool(config.training.disparity_noise_px or config.training.edge_noise_px)


def _seen_part(
    config: StudentConfig,
    profile: CameraProfile,
    depth_mm: UInt16[AnyArray, "B 3 H W"],
    crop_rc: Int[AnyArray, "B 2"],
) -> tuple[Float[Array, "B 3 h w"], Int[AnyArray, "B 2"]]:
    """Metres in the part of the frames that the encoder sees, and its first pixel: noise for the other
    three quarters would be drawn in vain."""
    window, first_px = plan_window(profile, config), first_pixel(crop_rc, profile, config)
    return to_metres(cut(depth_mm, first_px, (window.rows.length, window.columns.length))), first_px


def aux_losses(seen: Aux, target: Aux) -> dict[str, Float[Array, ""]]:
    """Position (Huber, network units), yaw (squared), held (cross-entropy)."""
    return {
        "position": jnp.mean(optax.huber_loss(seen.position, target.position, delta=POSITION_DELTA))
        * POSITION_WEIGHT,
        "yaw": jnp.mean((seen.yaw - target.yaw) ** 2),
        "held": jnp.mean(optax.sigmoid_binary_cross_entropy(seen.held_logit, target.held_logit)),
    }


@partial(jax.jit, static_argnums=(0, 1, 2), donate_argnums=3, compiler_options=compiler_options())
def train_step(
    config: StudentConfig, profile: CameraProfile, steps: int, state: TrainState, frozen: dict, batch: Batch
) -> tuple[TrainState, dict[str, Float[Array, ""]]]:
    """One optimiser step on pictures. Pure: noise comes from `step_key`. `state` is donated: its arrays are
    gone afterwards."""
    policy = StudentPolicy(config, profile)
    key, k_noise, k_unseen = jax.random.split(step_key(state), 3)
    depth_m, first_px = _seen_part(config, profile, batch.depth_mm, batch.crop_rc)
    if _ripples(config):
        depth_m = disparity_noise(k_noise, depth_m, first_px, profile, config)
    if config.training.unseen_share:
        grasp_m = position_to_world(batch.aux.position)
        depth_m = unseen_objects(k_unseen, depth_m, first_px, grasp_m, profile, config)

    def loss_fn(params):
        params = params | frozen
        seen = cast(
            Seen, policy.apply({"params": params}, depth_m, batch.state, batch.crop_rc, method="encode")
        )
        terms, total = {}, jnp.zeros(())
        if config.training.aux_weight:  # else nothing trains what it would say
            terms = aux_losses(seen.aux, batch.aux)
            total = config.training.aux_weight * (terms["position"] + terms["yaw"] + 0.3 * terms["held"])
            error = jnp.linalg.norm(seen.aux.position - batch.aux.position, axis=-1)
            terms["position_error_mm"] = 1000.0 * POSITION_SCALE_M * jnp.median(error)
        if config.training.action_weight:
            terms["action"] = diffusion_loss(config, policy, params, seen, batch.state, batch.action, key)
            total += config.training.action_weight * terms["action"]
        return total, terms

    (_, terms), grads = jax.value_and_grad(loss_fn, has_aux=True)(state.params)
    return updated(state, make_optimizer(config, steps), grads, config.training.ema_decay), terms


@partial(jax.jit, static_argnums=(0, 1))
def encode(
    config: StudentConfig,
    profile: CameraProfile,
    params: dict,
    depth_mm: UInt16[AnyArray, "B 3 H W"],
    state: Float[AnyArray, "B 9"],
    crop_rc: Int[AnyArray, "B 2"],
    key: Key[Array, ""] | None = None,
) -> Any:
    """`policy.Seen` of a batch; with `key`, under the disparity noise of training, if it has any."""
    depth_m, first_px = _seen_part(config, profile, depth_mm, crop_rc)
    if key is not None and _ripples(config):
        depth_m = disparity_noise(key, depth_m, first_px, profile, config)
    return StudentPolicy(config, profile).apply({"params": params}, depth_m, state, crop_rc, method="encode")


@partial(jax.jit, static_argnums=(0, 1, 2), donate_argnums=3)
def head_step(
    config: StudentConfig, profile: CameraProfile, steps: int, state: TrainState, seen: Seen,
    joints: Float[Array, "B 9"], action: Float[Array, "B chunk 8"],
) -> tuple[TrainState, dict[str, Float[Array, ""]]]:  # fmt: skip
    """One optimiser step on the head alone; `state.params` is `head_of` all. `state` is donated."""
    key = step_key(state)
    policy = StudentPolicy(config, profile)

    def loss_fn(head):
        return diffusion_loss(config, policy, head, seen, joints, action, key)

    loss, grads = jax.value_and_grad(loss_fn)(state.params)
    return updated(state, make_optimizer(config, steps), grads, config.training.ema_decay), {"loss": loss}


@partial(jax.jit, static_argnums=(0, 1))
def act_on_seen(
    config: StudentConfig,
    profile: CameraProfile,
    params: dict,
    seen: Seen,
    joints: Float[AnyArray, "B 9"],
    noise: Float[AnyArray, "B chunk 8"],
) -> Float[Array, "B chunk 8"]:
    """(B, chunk, 8) actions from what perception reports; needs `head_of` the parameters alone."""
    return sample_from_seen(params, seen, joints, noise, config, profile)
