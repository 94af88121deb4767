"""Programs on a CPU, compiled as jaxlib 0.10 prefers and by Eigen alone, in turns.

Training steps of generator and student and the sampler are compiled by Eigen in this project, others are not.

    python -m benchmarks.convolutions --rounds 6

A training step takes its arguments over, so that every call has new ones, made outside the time.
"""

import argparse
import time

import jax
import numpy as np

from benchmarks.command import one_line
from benchmarks.programs import PROGRAMS, Program
from benchmarks.training_speed import filled
from ddgrasp.presets import get_preset
from learning.convolutions import OPTION, compiler_options

NAMES = ("student: train step", "student: features", "student: head step", "generator: train step",
         "sampler: ddim", "PPO: gradient steps")  # fmt: skip
PREFERRED = {OPTION: "LIBRARY_FUSION_TYPE_INDIVIDUAL_CONVOLUTION,LIBRARY_FUSION_TYPE_INDIVIDUAL_DOT"}
"""What jaxlib 0.10 does where nothing is said."""


def milliseconds(program: Program, rounds: int) -> np.ndarray:
    """(rounds, 2) times of a call: as jaxlib prefers, and with `compiler_options`."""
    jitted, arguments = program
    lowered = jitted.lower(*arguments)
    given = tuple(argument for argument in arguments if _of_shapes(argument))
    ways = [lowered.compile(compiler_options=options) for options in (PREFERRED, compiler_options())]
    times = np.zeros((rounds + 1, len(ways)))
    for row in times:
        for column, way in enumerate(ways):
            made = jax.block_until_ready(filled(given))
            start = time.perf_counter()
            jax.block_until_ready(way(*made))
            row[column] = 1e3 * (time.perf_counter() - start)
    return times[1:]  # the first call of each is slower


def _of_shapes(argument: object) -> bool:
    """Whether it stands for arrays; what is static does not."""
    return any(isinstance(leaf, jax.ShapeDtypeStruct) for leaf in jax.tree.leaves(argument))


@one_line
def main() -> None:
    """Prints a line for each program."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--preset", default="demo")
    parser.add_argument("--rounds", type=int, default=6)
    parser.add_argument("--programs", nargs="+", default=NAMES, choices=PROGRAMS, metavar="NAME")
    options = parser.parse_args()
    config = get_preset(options.preset)
    if compiler_options() is None:
        print("Nothing to compare: this jaxlib is not 0.10, or compiles for an accelerator.")
        return
    print(f"{'ms a call':<24}{'preferred':>10}{'Eigen':>10}{'ratio':>8}")
    for name in options.programs:
        times = milliseconds(PROGRAMS[name](config), options.rounds)
        preferred, eigen = np.median(times, axis=0)
        ratio = np.median(times[:, 0] / times[:, 1])
        print(f"{name:<24}{preferred:>10.0f}{eigen:>10.0f}{ratio:>8.2f}", flush=True)


if __name__ == "__main__":
    main()
