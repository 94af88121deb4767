"""Frames per second of the generator with every sampler, from simulated depth to grafted noisy depth.

    python -m benchmarks.generator --preset laptop --batches 4 16

Random parameters (speed does not depend on their values). `x ddim 50` is the speed over that of 50-step DDIM
at the same batch. Lines alternate, so that other work on the machine slows all of them. DDPM is timed over 50
of its steps. Below, where a frame's time goes, in milliseconds.
"""

import argparse
from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import compare
from benchmarks.command import one_line
from ddg_jax.prior import make_prior
from ddg_jax.representation import channels, correlations
from ddg_jax.sample import Generator, condition, frame_noise, generate, grafted
from ddg_jax.train import init_params, predict_noise
from ddgrasp.config import CROSS_ENTROPY, DPM_SOLVER, PROGRESSIVE, DDGConfig
from ddgrasp.presets import get_preset
from learning.convolutions import compiler_options

REFERENCE = ("ddim", 50)
SAMPLERS = (
    REFERENCE, ("ddim", 10), (DPM_SOLVER, 8), (DPM_SOLVER, 4),
    (PROGRESSIVE, 4), (PROGRESSIVE, 2), (PROGRESSIVE, 1),
)  # fmt: skip
DDPM_STEPS = 50


def samplers(config: DDGConfig) -> list[tuple[str, int]]:
    """(name, evaluations): SAMPLERS that the configuration can have, and its own."""
    found = [
        pair for pair in SAMPLERS if pair[0] != PROGRESSIVE or config.training.hole_loss != CROSS_ENTROPY
    ]
    own = (config.sampling.sampler, config.sampling.steps)
    return found if own in found else [*found, own]


def scenes(config: DDGConfig, count: int) -> np.ndarray:
    """(count, H, W) metres: a table with a box that moves."""
    depth = np.full((count, config.depth.height_px, config.depth.width_px), 0.9, np.float32)
    for i in range(count):
        depth[i, config.depth.height_px // 3 : config.depth.height_px // 2, 20 + i : 60 + i] = 0.7
    return depth


def make_generator(config: DDGConfig, params: Any, batch: int, sampler: str, steps: int) -> Generator:
    """The configuration's network with that sampler, `batch` frames at once."""
    spacing = "quadratic" if sampler == PROGRESSIVE else config.sampling.spacing
    changed = replace(
        config,
        sampling=replace(config.sampling, sampler=sampler, steps=steps, spacing=spacing, batch_size=batch),
        training=replace(config.training, distil_from=16),
    )
    return Generator(changed, params, make_prior(changed))


def measure(config: DDGConfig, params: Any, batch: int, rounds: int) -> None:
    """Prints one line per sampler."""
    count = batch * jax.local_device_count()
    depth, key = scenes(config, count), jax.random.key(0)

    def contender(sampler: str, steps: int, work: float = count) -> compare.Contender:
        generator = make_generator(config, params, batch, sampler, steps)
        return compare.Contender(partial(generate, key, generator, depth), work)

    contenders = {f"{sampler} {steps}": contender(sampler, steps) for sampler, steps in samplers(config)}
    every_step = config.diffusion.steps
    timed = min(DDPM_STEPS, every_step)
    contenders[f"ddpm {every_step}"] = contender("ddpm", timed, count * timed / every_step)
    rates = compare.measure(contenders, rounds)
    reference = rates[" ".join(map(str, REFERENCE))]
    for name, rate in rates.items():
        line = f"{name:<16}{count:>6}{np.median(rate):>10.3g}{np.median(rate / reference):>12.2f}"
        print(line, flush=True)


def one_evaluation(config: DDGConfig, batch: int) -> jax.stages.Wrapped:
    """(parameters, maps, priors), `batch` frames each -> noise; compiled as `generate` is."""

    def network(params: Any, x: jax.Array, c: jax.Array) -> jax.Array:
        return predict_noise(config, params, x, c, jnp.full(batch, 500))

    return jax.jit(network, compiler_options=compiler_options())


def parts(config: DDGConfig, params: Any, batch: int, rounds: int) -> None:
    """Prints what one frame costs in each part of `generate`."""
    generator = make_generator(config, params, batch, "ddim", 1)
    depth, number = scenes(config, batch), jnp.arange(batch)
    c = condition(generator, depth, None, one_episode=True)
    shape = (config.depth.height_px, config.depth.width_px, channels(config))
    x = np.zeros((batch, *shape), np.float32)
    network = one_evaluation(config, batch)
    noise = jax.jit(partial(frame_noise, shape=shape, correlation=correlations(config)))
    on_device = jax.device_put((params, x, c))
    runners = {
        "prior": lambda: condition(generator, depth, None, one_episode=True),
        "noise, twice": lambda: [noise(jax.random.key(i), 0, number).block_until_ready() for i in range(2)],
        "one evaluation": lambda: network(*on_device).block_until_ready(),
        "grafting": lambda: grafted(config, depth, x),
    }
    for run in runners.values():
        run()
    for name, taken in compare.seconds_in_turns(runners, rounds).items():
        print(f"  {name:<16}{1e3 * np.median(taken) / batch:>8.2f}")


@one_line
def main() -> None:
    """Prints the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--preset", default="laptop")
    parser.add_argument("--batches", type=int, nargs="+", default=[4, 16], help="frames per device")
    parser.add_argument("--rounds", type=int, default=5)
    arguments = parser.parse_args()
    config = get_preset(arguments.preset).ddg
    params = init_params(config, jax.random.key(0))
    print(
        f"{config.depth.width_px} x {config.depth.height_px}, "
        f"{jax.local_device_count()} x {jax.default_backend()}"
    )
    print(f"{'sampler':<16}{'batch':>6}{'frames/s':>10}{'x ddim 50':>12}")
    for batch in arguments.batches:
        measure(config, params, batch, arguments.rounds)
    for batch in arguments.batches:
        print(f"milliseconds per frame, batch {batch}")
        parts(config, params, batch, arguments.rounds)


if __name__ == "__main__":
    main()
