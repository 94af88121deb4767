"""Joint-state stream and the network that predicts the noise in an action chunk (Ho et al., 2020, eq. 14)."""

from types import ModuleType

import jax
import jax.numpy as jnp
import numpy as np
from flax import linen as nn
from jaxtyping import Float, Float32, Int, Real

from ddgrasp import contract
from ddgrasp.arrays import AnyArray
from ddgrasp.config import StudentConfig
from learning.layers import sinusoids, time_frequencies

LAYER_NORM_EPSILON = 1e-5
_CHANGE_M = contract.GRIPPER_SPEED_M_S * contract.CONTROL_DT_S
STATE_LOWER = np.array([*contract.JOINT_LOWER_RAD, 0.0, -_CHANGE_M], np.float32)
STATE_UPPER = np.array([*contract.JOINT_UPPER_RAD, contract.GRIPPER_MAX_WIDTH_M, _CHANGE_M], np.float32)


def normalise_state(state: Float[AnyArray, "B 9"]) -> Float[jax.Array, "B 9"]:
    """(B, 9) seven joints (rad), gripper width and its change (m) to [-1, 1] between their limits."""
    return 2.0 * (state - STATE_LOWER) / (STATE_UPPER - STATE_LOWER) - 1.0


def embed_time(
    k: Real[AnyArray, " B"], features: int, xp: ModuleType = jnp
) -> Float32[AnyArray, "B {features}"]:
    """(B,) diffusion steps to (B, features): sines, then cosines. `xp`: numpy for the exported graph."""
    return sinusoids(k, time_frequencies(features), cosine_first=False, xp=xp)


class StateStream(nn.Module):
    """Joint state to features: two dense layers."""

    config: StudentConfig

    @nn.compact
    def __call__(self, state: Float[AnyArray, "B 9"]) -> Float[jax.Array, "B D"]:
        """(B, 9) -> (B, state_features)."""
        x = nn.relu(nn.Dense(self.config.head.state_features, name="first")(normalise_state(state)))
        return nn.relu(nn.Dense(self.config.head.state_features, name="second")(x))


class DenoiserBlock(nn.Module):
    """x + W2 silu(film(W1 layernorm(x)))."""

    width: int
    film: bool

    @nn.compact
    def __call__(
        self, x: Float[AnyArray, "B D"], condition: Float[AnyArray, "B C"]
    ) -> Float[jax.Array, "B D"]:
        """(B, width), what it is told (B, C) -> (B, width)."""
        y = nn.Dense(self.width, name="first")(nn.LayerNorm(epsilon=LAYER_NORM_EPSILON, name="norm")(x))
        if self.film:
            scale, shift = jnp.split(nn.Dense(2 * self.width, name="film")(condition), 2, axis=-1)
            y = y * (1.0 + scale) + shift
        return x + nn.Dense(self.width, name="second")(nn.silu(y))


class Denoiser(nn.Module):
    """Predicted noise of a chunk of actions, given the diffusion step and what the policy sees."""

    config: StudentConfig

    @nn.compact
    def __call__(
        self,
        noisy_action: Float[AnyArray, "B chunk 8"],
        k: Int[AnyArray, " B"],
        cond: Float[AnyArray, "B D"],
    ) -> Float[jax.Array, "B chunk 8"]:
        """(B, chunk, 8), (B,) int, (B, D) -> (B, chunk, 8)."""
        config = self.config
        film = config.head.conditioning == "film"
        embedded = nn.Dense(config.head.time_features, name="time_first")(
            embed_time(k, config.head.time_features)
        )
        embedded = nn.Dense(config.head.time_features, name="time_second")(nn.silu(embedded))
        condition = jnp.concatenate([cond, embedded], axis=-1)
        x = noisy_action.reshape(noisy_action.shape[0], -1)
        x = x if film else jnp.concatenate([x, condition], axis=-1)
        x = nn.Dense(config.head.width, name="input")(x)
        for index in range(config.head.blocks):
            x = DenoiserBlock(config.head.width, film, name=f"block{index}")(x, condition)
        x = nn.silu(nn.LayerNorm(epsilon=LAYER_NORM_EPSILON, name="norm")(x))
        x = nn.Dense(
            config.head.chunk * contract.ACTION_SIZE, name="output", kernel_init=nn.initializers.zeros
        )(x)
        return x.reshape(noisy_action.shape)
