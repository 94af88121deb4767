"""What training goes on from: step, parameters, their average, the optimiser and the key, as one pytree."""

import flax.struct
import jax
import jax.numpy as jnp
import optax
from jax import Array
from jaxtyping import Int, Key, UInt32

from learning.params import Params


@flax.struct.dataclass
class TrainState:
    """Everything training needs to go on: this is what a checkpoint holds."""

    step: Array
    """() int32, steps done."""
    params: Params
    ema: Params
    """Exponential moving average of `params`: the weights that are used."""
    opt_state: optax.OptState
    key: Array
    """Raw key data (uint32); a step's randomness comes from `step_key`."""


def first_state(
    params: Params, optimizer: optax.GradientTransformation, key: UInt32[Array, " words"]
) -> TrainState:
    """State before the first step. `key` is raw key data."""
    # Copies: a donated state must not take the caller's parameters and key, or its own average, with it.
    own, average = (jax.tree.map(jnp.array, params) for _ in range(2))
    return TrainState(jnp.zeros((), jnp.int32), own, average, optimizer.init(params), jnp.array(key))


def updated(
    state: TrainState, optimizer: optax.GradientTransformation, grads: Params, ema_decay: float
) -> TrainState:
    """`state` after one optimiser step along `grads`. With `ema_decay` 0 the average is `params` itself."""
    updates, opt_state = optimizer.update(grads, state.opt_state, state.params)
    params = optax.apply_updates(state.params, updates)
    ema = averaged(state.ema, params, state.step, ema_decay)
    return TrainState(state.step + 1, params, ema, opt_state, state.key)


def averaged(ema: Params, params: Params, step: Int[Array, ""], decay: float) -> Params:
    """EMA update; the decay starts small so that the first, random weights are forgotten."""
    now = jnp.minimum(decay, (1 + step) / (10 + step))
    return jax.tree.map(lambda old, new: now * old + (1 - now) * new, ema, params)


def step_key(state: TrainState, ahead: int = 0) -> Key[Array, ""]:
    """Key of the step that `state` takes next: fold_in(key, step + ahead).

    `ahead` is 1 where fold_in(key, 0) made the parameters.
    """
    return jax.random.fold_in(jax.random.wrap_key_data(state.key), state.step + ahead)
