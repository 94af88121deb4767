"""What a run of a preset costs by XLA's own count, and what an accelerator would need for it.

    python -m benchmarks.costs [--preset paper] [--share 0.4] [--compile]

A row per kind of step: how often a run takes it, floating-point operations and bytes of one, and the time of
all on an NVIDIA H100 at 40 % of its peaks, of arithmetic and of memory traffic. The sums are the plan for a
run, to be checked against the first GPU: none has run it.

XLA counts the body of a loop once; where its length is known (substeps, steps of a sampler, chunks of a
picture) it is multiplied in. The contact solver's loops are not: physics costs more than this says. Bytes are
counted before operations are fused, far more than a GPU moves; with --compile networks' are those of the
program compiled for this machine's CPU, which takes minutes. So the time by memory is an upper bound, and
stands in a column of its own.
"""

import argparse
import math
from collections.abc import Iterator
from dataclasses import dataclass

import jax

from benchmarks.command import one_line
from benchmarks.programs import PROGRAMS, lower
from ddgrasp import contract
from ddgrasp.config import Config
from ddgrasp.presets import get_preset
from mjx_envs import inverse_kinematics
from mjx_envs.render import raycast
from student_jax.data import LEAD_IN, kept_of_a_demo

TENSOR_FLOPS = 494.7e12
"""H100 SXM, TF32 without sparsity: what XLA uses for float32 products and convolutions by default (NVIDIA's
H100 data sheet: 989 with sparsity)."""
VECTOR_FLOPS = 66.9e12
"""The same, float32 outside of the tensor cores: physics and rendering (NVIDIA H100 data sheet)."""
BYTES_PER_S = 3.35e12
"""The same, memory (NVIDIA H100 data sheet)."""


@dataclass(frozen=True)
class Row:
    """One kind of step of a run."""

    stage: str
    program: str
    """Of `benchmarks.programs.PROGRAMS`."""
    calls: float
    """In a run of the preset."""
    loops: int = 1
    """Turns of the loop that the program consists of."""
    tensor: bool = True
    """Its arithmetic is products and convolutions."""


@dataclass(frozen=True)
class Cost:
    """Of one call."""

    flops: float
    bytes: float

    def seconds(self, row: Row, share: float) -> tuple[float, float]:
        """(by arithmetic, by memory traffic) of all calls at `share` of an H100's peaks."""
        peak = TENSOR_FLOPS if row.tensor else VECTOR_FLOPS
        return row.calls * self.flops / (share * peak), row.calls * self.bytes / (share * BYTES_PER_S)


def rows(config: Config) -> Iterator[Row]:
    """What a run of `config` consists of; episodes count as whole, every attempt at a demo as a success.

    Not counted: physics of the teacher's evaluations, of poses, DAgger and the student's trials, whose
    batches are smaller than PPO's.
    """
    teacher, demos, ddg, student = config.teacher, config.demos, config.ddg, config.student
    length = config.world.episode_steps
    substeps = round(contract.CONTROL_DT_S / config.world.sim_dt_s)
    yield Row("teacher", "control step", teacher.total_steps / teacher.num_envs, substeps, tensor=False)
    iterations = teacher.total_steps / (teacher.num_envs * teacher.unroll_steps)
    yield Row("teacher", "PPO: new episodes", iterations, inverse_kinematics.ITERATIONS, tensor=False)
    yield Row("teacher", "PPO: gradient steps", iterations, teacher.epochs * teacher.minibatches)

    steps = math.ceil(demos.episodes / demos.parallel) * length
    chunks = raycast.chunk_count(config.world.profile.height_px * config.world.profile.width_px)
    yield Row("demos", "demo rollout: advance", steps, substeps, tensor=False)
    yield Row("demos", "rendering: depth", steps, chunks, tensor=False)
    if demos.rgb:
        yield Row("demos", "rendering: colour", steps, chunks, tensor=False)

    yield Row("ddg", "generator: train step", ddg.training.steps)
    stretch, live = student.training.demo_stretch_steps, student.dagger.rounds * student.dagger.episodes
    seen = min(length, stretch + LEAD_IN) if stretch else length
    drawn = demos.episodes * (1 - student.training.clean_share) * seen
    drawn += (live + config.evaluation.student_trials) * length
    yield Row(
        "student", f"sampler: {ddg.sampling.sampler}", drawn / ddg.sampling.batch_size, ddg.sampling.steps
    )

    rendered = live + 2 * config.evaluation.student_trials
    yield Row("student", "rendering: depth", rendered * length / demos.parallel, chunks, tensor=False)
    fitted = student.training.steps + student.dagger.rounds * student.dagger.steps
    yield Row("student", "student: train step", fitted)
    frames = demos.episodes * kept_of_a_demo(student, length) + live * length
    yield Row("student", "student: features", frames / student.training.batch_size)
    yield Row("student", "student: DAgger acting", student.dagger.rounds * length)
    poses = student.poses.rounds * student.poses.steps
    yield Row("student", "student: head step", student.head.train_steps + poses)


def price(config: Config, row: Row, compiled: bool) -> Cost:
    """XLA's count for one call of the row's program, as it is lowered for NVIDIA GPUs."""
    program = PROGRAMS[row.program](config)
    counted = moved = lower(program, "cuda").cost_analysis() or {}
    if compiled and row.tensor:
        moved = lower(program, jax.default_backend()).compile().cost_analysis() or {}
    return Cost(row.loops * counted.get("flops", 0.0), row.loops * moved.get("bytes accessed", 0.0))


@one_line
def main() -> None:
    """Prints a table of rows, sums per stage, and the whole."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--preset", default="paper")
    parser.add_argument("--share", type=float, default=0.4, help="of the peaks that is reached")
    parser.add_argument("--compile", action="store_true", help="bytes of the compiled programs")
    args = parser.parse_args()
    config = get_preset(args.preset)
    print("| stage | step | calls | TFLOP a call | GB a call | s by arithmetic | s by memory |")
    print("|---|---|---|---|---|---|---|", flush=True)
    sums: dict[str, list[float]] = {}
    for row in rows(config):
        cost = price(config, row, args.compile)
        arithmetic, traffic = cost.seconds(row, args.share)
        numbers = f"{cost.flops / 1e12:.3g} | {cost.bytes / 1e9:.3g} | {arithmetic:.3g} | {traffic:.3g}"
        print(f"| {row.stage} | {row.program} | {row.calls:,.0f} | {numbers} |", flush=True)
        total = sums.setdefault(row.stage, [0.0, 0.0])
        sums[row.stage] = [total[0] + arithmetic, total[1] + traffic]
    sums["all"] = [sum(column) for column in zip(*sums.values(), strict=True)]
    for stage, (arithmetic, traffic) in sums.items():
        print(f"| {stage} | | | | | {arithmetic:.3g} | {traffic:.3g} |")


if __name__ == "__main__":
    main()
