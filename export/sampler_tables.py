"""The generator's samplers (ddg_jax/sample.py) as numbers: what every step makes of what it has.

    x' = x a + x_0 b + clip(x_0) c + clip(x_0 of the step before) d + noise e

x_0 is the clean map that the network sees in x. All samplers are linear in these five, so that their
equations (learning/diffusion.py) are evaluated once, on ones and zeros, and a graph needs a row of numbers.
"""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float32

from ddg_jax.train import config_schedule
from ddgrasp.config import DDIM, DDPM, DPM_SOLVER, PROGRESSIVE, DDGConfig
from learning import diffusion

MOST_STEPS = 50
"""Network evaluations that a file can be asked for."""


class Row(NamedTuple):
    """Columns of the tables: arrays of a value a step, or names of a step's values in a graph."""

    step: Any
    """k, the diffusion step."""
    own: Any
    """Log odds of x = 1 against -1 from one unit of a pixel's own x (`train.valid_log_odds`)."""
    x: Any
    x_0: Any
    clipped: Any
    before: Any
    noise: Any


def is_stochastic(config: DDGConfig) -> bool:
    """Whether steps want fresh noise."""
    sampler = config.sampling.sampler
    return sampler == DDPM or (sampler == DDIM and config.sampling.eta > 0)


def sampler_tables(config: DDGConfig) -> Float32[np.ndarray, "counts most columns"]:
    """[n - 1, i] is the row of the i-th of n evaluations, zeros from i = n on. A distilled generator has one
    number of evaluations and a single table.
    """
    only = config.sampling.steps
    counts = [only] if config.sampling.sampler == PROGRESSIVE else list(range(1, MOST_STEPS + 1))
    steps = [
        diffusion.timesteps(config.diffusion.steps, n, config.sampling.spacing)
        for n in counts
        if n <= config.diffusion.steps
    ]
    visited = np.concatenate(steps)
    previous = np.concatenate([diffusion.previous_steps(s) for s in steps])
    before = np.concatenate([np.append(s[:1], s[:-1]) for s in steps])
    rows = np.stack(_rows(config, visited, previous, before), axis=-1).astype(np.float32)
    tables = np.zeros((len(steps), max(map(len, steps)), rows.shape[-1]), np.float32)
    start = 0
    for table, s in zip(tables, steps, strict=True):
        table[: len(s)] = rows[start : start + len(s)]
        start += len(s)
    return tables


def _rows(config: DDGConfig, k: np.ndarray, previous: np.ndarray, before: np.ndarray) -> Row:
    made, sampler = config_schedule(config), config.sampling.sampler
    one, none = np.ones(len(k), np.float32), np.zeros(len(k), np.float32)
    alpha_bar = np.asarray(diffusion.alpha_bar_at(made, k, one))
    own = 2 * np.sqrt(alpha_bar) / (1 - alpha_bar)
    if sampler == DPM_SOLVER:
        units = ((one, none, none), (none, one, none), (none, none, one))
        x, clipped, earlier = (
            np.asarray(diffusion.dpm_solver_step(made, a, k, previous, b, before, c)) for a, b, c in units
        )
        return Row(k, own, x, none, clipped, earlier, none)
    if sampler == DDPM:
        x, clipped = (
            np.asarray(diffusion.posterior_mean(made, a, b, k, previous))
            for a, b in ((one, none), (none, one))
        )
        variance = np.asarray(diffusion.posterior_variance(made, k, previous, one))
        return Row(k, own, x, none, clipped, none, np.where(previous < 0, 0, np.sqrt(variance)))
    if sampler not in (DDIM, PROGRESSIVE):
        raise ValueError(f"sampler {sampler!r} has no row")
    c = diffusion.ddim_coefficients(made, k, previous, one, config.sampling.eta if sampler == DDIM else 0.0)
    next_eps, next_x_0, sigma = (np.broadcast_to(v, k.shape) for v in (c.next_eps, c.next_x_0, c.sigma))
    x = next_eps * np.asarray(diffusion.eps_from_x_0(made, one, k, none))
    x_0 = next_eps * np.asarray(diffusion.eps_from_x_0(made, none, k, one))
    if sampler == PROGRESSIVE:  # nothing is clipped
        return Row(k, own, x, x_0 + next_x_0, none, none, none)
    return Row(k, own, x, x_0, next_x_0, none, sigma)
