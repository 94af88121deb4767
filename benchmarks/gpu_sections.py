"""The sections of `benchmarks.gpu_check`: each saves figures as it goes and yields what is wrong."""

import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from benchmarks.gpu_sizes import Sizes
from ddgrasp import artifacts, contract
from ddgrasp.config import Backend, TeacherConfig, WorldConfig
from ddgrasp.machine import describe
from ddgrasp.progress import Progress

SUCCESS_AIM = 0.95

Save = Callable[..., None]
"""save(name=value, ...) adds measurements to the section's file."""


def machine(sizes: Sizes, save: Save) -> Iterator[str]:
    """Devices and versions."""
    del sizes
    save(devices=devices(), versions=artifacts.library_versions(), **describe())
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


def devices() -> list[str]:
    """Platform and kind of each that JAX has."""
    import jax

    return [f"{device.platform}: {device.device_kind}" for device in jax.devices()]


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
"""Name -> (function, seconds it may take). All together may take `gpu_check.TOTAL_S`: where all before used
theirs, the last one has less. Most of it is compilation: MJX-JAX with 8,192 environments took over 80 s on an
H200."""
