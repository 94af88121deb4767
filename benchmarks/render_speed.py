"""Frames per second of the project's ray casters against MuJoCo's OpenGL renderer, on the same scenes."""

import contextlib
import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import jax
import mujoco
import numpy as np

from benchmarks.compare import Contender, Row, compare, measure
from ddgrasp import contract
from ddgrasp.config import Config
from ddgrasp.layout import QPOS
from mjx_envs import randomize, scene
from mjx_envs.camera import Camera, nominal_camera
from mjx_envs.render import raycast, raycast_numpy

SIZES = ((180, 320), (64, 64))
"""(rows, columns) of the pictures."""
TARGETS = (1.0, 5.0)
"""Depth frames/s of the JAX ray caster over OpenGL's, at each size."""
SCENES = 16
MEDIAN_ERROR_M = 0.001
"""Depths of the two must agree within this in the median for their speeds to be compared."""


def render_rows(config: Config, rounds: int) -> tuple[list[Row], str]:
    """One row per kind of picture and size; and why there is no OpenGL, if there is none.

    With RGB the ray casters draw segmentation and normals besides.
    """
    model, scenes = random_scenes(config)
    rows, trouble = [], ""
    for (height, width), target in zip(SIZES, TARGETS, strict=True):
        camera = camera_of(config, height, width)
        contenders = ray_casters(model, scenes, camera)
        with contextlib.ExitStack() as stack:
            try:
                contenders |= open_gl(stack, model, scenes, camera)
            except Exception as error:  # the back ends raise whatever their loaders do
                trouble = f"{type(error).__name__}: {error}"
            rates = measure(contenders, rounds)
        size = f"{width}x{height}"
        for picture in ("depth", "depth and RGB"):
            goal = target if picture == "depth" else None
            for caster in ("JAX", "NumPy"):
                ours, peer = f"{caster} ray caster, {picture}", f"MuJoCo OpenGL, {picture}"
                goal = goal if caster == "JAX" else None
                row = compare(rates, f"{picture} at {size}", "frames/s", ours, peer, target=goal)
                rows.append(replace(row, ours=f"{caster} ray caster", peer="MuJoCo OpenGL"))
    return rows, trouble


def random_scenes(config: Config) -> tuple[mujoco.MjModel, list[mujoco.MjData]]:
    """The configured scene, a cube in its slots, with SCENES poses of arm and object."""
    table = randomize.ObjectTable(config.world.objects)
    model = scene.build_model(config.world.sim_dt_s, table.layout)
    rng = np.random.default_rng(0)
    scenes = []
    half = np.array(contract.WORKSPACE_SIZE_M) / 2
    for _ in range(SCENES):
        data = mujoco.MjData(model)
        data.qpos[QPOS.arm] = np.array(contract.HOME_RAD) + 0.3 * rng.uniform(-1, 1, scene.N_ARM)
        data.qpos[QPOS.object_pos][:2] = np.array(contract.WORKSPACE_CENTER_M) + half * rng.uniform(-1, 1, 2)
        mujoco.mj_forward(model, data)
        scenes.append(data)
    return model, scenes


def camera_of(config: Config, height_px: int, width_px: int) -> Camera:
    """The nominal camera's view with this many pixels, its axis in the middle."""
    camera = nominal_camera(config.world.profile)
    scale = width_px / camera.width_px
    return replace(
        camera, fx_px=camera.fx_px * scale, fy_px=camera.fy_px * scale,
        cx_px=width_px / 2, cy_px=height_px / 2, height_px=height_px, width_px=width_px,
    )  # fmt: skip


def ray_casters(
    model: mujoco.MjModel, scenes: Sequence[mujoco.MjData], camera: Camera
) -> dict[str, Contender]:
    """The JAX one on all scenes in a call, as the stages use it (`Viewer`); the NumPy one in a loop."""
    posed = [raycast.Geoms.of_model(model, data.geom_xpos, data.geom_xmat) for data in scenes]
    geoms = jax.tree.map(lambda *leaves: np.stack(leaves), *posed)

    def jitted(draw: Callable) -> Callable[[], object]:
        drawn = jax.jit(lambda g: jax.lax.map(lambda one: draw(one, camera), g))
        return lambda: jax.block_until_ready(drawn(geoms))

    def looped(draw: Callable) -> Callable[[], object]:
        return lambda: [draw(model, data, camera) for data in scenes]

    runs = {
        "JAX ray caster, depth": jitted(raycast.render_depth),
        "JAX ray caster, depth and RGB": jitted(raycast.render),
        "NumPy ray caster, depth": looped(raycast_numpy.render_depth),
        "NumPy ray caster, depth and RGB": looped(raycast_numpy.render),
    }
    return {name: Contender(run, len(scenes)) for name, run in runs.items()}


def open_gl(
    stack: contextlib.ExitStack, model: mujoco.MjModel, scenes: Sequence[mujoco.MjData], camera: Camera
) -> dict[str, Contender]:
    """MuJoCo's renderer on the scenes, without the shadows and reflections that the ray casters lack.

    `stack` closes it: a second one next to it draws nothing. Raises what its back end raises where there is
    none, and RuntimeError if it draws other depth than the ray caster.
    """
    model.vis.quality.offsamples = 0  # samples between pixels, which the ray casters lack too
    model.vis.global_.fovy = math.degrees(2 * math.atan(camera.height_px / 2 / camera.fy_px))
    renderer = stack.enter_context(mujoco.Renderer(model, camera.height_px, camera.width_px))
    for flag in (mujoco.mjtRndFlag.mjRND_SHADOW, mujoco.mjtRndFlag.mjRND_REFLECTION):
        renderer.scene.flags[flag] = 0
    view = _free_camera()
    _check_depth(renderer, model, scenes[0], camera, view)

    def depth() -> None:
        renderer.enable_depth_rendering()
        for data in scenes:
            renderer.update_scene(data, view)
            renderer.render()
        renderer.disable_depth_rendering()

    def everything() -> None:
        for data in scenes:
            renderer.update_scene(data, view)
            renderer.render()
            renderer.enable_depth_rendering()
            renderer.render()
            renderer.disable_depth_rendering()

    runs = {"MuJoCo OpenGL, depth": depth, "MuJoCo OpenGL, depth and RGB": everything}
    return {name: Contender(run, len(scenes)) for name, run in runs.items()}


def _check_depth(
    renderer: mujoco.Renderer, model: mujoco.MjModel, data: mujoco.MjData, camera: Camera, view: Any
) -> None:
    renderer.enable_depth_rendering()
    renderer.update_scene(data, view)
    depth = renderer.render()
    renderer.disable_depth_rendering()
    cast = raycast_numpy.render_depth(model, data, camera)
    off_m = np.median(np.abs(depth - cast)[cast > 0])
    if off_m > MEDIAN_ERROR_M:
        raise RuntimeError(f"its depth differs by {1000 * off_m:.1f} mm in the median")


def _free_camera() -> mujoco.MjvCamera:
    """MuJoCo's camera at the contract's place."""
    view = mujoco.MjvCamera()
    towards = np.subtract(contract.CAMERA_LOOK_AT_M, contract.CAMERA_POSITION_M)
    view.lookat = contract.CAMERA_LOOK_AT_M
    view.distance = np.linalg.norm(towards)
    view.azimuth = math.degrees(math.atan2(towards[1], towards[0]))
    view.elevation = math.degrees(math.asin(towards[2] / view.distance))
    return view
