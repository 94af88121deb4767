"""Milliseconds per action chunk of exported students: sizes, units, threads, against the same policy in JAX.

    python -m benchmarks.export_latency

Random parameters (speed does not depend on their values), frames of 320 x 180, one inference at a time.
Prints wall p50 and p99 and processor time of the file on --threads (1, as a robot has it), and the ratio of
JAX's wall p50, on all cores, to the file's: taken in turns, so that other work slows both.
"""

import argparse
import time
from collections.abc import Callable
from dataclasses import replace

import jax
import numpy as np

from benchmarks.compare import seconds_in_turns
from ddgrasp import policy_metadata as metadata
from ddgrasp.config import ExportConfig, StudentConfig, WorldConfig
from ddgrasp.onnx_runtime import ort
from export import graph, parity
from student_jax import policy

PROFILE = WorldConfig().profile
DEFAULT = StudentConfig()
STUDENTS = {
    "default": DEFAULT,
    "default, 4 DDIM steps": replace(DEFAULT, head=replace(DEFAULT.head, ddim_steps=4)),
    "ResNet-18, width 16, stride 16": replace(
        DEFAULT,
        encoder=replace(DEFAULT.encoder, stage_blocks=(2, 2, 2, 2), output_stride=16),
    ),
    "ResNet-18, width 64, conv7 (paper)": replace(
        DEFAULT,
        encoder=replace(DEFAULT.encoder, stage_blocks=(2, 2, 2, 2), output_stride=16, width=64, stem="conv7"),
    ),
}


def jax_over_file(
    act: Callable[[parity.Inputs], object], session: ort.InferenceSession, inputs: parity.Inputs, runs: int
) -> float:
    """Median wall time of the compiled JAX policy over the file's."""
    act(inputs)
    runners = {"jax": lambda: act(inputs), "file": lambda: parity.run_onnx(session, inputs)}
    medians = {name: np.median(times) for name, times in seconds_in_turns(runners, runs).items()}
    return float(medians["jax"] / medians["file"])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--runs", type=int, default=100)
    parser.add_argument("--threads", type=int, default=1)
    arguments = parser.parse_args()
    rng, options = np.random.default_rng(0), ExportConfig()
    print(f"{'student':36s} {'MB':>6s} {'p50 ms':>7s} {'p99 ms':>7s} {'cpu ms':>7s} {'JAX / ONNX':>10s}")
    for name, student in STUDENTS.items():
        params = policy.init_params(jax.random.key(0), student, PROFILE)
        described = metadata.describe(student, options, PROFILE)
        model = graph.build_model(params, student, options, PROFILE, described).SerializeToString()
        session = parity.open_session(model, arguments.threads)
        inputs = parity.random_inputs(rng, 1, student, PROFILE, options.depth_dtype)
        cpu = time.process_time()
        wall = parity.latency_ms(session, inputs, arguments.runs)
        cpu_ms = 1e3 * (time.process_time() - cpu) / (arguments.runs + parity.WARM_UP_RUNS)
        ratio = jax_over_file(parity.jax_policy(params, student, PROFILE), session, inputs, arguments.runs)
        size = len(model) / 1e6
        print(f"{name:36s} {size:6.1f} {wall['p50']:7.2f} {wall['p99']:7.2f} {cpu_ms:7.2f} {ratio:10.1f}")


if __name__ == "__main__":
    main()
