"""Progressive distillation: a sampler of few network evaluations learnt from one of many.

A student of n evaluations learns to do in one DDIM step what its teacher does in two of 2n. The first teacher
is the fitted network with `ddg.training.distil_from` evaluations, the second step of every two of second
order. Every further one is the student before it, until `ddg.sampling.steps` are left (Salimans & Ho 2022,
algorithm 2). Noise levels are only those that the student's sampler visits, so that all of its capacity goes
to them.
"""

from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax import Array
from jax.typing import ArrayLike
from jaxtyping import Float, Int, Int32

from ddg_jax.data import Frames, make_batch
from ddg_jax.train import (
    config_schedule,
    make_optimizer,
    predict_clean,
    step_keys,
)
from ddgrasp.config import DDGConfig
from ddgrasp.errors import UserError
from ddgrasp.progress import Progress
from learning import diffusion
from learning.convolutions import compiler_options
from learning.loop import run_steps
from learning.params import Params, load_params, save_params
from learning.train_state import TrainState, first_state, updated

LEARNING_RATE = 0.5
"""Relative to the fit's."""
X_LIMIT = 1.0
"""|x_0| of the diffusion space: the fitted network's predictions are clipped to it. A student's are not: its
x_0 stands for a whole step of the teacher's and may lie outside."""


def params_file(steps: int) -> str:
    """Name of the file with the student of `steps` network evaluations."""
    return f"distilled_{steps}.msgpack"


def rounds(config: DDGConfig) -> list[int]:
    """Network evaluations of each student, in the order of training, the last `config.sampling.steps`."""
    counts = [config.sampling.steps]
    while 2 * counts[-1] < config.training.distil_from:
        counts.append(2 * counts[-1])
    return counts[::-1]


def check(config: DDGConfig) -> None:
    """UserError if a round's steps are not every second one of those that its teacher takes."""
    steps, spacing = config.diffusion.steps, config.sampling.spacing
    for count in rounds(config):
        if not np.array_equal(
            diffusion.timesteps(steps, 2 * count, spacing)[::2], diffusion.timesteps(steps, count, spacing)
        ):
            raise UserError(
                f"ddg.training.distil_from is {config.training.distil_from}: of {steps} diffusion steps, "
                f"spacing {spacing}, {2 * count} evaluations cannot be halved step by step; take fewer of "
                "those, or more ddg.diffusion.steps."
            )


def distil(
    config: DDGConfig, fitted: Params, frames: Frames, directory: Path, seed: int, progress: Progress
) -> Params:
    """The student of `config.sampling.steps` evaluations, averaged parameters.

    Leaves a file and checkpoints per round in `directory`; rounds whose file is there are not repeated, an
    unfinished one goes on (see `loop.run_steps`).
    """
    teacher = fitted
    for number, count in enumerate(rounds(config)):
        path = directory / params_file(count)
        if not path.exists():
            limit = X_LIMIT if number == 0 else np.inf
            save_params(path, _round(config, teacher, frames, directory, seed, progress, count, limit))
        teacher = load_params(path, teacher)
    return teacher


def _round(
    config: DDGConfig,
    teacher: Params,
    frames: Frames,
    directory: Path,
    seed: int,
    progress: Progress,
    count: int,
    limit: float,
) -> Params:
    teacher, made = jax.tree.map(jnp.asarray, teacher), config_schedule(config)
    key = jax.random.key_data(jax.random.fold_in(jax.random.key(seed), count))

    def step_once(state: TrainState, step: int) -> tuple[TrainState, dict[str, Array]]:
        # Batches of its own, whatever the fit and the other rounds drew.
        batch = make_batch(
            frames, config, seed, config.training.steps + count * config.training.distil_steps + step
        )
        number = np.random.default_rng((seed, count, step)).integers(count, size=config.training.batch_size)
        path = teacher_path(made.steps, count, number, config.sampling.spacing)
        return distil_step(config, state, teacher, limit, path, batch.x_0, batch.c)

    state, _ = run_steps(
        first_state(teacher, make_optimizer(config, config.training.distil_steps, LEARNING_RATE), key),
        config.training.distil_steps,
        step_once,
        directory / f"distil_{count}",
        every=config.training.checkpoint_every,
        label=f"distilling to {count}",
        progress=progress,
        curve=f"distil_{count}/",
    )
    return jax.tree.map(np.asarray, state.ema)


@partial(jax.jit, static_argnums=0, donate_argnums=1, compiler_options=compiler_options())
def distil_step(
    config: DDGConfig,
    state: TrainState,
    teacher: Params,
    limit: Float[ArrayLike, ""],
    path: Int[ArrayLike, "3 B"],
    x_0: Float[Array, "B H W C"],
    c: Float[Array, "B H W"],
) -> tuple[TrainState, dict[str, Float[Array, ""]]]:
    """One optimiser step of the student on x_0 (B, H, W, C), c (B, H, W).

    Pure: its noise comes from `train.step_keys`.

    The student's error in x_0 weighs SNR within `config.training.snr_limits` (eq. 9 there, with a cap).

    Args:
      limit: the teacher's |x_0| is clipped to it.
      path: (3, B) int, see `teacher_path`.
    """
    eps_key, _, prior_key = step_keys(state)
    made = config_schedule(config)
    c = c + config.prior.noise * jax.random.normal(prior_key, c.shape)
    path = jnp.asarray(path)
    k, _, end = path
    x_k = diffusion.q_sample(made, x_0, k, jax.random.normal(eps_key, x_0.shape))

    def teacher_step(
        last: tuple[Array, Array], hop: tuple[Array, Array, Array]
    ) -> tuple[tuple[Array, Array], None]:
        (x, x_0_before), (before, now, then) = last, hop
        x_0 = jnp.clip(predict_clean(config, teacher, x, c, now), -jnp.asarray(limit), limit)
        return (diffusion.dpm_solver_step(made, x, now, then, x_0, before, x_0_before), x_0), None

    # Only the fitted network's x_0 is one that the second order can be taken from.
    before = jnp.stack([k, jnp.where(jnp.isfinite(limit), k, path[1])])
    (x, _), _ = jax.lax.scan(teacher_step, (x_k, x_k), (before, path[:2], path[1:]))
    target = jax.lax.stop_gradient(one_step_target(made, x_k, k, x, end))
    weight = jnp.clip(diffusion.signal_to_noise(made, k), *config.training.snr_limits)

    def loss_of(params: Params) -> Array:
        error = (target - predict_clean(config, params, x_k, c, k)) ** 2
        return jnp.mean(weight * jnp.mean(error, axis=(1, 2, 3)))

    loss, grads = jax.value_and_grad(loss_of)(state.params)
    optimizer = make_optimizer(config, config.training.distil_steps, LEARNING_RATE)
    state = updated(state, optimizer, grads, config.training.ema_decay)
    return state, {"loss": loss, "grad_norm": optax.global_norm(grads)}


def teacher_path(
    steps: int, count: int, number: Int[np.ndarray, " B"], spacing: str
) -> Int32[np.ndarray, "3 B"]:
    """(3, B) int32: where the teacher starts, passes and ends during step `number` (B,) of the student.

    steps: of the forward process; count: the student's, half of the teacher's.
    """
    path = np.append(diffusion.timesteps(steps, 2 * count, spacing), -1).astype(np.int32)
    return np.stack([path[2 * number + ahead] for ahead in range(3)])


def one_step_target(
    made: diffusion.Schedule,
    x_k: Float[Array, "B ..."],
    k: Int[Array, " B"],
    x_end: Float[Array, "B ..."],
    end: Int[Array, " B"],
) -> Float[Array, "B ..."]:
    """The x_0 whose DDIM step takes x_k (step k) to x_end (step `end`) (Salimans & Ho 2022, appendix G).

    With r = sqrt((1 - alpha_bar_end) / (1 - alpha_bar_k)):
    x_0 = (x_end - r x_k) / (sqrt(alpha_bar_end) - r sqrt(alpha_bar_k)).
    """
    a, a_end = diffusion.alpha_bar_at(made, k, x_k), diffusion.alpha_bar_at(made, end, x_k)
    r = jnp.sqrt((1 - a_end) / (1 - a))
    return (x_end - r * x_k) / (jnp.sqrt(a_end) - r * jnp.sqrt(a))
