"""Discrete diffusion: noise schedules and the forward, DDPM, DDIM and DPM-Solver++ equations.

One equation, one function; noise is always an argument. Everything is generic over the shape of x: depth maps
of the generator, action chunks of the student. Notation: step k in 0..K-1, beta_k, alpha_bar_k =
prod (1 - beta), x_k the noised sample, eps the noise; `previous` = -1 stands for the clean sample
(alpha_bar = 1).

Sources: Ho et al. 2020 (DDPM), Song et al. 2021 (DDIM), Nichol & Dhariwal 2021 (cosine schedule),
Lu et al. 2022 (DPM-Solver++), Lin et al. 2024 (trailing steps), Hoogeboom et al. 2023 (shifted schedule).
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike
from jaxtyping import Float, Float32, Float64, Int, Int32

from ddgrasp.config import SPACINGS
from ddgrasp.config.ddg import COSINE_OFFSET, FIRST_LINEAR_BETA, LAST_LINEAR_BETA, MAX_BETA
from ddgrasp.errors import UserError, looked_up, unknown_name

VARIANCE_FLOOR = 1e-20
PREDICTED, CONSISTENT = "predicted", "consistent"
"""Which eps a DDIM step goes on with after x_0 was clipped: see `ddim_step`."""


class Schedule(NamedTuple):
    """A noise schedule of K steps; NumPy, so that its numbers are constants of jitted functions."""

    betas: Float32[np.ndarray, " K"]
    alpha_bars: Float32[np.ndarray, " K"]

    @property
    def steps(self) -> int:
        """K, the number of diffusion steps."""
        return len(self.betas)


def linear_betas(steps: int) -> Float64[np.ndarray, " {steps}"]:
    """beta_k in equal steps, (K,) float64 (Ho et al. 2020, section 4)."""
    return np.linspace(FIRST_LINEAR_BETA, LAST_LINEAR_BETA, steps)


def cosine_betas(steps: int, terminal_time: float = 1.0) -> Float64[np.ndarray, " {steps}"]:
    """beta_k = 1 - f(T(k+1)/K) / f(Tk/K), f(u) = cos^2(pi/2 (u+s)/(1+s)), (K,) (N. & D. 2021, eq. 17, T = 1).

    With `terminal_time` T below 1 the last sample keeps some signal. At T = 1 alpha_bar reaches zero, and
    DDIM's first division by its root amplifies rounding a thousandfold; at 0.98 the root is 0.03, still
    indistinguishable from noise.
    """
    u = np.arange(steps + 1) / steps * terminal_time
    f = np.cos((u + COSINE_OFFSET) / (1 + COSINE_OFFSET) * math.pi / 2) ** 2
    return np.minimum(1 - f[1:] / f[:-1], MAX_BETA)


def shifted_betas(betas: Float64[np.ndarray, " K"], log_snr_shift: float) -> Float64[np.ndarray, " K"]:
    """Betas whose log SNR, log(alpha_bar / (1 - alpha_bar)), is moved by `log_snr_shift` at every step.

    Negative values make every step noisier, which large pictures want (Hoogeboom et al. 2023, eq. 5).
    """
    alpha_bars = np.cumprod(1 - betas)
    moved = 1 / (1 + (1 - alpha_bars) / alpha_bars * math.exp(-log_snr_shift))
    previous = np.concatenate([[1.0], moved[:-1]])
    return np.minimum(1 - moved / previous, MAX_BETA)


_BETAS = {"linear": linear_betas, "cosine": cosine_betas}


def make_schedule(name: str, steps: int, log_snr_shift: float = 0.0) -> Schedule:
    """Schedule "linear" or "cosine" with `steps` steps; UserError for another name or fewer than 2 steps."""
    betas_of = looked_up("noise schedule", name, _BETAS)
    if steps < 2:
        raise UserError(f"A noise schedule needs at least 2 steps, not {steps}.")
    betas = betas_of(steps)
    if log_snr_shift:
        betas = shifted_betas(betas, log_snr_shift)
    return schedule_of(betas)


def schedule_of(betas: Float64[np.ndarray, " K"]) -> Schedule:
    """The schedule with these betas, (K,) float64."""
    return Schedule(betas.astype(np.float32), np.cumprod(1 - betas).astype(np.float32))


def timesteps(steps: int, count: int, spacing: str = "trailing") -> Int32[np.ndarray, " {count}"]:
    """`count` of the steps K-1..0 that a few-step sampler visits, descending, (count,) int32.

    "leading" ends at 0 and starts short of K-1; "trailing" starts at K-1, where x is pure noise, and ends
    short of 0; "linspace" has both ends (Lin et al. 2024, table 2). "quadratic" is trailing with steps
    that grow as a square, so that the last ones are short (Song et al. 2021, appendix D.2). A single step is
    K-1 in all of them: no other takes pure noise for what it is.
    """
    if not 1 <= count <= steps:
        raise UserError(f"Sampling steps must lie in 1..{steps} (the schedule's length), not {count}.")
    if spacing == "leading":
        visited = (np.arange(count) * (steps // count))[::-1]
    elif spacing == "trailing":
        visited = np.round(steps - np.arange(count) * (steps / count)) - 1
    elif spacing == "quadratic":
        left = np.arange(count)[::-1]
        visited = np.maximum(np.round(steps * ((left + 1) / count) ** 2) - 1, left)
    elif spacing == "linspace":
        visited = np.round(np.linspace(0, steps - 1, count))[::-1]
    else:
        raise unknown_name("timestep spacing", spacing, SPACINGS)
    if count == 1:
        visited = np.array([steps - 1])
    return visited.astype(np.int32)


def previous_steps(visited: Int[np.ndarray, " count"]) -> Int32[np.ndarray, " count"]:
    """The step each visited step leads to: the next visited one, finally -1. (count,) int32."""
    return np.append(visited[1:], -1).astype(np.int32)


def alpha_bar_at(
    schedule: Schedule, step: Int[ArrayLike, "*lead"], x: Float[ArrayLike, "*x"]
) -> Float[Array, "..."]:
    """alpha_bar at `step` (any leading shape of x; -1 gives 1), with axes added to broadcast against x."""
    step = jnp.asarray(step)
    value = jnp.where(step < 0, 1.0, jnp.asarray(schedule.alpha_bars)[jnp.maximum(step, 0)])
    return value.reshape(value.shape + (1,) * (jnp.ndim(x) - value.ndim))


def q_sample(
    schedule: Schedule,
    x_0: Float[ArrayLike, "*x"],
    step: Int[ArrayLike, "*lead"],
    eps: Float[ArrayLike, "*x"],
) -> Float[Array, "*x"]:
    """x_k = sqrt(alpha_bar) x_0 + sqrt(1 - alpha_bar) eps (Ho et al. 2020, eq. 4). x_0, eps: (B, ...), step
    (B,).
    """
    a = alpha_bar_at(schedule, step, x_0)
    return jnp.sqrt(a) * x_0 + jnp.sqrt(1 - a) * eps


def predict_x_0(
    schedule: Schedule,
    x_k: Float[ArrayLike, "*x"],
    step: Int[ArrayLike, "*lead"],
    eps: Float[ArrayLike, "*x"],
) -> Float[Array, "*x"]:
    """x_0 = (x_k - sqrt(1 - alpha_bar) eps) / sqrt(alpha_bar): `q_sample` solved for x_0 (eq. 15)."""
    a = alpha_bar_at(schedule, step, x_k)
    return jnp.asarray((x_k - jnp.sqrt(1 - a) * eps) / jnp.sqrt(a))


def eps_from_x_0(
    schedule: Schedule,
    x_k: Float[ArrayLike, "*x"],
    step: Int[ArrayLike, "*lead"],
    x_0: Float[ArrayLike, "*x"],
) -> Float[Array, "*x"]:
    """eps = (x_k - sqrt(alpha_bar) x_0) / sqrt(1 - alpha_bar): `q_sample` solved for eps."""
    a = alpha_bar_at(schedule, step, x_k)
    return jnp.asarray((x_k - jnp.sqrt(a) * x_0) / jnp.sqrt(1 - a))


def signal_to_noise(schedule: Schedule, step: Int[ArrayLike, "*lead"]) -> Float[Array, "*lead"]:
    """alpha_bar / (1 - alpha_bar) at `step`, shaped like `step`."""
    a = jnp.asarray(schedule.alpha_bars)[jnp.asarray(step)]
    return a / (1 - a)


def posterior_mean(
    schedule: Schedule,
    x_k: Float[ArrayLike, "*x"],
    x_0: Float[ArrayLike, "*x"],
    step: Int[ArrayLike, "*lead"],
    previous: Int[ArrayLike, "*lead"],
) -> Float[Array, "*x"]:
    """Mean of q(x_previous | x_k, x_0) (Ho et al., eq. 7; alpha = alpha_bar_k / alpha_bar_previous)."""
    a, a_prev = alpha_bar_at(schedule, step, x_k), alpha_bar_at(schedule, previous, x_k)
    alpha = a / a_prev
    return (jnp.sqrt(a_prev) * (1 - alpha) * x_0 + jnp.sqrt(alpha) * (1 - a_prev) * x_k) / (1 - a)


def posterior_variance(
    schedule: Schedule,
    step: Int[ArrayLike, "*lead"],
    previous: Int[ArrayLike, "*lead"],
    x: Float[ArrayLike, "*x"],
) -> Float[Array, "..."]:
    """beta~ = (1 - alpha_bar_previous) / (1 - alpha_bar_k) * (1 - alpha_k) (Ho et al. 2020, eq. 7), 0 at the
    end.
    """
    a, a_prev = alpha_bar_at(schedule, step, x), alpha_bar_at(schedule, previous, x)
    return (1 - a_prev) / (1 - a) * (1 - a / a_prev)


def ddpm_step(
    schedule: Schedule,
    x_k: Float[ArrayLike, "*x"],
    step: Int[ArrayLike, "*lead"],
    previous: Int[ArrayLike, "*lead"],
    eps: Float[ArrayLike, "*x"],
    noise: Float[ArrayLike, "*x"],
    clip: Float[ArrayLike, ""] | None,
) -> Float[Array, "*x"]:
    """One ancestral step x_k -> x_previous from predicted `eps` (Ho et al. 2020, algorithm 2).

    `noise` is standard normal, shaped like x_k, unused when previous = -1. `clip`: |x_0| is limited to it.
    """
    x_0 = predict_x_0(schedule, x_k, step, eps)
    x_0 = x_0 if clip is None else jnp.clip(x_0, -jnp.asarray(clip), clip)
    variance = jnp.maximum(posterior_variance(schedule, step, previous, x_k), VARIANCE_FLOOR)
    noise = jnp.where(jnp.asarray(previous) < 0, 0.0, 1.0) * noise
    return posterior_mean(schedule, x_k, x_0, step, previous) + jnp.sqrt(variance) * noise


@dataclass(frozen=True)
class DDIMCoefficients:
    """One step x_k -> x_k' of DDIM, with a = alpha_bar at k and a' at k'.

    x_k explains itself by `x` x_k = `x_0` x_0 + `eps` eps; x_k' = `next_x_0` x_0 + `next_eps` eps + `sigma`
    noise.
    """

    row: Sequence[ArrayLike] | Array | np.ndarray
    """x, eps, next_x_0, next_eps: four numbers or arrays, or a row of `ddim_table`."""
    x_0: ArrayLike = 1.0
    sigma: ArrayLike = 0.0

    # Read where they are used: a row taken apart ahead of the step makes XLA contract other products, and
    # the student's actions move by 4e-7.
    @property
    def x(self) -> ArrayLike:
        """Factor of x_k."""
        return self.row[0]

    @property
    def eps(self) -> ArrayLike:
        """Factor of eps in x_k."""
        return self.row[1]

    @property
    def next_x_0(self) -> ArrayLike:
        """Factor of x_0 in x_k'."""
        return self.row[2]

    @property
    def next_eps(self) -> ArrayLike:
        """Factor of eps in x_k'."""
        return self.row[3]


def ddim_coefficients(
    schedule: Schedule,
    step: Int[ArrayLike, "*lead"],
    previous: Int[ArrayLike, "*lead"],
    x: Float[ArrayLike, "*x"],
    eta: float = 0.0,
) -> DDIMCoefficients:
    """Coefficients of `q_sample` as it stands: 1 x_k = sqrt(a) x_0 + sqrt(1 - a) eps.

    Computed in x's precision. Steps may be traced and have any leading shape of x. sigma is eta times the
    DDPM's (Song et al. 2021, eq. 16): eta = 0 is deterministic, eta = 1 injects the DDPM's variance.
    """
    a, a_prev = alpha_bar_at(schedule, step, x), alpha_bar_at(schedule, previous, x)
    sigma = eta * jnp.sqrt(posterior_variance(schedule, step, previous, x))
    # A step from pure noise has sigma^2 = 1 - alpha_bar_previous, and rounding may push the rest below 0.
    remainder = jnp.maximum(1 - a_prev - sigma**2, 0.0)
    row = (1.0, jnp.sqrt(1 - a), jnp.sqrt(a_prev), jnp.sqrt(remainder))
    return DDIMCoefficients(row, jnp.sqrt(a), sigma)


def ddim_table(schedule: Schedule, visited: Int[np.ndarray, " count"]) -> Float32[np.ndarray, "count 4"]:
    """(len(visited), 4) float32: `DDIMCoefficients.row` of each visited step, eta = 0.

    Of `q_sample` solved for x_0, 1/sqrt(a) x_k = x_0 + sqrt(1 - a)/sqrt(a) eps, so that an exported graph
    multiplies by constants; computed in float64, rounded once.
    """
    a = schedule.alpha_bars.astype(np.float64)[visited]
    after = np.append(a[1:], 1.0)
    columns = 1 / np.sqrt(a), np.sqrt(1 - a) / np.sqrt(a), np.sqrt(after), np.sqrt(1 - after)
    return np.stack(columns, axis=1).astype(np.float32)


def ddim_step(
    c: DDIMCoefficients,
    x_k: Float[ArrayLike, "*x"],
    eps: Float[ArrayLike, "*x"],
    clip: Float[ArrayLike, ""] | None,
    *,
    noise: Float[ArrayLike, "*#x"] = 0.0,
    after_clip: str = PREDICTED,
) -> Float[Array, "*x"]:
    """One DDIM step x_k -> x_k' from predicted `eps` (Song et al. 2021, eq. 12).

    Args:
      clip: |x_0| is limited to it.
      noise: standard normal, shaped like x_k; unused where `c.sigma` is 0.
      after_clip: PREDICTED keeps the direction towards x_k as predicted, like `clip_sample` of Hugging Face
        diffusers; CONSISTENT takes the eps that explains x_k together with the clipped x_0 (diffusers'
        `use_clipped_model_output`, GLIDE by Nichol et al. 2022).
    """
    x_k, eps = jnp.asarray(x_k), jnp.asarray(eps)
    x_0 = (c.x * x_k - c.eps * eps) / c.x_0
    if clip is not None:
        x_0 = jnp.clip(x_0, -jnp.asarray(clip), clip)
        if after_clip == CONSISTENT:
            eps = (c.x * x_k - c.x_0 * x_0) / c.eps
    return jnp.asarray(c.next_x_0 * x_0 + c.next_eps * eps + c.sigma * noise)


def ddim_sample(
    predict: Callable[[Array, Array], Array],
    noise: Float[Array, "*x"],
    schedule: Schedule,
    count: int,
    clip: float = 1.0,
) -> Float[Array, "*x"]:
    """Deterministic DDIM from noise (B, ...) to samples within `clip`; `predict(x, k (B,)) -> eps`.

    `count` trailing steps, eps consistent with the clipped x_0: an exported graph unrolls the same.
    """
    visited = timesteps(schedule.steps, count, "trailing")

    def body(x: Array, step: tuple[Array, Array]) -> tuple[Array, None]:
        k, row = step
        eps = predict(x, jnp.full((x.shape[0],), k))
        return ddim_step(DDIMCoefficients(row), x, eps, clip, after_clip=CONSISTENT), None

    steps = jnp.asarray(visited), jnp.asarray(ddim_table(schedule, visited))
    return jax.lax.scan(body, noise, steps)[0]


def log_snr_half(
    schedule: Schedule, step: Int[ArrayLike, "*lead"], x: Float[ArrayLike, "*x"]
) -> Float[Array, "..."]:
    """lambda = log(sqrt(alpha_bar) / sqrt(1 - alpha_bar)) at `step`, broadcast against x; inf at -1."""
    a = alpha_bar_at(schedule, step, x)
    return 0.5 * (jnp.log(a) - jnp.log1p(-a))


def dpm_solver_step(
    schedule: Schedule,
    x_k: Float[ArrayLike, "*x"],
    step: Int[ArrayLike, "*lead"],
    previous: Int[ArrayLike, "*lead"],
    x_0: Float[ArrayLike, "*x"],
    before: Int[ArrayLike, "*lead"],
    x_0_before: Float[ArrayLike, "*x"],
) -> Float[Array, "*x"]:
    """One step of DPM-Solver++(2M), x_k -> x_previous, second order (Lu et al. 2022, algorithm 2).

    x_0 is the prediction at `step`, x_0_before the one at `before`, the step visited before it; where
    `before` equals `step` there was none, and the step is DDIM's, as the one to the clean sample (-1) is.
    """
    a, a_next = alpha_bar_at(schedule, step, x_k), alpha_bar_at(schedule, previous, x_k)
    now = log_snr_half(schedule, step, x_k)
    ahead = log_snr_half(schedule, previous, x_k) - now
    behind = now - log_snr_half(schedule, before, x_k)
    plain = (behind <= 0) | jnp.isinf(ahead)
    slope = jnp.where(plain, 0.0, ahead / (2 * jnp.where(plain, 1.0, behind)))
    x_0 = x_0 + slope * (jnp.asarray(x_0) - x_0_before)
    scale = jnp.sqrt((1 - a_next) / (1 - a))
    return scale * x_k + (jnp.sqrt(a_next) - scale * jnp.sqrt(a)) * x_0
