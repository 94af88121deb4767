"""Milliseconds per frame of the two ray casters and of MuJoCo's OpenGL renderer, in one run.

    MUJOCO_GL=egl python -m benchmarks.raycast

Prints processor time (all threads) and wall time, median of the repetitions; ratios are to
OpenGL's wall time for the same picture, and say so if no OpenGL context can be made.
"""

import argparse
import dataclasses
import time
from collections.abc import Callable

import mujoco
import numpy as np

from ddgrasp.config import WorldConfig
from mjx_envs import raycast_numpy, scene
from mjx_envs.camera import Camera, nominal_camera
from mjx_envs.visible_geoms import visible_geoms

SIZES = ((180, 320), (64, 64))


def median_ms(function: Callable[[], object], repeats: int) -> tuple[float, float]:
    """(wall, processor) median milliseconds of one call, after one that is not counted."""
    function()
    times = []
    for _ in range(repeats):
        wall, cpu = time.perf_counter(), time.process_time()
        function()
        times.append((time.perf_counter() - wall, time.process_time() - cpu))
    return tuple(1e3 * np.median(times, axis=0))


def home_scene() -> tuple[mujoco.MjModel, mujoco.MjData]:
    """The grasping scene with the arm at its home pose."""
    model = scene.build_model()
    data = mujoco.MjData(model)
    data.qpos[: scene.N_ARM] = scene.HOME_RAD
    mujoco.mj_forward(model, data)
    return model, data


def camera_of(height_px: int, width_px: int) -> Camera:
    """The nominal camera's view with this many pixels."""
    camera = nominal_camera(WorldConfig().profile)
    scale = width_px / camera.width_px
    return dataclasses.replace(
        camera, fx_px=camera.fx_px * scale, fy_px=camera.fy_px * scale,
        cx_px=width_px / 2, cy_px=height_px / 2, height_px=height_px, width_px=width_px,
    )  # fmt: skip


def contenders(
    model: mujoco.MjModel, data: mujoco.MjData, camera: Camera, batch: int
) -> dict[str, tuple[Callable[[], object], int]]:
    """Name -> (function, frames per call)."""
    import jax

    from mjx_envs import raycast

    geoms = raycast.Geoms.of_model(model, data.geom_xpos, data.geom_xmat)
    stacked = jax.tree.map(lambda a: np.broadcast_to(a, (batch, *a.shape)).copy(), (geoms, camera))
    ready = jax.block_until_ready
    batched = {
        "vmap": jax.jit(jax.vmap(raycast.render_depth)),
        "lax.map": jax.jit(lambda g, c: jax.lax.map(lambda a: raycast.render_depth(*a), (g, c))),
    }
    return {
        "JAX depth": (lambda: ready(raycast.render_depth(geoms, camera)), 1),
        "JAX all buffers": (lambda: ready(raycast.render(geoms, camera)), 1),
        **{
            f"JAX depth, {name} of {batch}": (lambda f=f: ready(f(*stacked)), batch)
            for name, f in batched.items()
        },
        "NumPy depth": (lambda: raycast_numpy.render_depth(model, data, camera), 1),
        "NumPy all buffers": (lambda: raycast_numpy.render(model, data, camera), 1),
    }


def open_gl_ms(model: mujoco.MjModel, data: mujoco.MjData, camera: Camera, repeats: int):
    """(wall, processor) ms of MuJoCo's renderer for depth, or the reason for having none."""
    try:
        renderer = mujoco.Renderer(model, camera.height_px, camera.width_px)
    except Exception as error:  # the back ends raise whatever their loaders do
        return f"none: {type(error).__name__}: {error}"
    with renderer:
        renderer.enable_depth_rendering()

        def frame() -> None:
            renderer.update_scene(data)
            renderer.render()

        return median_ms(frame, repeats)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--repeats", type=int, default=50)
    parser.add_argument("--batch", type=int, default=16)
    args = parser.parse_args()
    model, data = home_scene()
    print(f"{len(visible_geoms(model).ids)} visible geoms; ms per frame, median of {args.repeats}")
    print(f"{'':32}{'size':>10}{'wall':>9}{'processor':>11}{'OpenGL / this':>15}")
    for height, width in SIZES:
        camera = camera_of(height, width)
        reference = open_gl_ms(model, data, camera, args.repeats)
        if isinstance(reference, str):
            print(f"{'MuJoCo OpenGL depth':32}{reference}")
        else:
            print(_line("MuJoCo OpenGL depth", height, width, reference, reference))
        for name, (function, frames) in contenders(model, data, camera, args.batch).items():
            wall, cpu = median_ms(function, args.repeats if frames == 1 else args.repeats // 5)
            print(_line(name, height, width, (wall / frames, cpu / frames), reference), flush=True)


def _line(name: str, height: int, width: int, ms: tuple[float, float], reference) -> str:
    ratio = "-" if isinstance(reference, str) else f"{reference[0] / ms[0]:.2f}"
    return f"{name:32}{f'{width}x{height}':>10}{ms[0]:9.2f}{ms[1]:11.2f}{ratio:>15}"


if __name__ == "__main__":
    main()
