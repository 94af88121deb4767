"""Speed of the world against its peers, in one run on one machine: physics, PPO rollout, rendering.

    python -m benchmarks.world [--out world.json]

A few minutes on two cores, most of it compilation. A ratio is ours over the peer's; lines with a target say
whether it is met. Other work on the machine slows both sides, but not equally: the load is printed.
"""

import argparse
import os
import sys
import time
from dataclasses import replace
from importlib import metadata
from pathlib import Path

if sys.platform.startswith("linux"):
    os.environ.setdefault("MUJOCO_GL", "egl")  # MuJoCo reads it when it is imported
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(Path(".cache/jax").absolute()))
# Playground's step at 256 environments hangs without it on two cores and JAX 0.10 (docs/physics.md).
if tuple(int(part) for part in metadata.version("jax").split(".")[:2]) < (0, 12):
    os.environ["XLA_FLAGS"] = (
        f"{os.environ.get('XLA_FLAGS', '')} --xla_cpu_enable_concurrency_optimized_scheduler=false"
    )

from benchmarks import physics_speed, render_speed
from benchmarks.compare import as_json, print_table
from ddgrasp import machine
from ddgrasp.config import WorldConfig
from ddgrasp.files import atomic_write_json
from ddgrasp.presets import LAPTOP

_SIX = replace(LAPTOP, world=WorldConfig())
"""The scene of the paper's six objects, as in every figure so far."""


def main() -> None:
    """Prints the table, and writes it as JSON if asked to."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--out", type=Path, help="JSON file to write")
    parser.add_argument("--rounds", type=int, default=7, help="repetitions, taken in turns")
    arguments = parser.parse_args()
    start, load = time.monotonic(), os.getloadavg()[0]
    rows, trouble = render_speed.render_rows(_SIX, 3 * arguments.rounds)
    rows = physics_speed.rollout_rows(_SIX, arguments.rounds) + rows
    rows = physics_speed.playground_rows(_SIX, arguments.rounds) + rows
    here, loads = machine.describe(), [load, os.getloadavg()[0]]
    seconds = time.monotonic() - start
    title = f"{here['processor']}, {here['cores']} cores, load {loads[0]:.1f} to {loads[1]:.1f}"
    print_table(f"{title}; {arguments.rounds} rounds, {seconds:.0f} s", rows)
    if trouble:
        print(f"No OpenGL here: {trouble}")
    if arguments.out:
        figures = {"machine": here, "load": loads, "seconds": seconds, "rows": as_json(rows)}
        atomic_write_json(arguments.out, figures)
        print(arguments.out)


if __name__ == "__main__":
    main()
