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
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from benchmarks.gpu_sizes import SIZES, Sizes, only
from ddgrasp import artifacts, contract
from ddgrasp.config import Backend, TeacherConfig, WorldConfig
from ddgrasp.files import atomic_write_json, read_json, user_cache
from ddgrasp.machine import describe
from ddgrasp.progress import Progress

TOTAL_S = 1190.0
NO_GPU, FOUND = 3, 4
"""Exit status of a section without the GPU asked for, of one that ends with errors; a crash has another."""
SUCCESS_AIM = 0.95
BACKENDS = ("warp", "jax", "cpu")

Save = Callable[..., None]
"""save(name=value, ...) adds measurements to the section's file."""


# --- sections -------------------------------------------------------------------------------------


def machine(sizes: Sizes, save: Save) -> Iterator[str]:
    """Devices and versions."""
    del sizes
    save(devices=_devices(), versions=artifacts.library_versions(), **describe())
    yield from ()


def conformance(sizes: Sizes, save: Save) -> Iterator[str]:
    """The experiments of `mjx_envs.physics.conformance` on each backend; their violations."""
    from mjx_envs.physics import backends
    from mjx_envs.physics import conformance as experiments

    for name in sizes.physics:
        start = time.monotonic()
        try:
            step = experiments.make_step(backends.make_physics(name, experiments.SIM_DT_S))
            measures = experiments.measure(step)
        except Exception as error:  # the next one may run
            yield _failed(name, error)
            continue
        save(**{name: measures | {"seconds": time.monotonic() - start}})
        yield from experiments.violations(name, measures)


def pictures(sizes: Sizes, save: Save) -> Iterator[str]:
    """Each renderer against the ray caster in NumPy and against OpenGL; says so where there is none."""
    import jax

    from mjx_envs.render import batch_render, render_check

    scenes = render_check.random_scenes(sizes.scenes)
    drawn = {}
    for name in sizes.renderers:
        try:
            renderer = batch_render.make_renderer(name, scenes.camera)
            drawn[name] = jax.device_get(jax.jit(renderer)(scenes.geoms, scenes.T_world_cam))
        except Exception as error:  # the next one may draw
            yield _failed(name, error)
    references = {"numpy": render_check.draw_with_numpy, "opengl": render_check.draw_with_open_gl}
    for against, draw in references.items():
        try:
            expected = draw(scenes)
        except Exception as error:  # the back ends of OpenGL raise whatever their loaders do
            yield _failed(against, error)
            continue
        for name, seen in drawn.items():
            measures = render_check.compare(seen, expected)
            save(**{f"{name}_{against}": measures})
            yield from (f"{name} against {against}: {line}" for line in render_check.violations(measures))


def frames(sizes: Sizes, save: Save) -> Iterator[str]:
    """Depth frames/s of each renderer by picture size, many scenes a call."""
    import jax
    import numpy as np

    from mjx_envs.render import batch_render, render_check

    scenes = render_check.random_scenes(12)
    for side in sizes.frame_sizes_px:
        count = min(4096, sizes.frame_pixels // side**2)
        which = np.arange(count) % 12
        repeated = jax.tree.map(lambda x, which=which: x[which], (scenes.geoms, scenes.T_world_cam))
        geoms, T = jax.device_put(repeated)
        scale = side / scenes.camera.height_px
        camera = replace(
            scenes.camera, fx_px=scenes.camera.fx_px * scale, fy_px=scenes.camera.fy_px * scale,
            cx_px=side / 2, cy_px=side / 2, height_px=side, width_px=side,
        )  # fmt: skip
        for name in sizes.renderers:
            try:
                draw = jax.jit(batch_render.make_renderer(name, camera, depth_only=True))
                seconds = _seconds(lambda draw=draw, geoms=geoms, T=T: draw(geoms, T))
            except Exception as error:  # the next one may draw
                yield _failed(f"{name}, {side} px", error)
                continue
            save(**{f"{name}_{side}px": {"scenes": count, "frames_per_s": count / seconds}})


def env_steps(sizes: Sizes, save: Save) -> Iterator[str]:
    """Control steps/s of the whole environment, random actions, episodes restarting at starts drawn before:
    drawing new ones (`AutoReset.refresh`, once an episode where a teacher trains) is not in the rate."""
    substeps = round(contract.CONTROL_DT_S / WorldConfig().sim_dt_s)
    for name, count in _in_turn({name: sizes.env_counts[name] for name in sizes.physics}):
        try:
            rate = _control_steps_per_s(name, count, sizes.control_steps)
        except Exception as error:  # the next one may run
            yield _failed(f"{name}, {count} environments", error)
            continue
        save(**{f"{name}_{count}": {"env_steps_per_s": rate, "physics_steps_per_s": rate * substeps}})


def _in_turn(counts: Mapping[Backend, Sequence[int]]) -> Iterator[tuple[Backend, int]]:
    """The first count of every backend, then the second, and so on."""
    for i in range(max(map(len, counts.values()))):
        for name, values in counts.items():
            if i < len(values):
                yield name, values[i]


def _control_steps_per_s(backend: Backend, count: int, steps: int) -> float:
    import jax

    from mjx_envs.grasp_env import AutoReset, GraspEnv

    env = AutoReset(GraspEnv(WorldConfig(objects=contract.SEEN_OBJECTS, backend=backend)))

    @jax.jit
    def roll(state, key):
        def step(state, key):
            action = jax.random.uniform(key, (count, contract.ACTION_SIZE), minval=-1.0)
            return env.step(state, action), None

        return jax.lax.scan(step, state, jax.random.split(key, steps))[0]

    state = jax.jit(env.reset)(jax.random.split(jax.random.PRNGKey(0), count))
    return count * steps / _seconds(lambda: roll(state, jax.random.PRNGKey(1)))


def training(sizes: Sizes, save: Save) -> Iterator[str]:
    """Training steps/s and frames/s of generator and student, batches on the device."""
    from benchmarks import training_speed
    from ddgrasp.presets import get_preset

    config = get_preset(sizes.preset)
    for name, measure in (("student", training_speed.student), ("generator", training_speed.generator)):
        save(preset=sizes.preset, **{name: measure(config, sizes.training_steps)})
    yield from ()


def ppo_from_guide(sizes: Sizes, save: Save) -> Iterator[str]:
    """PPO of a policy that was cloned from the scripted guide first, as preset laptop does it."""
    yield from _teacher(sizes, save, guided(sizes))


def ppo_from_nothing(sizes: Sizes, save: Save) -> Iterator[str]:
    """PPO of a policy that starts at random: no guide, no checkpoint; otherwise as in preset paper."""
    yield from _teacher(sizes, save, unguided(sizes))


def guided(sizes: Sizes) -> TeacherConfig:
    """The teacher of section `ppo_from_guide`."""
    from ddgrasp.presets import LAPTOP

    return replace(LAPTOP.teacher, **sizes.teacher)


def unguided(sizes: Sizes) -> TeacherConfig:
    """The teacher of section `ppo_from_nothing`."""
    from ddgrasp.presets import PAPER

    return replace(PAPER.teacher, **sizes.teacher)


def _teacher(sizes: Sizes, save: Save, teacher: TeacherConfig) -> Iterator[str]:
    """On the first backend that can train; the others are errors."""
    save(start=teacher.start, num_envs=teacher.num_envs)
    for backend in sizes.physics:
        save(backend=backend)
        try:
            reached = _train(sizes, save, teacher, backend)
        except Exception as error:  # the next one may train
            yield _failed(backend, error)
            continue
        if sizes.on_gpu and not reached:
            yield f"the teacher ended below {SUCCESS_AIM:.0%}"
        return


def _train(sizes: Sizes, save: Save, teacher: TeacherConfig, backend: Backend) -> bool:
    """Whether an evaluation after PPO began reached SUCCESS_AIM; wall time, cloning and compilation too."""
    from ddgrasp.presets import LAPTOP
    from ppo.train import train

    world = WorldConfig(objects=contract.SEEN_OBJECTS, backend=backend)
    evaluation = replace(LAPTOP.evaluation, teacher_trials=sizes.evaluations)
    config = replace(LAPTOP, world=world, teacher=teacher, evaluation=evaluation)
    evaluations: list[dict[str, float]] = []
    start = time.monotonic()

    class Watch(Progress):
        """Keeps the evaluations, and ends the training once the aim is reached."""

        def scalars(self, step: int, **values: Any) -> None:
            if "eval_success" not in values:
                return
            seconds = time.monotonic() - start
            evaluations.append({"iteration": step, "success": values["eval_success"], "seconds": seconds})
            save(evaluations=evaluations)
            if step and values["eval_success"] >= SUCCESS_AIM:  # before the first step it is the clone's
                save(seconds_to_95_percent=seconds)
                raise _Reached

    with tempfile.TemporaryDirectory() as directory:
        try:
            train(config, Path(directory), Watch(name="teacher"))
        except _Reached:
            return True
    return False


class _Reached(Exception):
    """The aim of the sections that train a teacher."""


SECTIONS: dict[str, tuple[Callable[[Sizes, Save], Iterator[str]], float]] = {
    "machine": (machine, 40.0),
    "conformance": (conformance, 150.0),
    "pictures": (pictures, 90.0),
    "frames": (frames, 120.0),
    "env_steps": (env_steps, 300.0),
    "training": (training, 240.0),
    "ppo_from_guide": (ppo_from_guide, 180.0),
    "ppo_from_nothing": (ppo_from_nothing, 360.0),
}
"""Name -> (function, seconds it may take). All together may take TOTAL_S: where all before used theirs, the
last one has less. Most of it is compilation: MJX-JAX with 8,192 environments took over 80 s on an H200."""


# --- the command ----------------------------------------------------------------------------------


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


def _devices() -> list[str]:
    import jax

    return [f"{device.platform}: {device.device_kind}" for device in jax.devices()]


def _check_gpu() -> None:
    kinds = _devices()
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


def _failed(what: str, error: Exception) -> str:
    """One line."""
    return f"{what}: {type(error).__name__}: {' '.join(str(error).split())[:500]}"


def _seconds(function: Callable[[], Any], repeats: int = 5) -> float:
    """Least wall time of `repeats` calls, after one that compiles."""
    import jax

    jax.block_until_ready(function())
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        jax.block_until_ready(function())
        times.append(time.perf_counter() - start)
    return min(times)


if __name__ == "__main__":
    main()
