"""Action diffusion: its schedule and deterministic sampler; the forward process is `learning.diffusion`'s.

a is alpha_bar, the cumulative product of (1 - beta); steps are counted k = 0 .. K-1.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from learning.diffusion import Schedule, timesteps

TERMINAL_TIME = 0.98


def cosine_schedule(steps: int) -> Schedule:
    """K steps of the squared-cosine schedule (Nichol and Dhariwal, 2021, eq. 17), short of t = 1.

    At t = 1 the schedule reaches zero and DDIM's first division by sqrt(alpha_bar) would amplify rounding
    a thousandfold; at TERMINAL_TIME sqrt(alpha_bar) is 0.03, still indistinguishable from noise.
    """
    t = np.arange(steps + 1) / steps * TERMINAL_TIME
    f = np.cos((t + 0.008) / 1.008 * np.pi / 2) ** 2
    betas = 1.0 - f[1:] / f[:-1]
    return Schedule(betas.astype(np.float32), (f[1:] / f[0]).astype(np.float32))


def ddim_timesteps(steps: int, iterations: int) -> np.ndarray:
    """(iterations,) int32 descending steps, evenly spaced from K-1, where the sample is pure noise."""
    return timesteps(steps, iterations, "trailing")


def ddim_coefficients(schedule: Schedule, iterations: int) -> np.ndarray:
    """(iterations, 4) float32 rows [1/sqrt(a), sqrt(1-a)/sqrt(a), sqrt(a'), sqrt(1-a')]; a' = 1 at the end.

    a and a' are alpha_bar at a step and at the next (less noisy) one.
    """
    a = schedule.alpha_bars.astype(np.float64)[ddim_timesteps(schedule.steps, iterations)]
    after = np.append(a[1:], 1.0)
    return np.stack(
        [1 / np.sqrt(a), np.sqrt(1 - a) / np.sqrt(a), np.sqrt(after), np.sqrt(1 - after)], axis=1
    ).astype(np.float32)


def ddim_step(x: jax.Array, eps: jax.Array, row: jax.Array) -> jax.Array:
    """x_k' = sqrt(a') x0 + sqrt(1 - a') eps' (Song et al., 2021, eq. 12, sigma = 0), x0 clipped to [-1, 1].

    eps' is the noise that agrees with the clipped x0, so that the pair still explains x.
    """
    x0 = jnp.clip(row[0] * x - row[1] * eps, -1.0, 1.0)
    eps = (row[0] * x - x0) / row[1]
    return row[2] * x0 + row[3] * eps


def ddim_sample(
    predict: Callable[[jax.Array, jax.Array], jax.Array],
    noise: jax.Array,
    schedule: Schedule,
    iterations: int,
) -> jax.Array:
    """Noise (B, ...) to samples in [-1, 1]; `predict(x, k (B,)) -> eps`."""
    rows = jnp.asarray(ddim_coefficients(schedule, iterations))
    ks = jnp.asarray(ddim_timesteps(schedule.steps, iterations))

    def body(x: jax.Array, step: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, None]:
        k, row = step
        return ddim_step(x, predict(x, jnp.full((x.shape[0],), k)), row), None

    return jax.lax.scan(body, noise, (ks, rows))[0]
