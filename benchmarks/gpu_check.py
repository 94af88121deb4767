"""What this project does on an NVIDIA GPU, in at most 20 minutes: one JSON of checks and throughputs.

    python -m benchmarks.gpu_check [--out runs/gpu_check.json] [--sections NAME ...] [--backends jax]

Conformance of the physics backends, pictures against other renderers', frames/s, environment
steps/s, training steps/s and frames/s of generator and student at the sizes of preset paper, and the time a
teacher takes to 95 % success: PPO from the guide (cloned first), and PPO from nothing. Each section is a
process of its own with a deadline; what it has measured so far is on disk after every figure, so that a
section cut off, or the whole command, leaves its results. A section that fails, is cut off, or finds a limit
exceeded is recorded under "errors", and the command ends with status 1. `--backends jax` is for a machine
without Warp; the teachers train on the first backend named that can. `--device cpu` runs the same sections at
sizes that mean nothing, to test the command where there is no GPU.
"""

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from benchmarks.gpu_sections import SECTIONS, devices
from benchmarks.gpu_sizes import SIZES, Sizes, only
from ddgrasp.files import atomic_write_json, read_json, user_cache

TOTAL_S = 1190.0
NO_GPU, FOUND = 3, 4
"""Exit status of a section without the GPU asked for, of one that ends with errors; a crash has another."""
BACKENDS = ("warp", "jax", "cpu")


def main() -> None:
    """Runs all sections; prints what failed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("runs/gpu_check.json"))
    parser.add_argument("--device", choices=sorted(SIZES), default="gpu")
    parser.add_argument("--sections", nargs="+", choices=SECTIONS, default=list(SECTIONS))
    parser.add_argument("--backends", nargs="+", choices=BACKENDS, default=[], help="of physics and pictures")
    parser.add_argument("--here", action="store_true", help="one section, in this process")
    args = parser.parse_args()
    sizes = only(SIZES[args.device], args.backends)
    if not sizes.physics or not sizes.renderers:
        parser.error(f"--device {args.device} has nothing to measure on {' '.join(args.backends)}")
    if args.here:
        sys.exit(run_section(args.sections[0], sizes, args.out))
    sys.exit(run_all(args.sections, args.device, args.out, args.backends))


def run_section(name: str, sizes: Sizes, out: Path) -> int:
    """One section in this process: {measurements..., "errors": [...]} in `out`. Returns the exit status.

    Ends the process in one line and with status NO_GPU where there is no GPU and `sizes` are for one.
    """
    if sizes.on_gpu:
        _check_gpu()
    result: dict[str, Any] = {"errors": []}

    def save(**values: Any) -> None:
        result.update(values)
        atomic_write_json(out, result)

    for error in SECTIONS[name][0](sizes, save):
        save(errors=[*result["errors"], error])
    save()
    return FOUND if result["errors"] else 0


def _check_gpu() -> None:
    kinds = devices()
    if not any(kind.startswith("gpu") for kind in kinds):
        print(
            f"gpu-check needs an NVIDIA GPU; JAX sees {', '.join(kinds)}. Install the GPU's packages with "
            "pip install -e '.[cuda,warp]', or try the command itself with --device cpu.",
            file=sys.stderr,
        )
        sys.exit(NO_GPU)


def run_all(sections: Sequence[str], device: str, out: Path, backends: Sequence[str] = ()) -> int:
    """Each section in a process of its own; writes `out` after each. Returns the exit status."""
    start, slack = time.monotonic(), SIZES[device].slack
    report: dict[str, Any] = {"device": device, "sections": list(sections), "complete": False}
    for name in sections:
        left = slack * TOTAL_S - (time.monotonic() - start)
        allowed = min(slack * SECTIONS[name][1], max(left, 1.0))
        report[name], status = _in_process(name, device, allowed, backends)
        if status == NO_GPU:
            return 2
        report |= {"seconds": time.monotonic() - start, "complete": name == sections[-1]}
        atomic_write_json(out, report)
        print(f"{name}: {report[name]['seconds']:.0f} s, {len(report[name]['errors'])} errors", flush=True)
    errors = [f"{name}: {error}" for name in sections for error in report[name]["errors"]]
    print("\n".join([str(out), *errors]))
    return 1 if errors else 0


def _in_process(
    name: str, device: str, allowed_s: float, backends: Sequence[str]
) -> tuple[dict[str, Any], int]:
    """({measurements..., "errors", "seconds"}, exit status) of a section; cut off after `allowed_s`."""
    start = time.monotonic()
    with tempfile.TemporaryDirectory() as directory:
        out, log = Path(directory) / "section.json", Path(directory) / "log"
        command = [sys.executable, "-m", "benchmarks.gpu_check", "--here", "--sections", name]
        command += ["--device", device, "--out", str(out)]
        command += ["--backends", *backends] if backends else []
        with open(log, "w") as stderr:
            try:
                status = subprocess.run(command, env=_environment(device), stderr=stderr, timeout=allowed_s)
                status = status.returncode
            except subprocess.TimeoutExpired:
                status = None
        said = log.read_text(errors="replace").strip()
        if status == NO_GPU:
            print(said.splitlines()[-1], file=sys.stderr)
        result = read_json(out) if out.exists() else {"errors": []}
    if status is None:
        result["errors"].append(f"cut off after {allowed_s:.0f} s")
    elif status not in (0, FOUND):
        result["errors"].append(f"exit status {status}: {' | '.join(said.splitlines()[-3:])}")
    return result | {"seconds": time.monotonic() - start}, status or 0


def _environment(device: str) -> dict[str, str]:
    """Warp allocates beside JAX, so JAX takes memory as it needs it. Programs are kept for the next call."""
    chosen = {"JAX_PLATFORMS": "cpu"} if device == "cpu" else {"XLA_PYTHON_CLIENT_PREALLOCATE": "false"}
    without_display = {"MUJOCO_GL": "egl"} if sys.platform == "linux" else {}
    kept = {"JAX_COMPILATION_CACHE_DIR": str(user_cache("jax"))}
    return kept | without_display | dict(os.environ) | chosen


if __name__ == "__main__":
    main()
