"""Frames per second of the project's ray casters against MuJoCo's OpenGL renderer, on the same scenes."""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import jax
import mujoco
import numpy as np

from benchmarks.compare import Contender, Row, compare, measure
from ddgrasp import contract
from ddgrasp.config import Config
from mjx_envs import randomize, raycast, raycast_numpy, scene
from mjx_envs.camera import Camera, nominal_camera

SIZES = ((180, 320), (64, 64))
"""(rows, columns) of the pictures."""
TARGETS = (1.0, 5.0)
"""Depth frames/s of the JAX ray caster over OpenGL's, at each size."""
SCENES = 16


def render_rows(config: Config, rounds: int) -> tuple[list[Row], str]:
    """One row per kind of picture and size; and why there is no OpenGL, if there is none.

    With RGB the ray casters draw segmentation and normals besides.
    """
    model, scenes = random_scenes(config)
    rows, trouble = [], ""
    for (height, width), target in zip(SIZES, TARGETS, strict=True):
        camera = camera_of(config, height, width)
        contenders = ray_casters(model, scenes, camera)
        try:
            renderers = open_gl(model, scenes, camera)
        except Exception as error:  # the back ends raise whatever their loaders do
            renderers, trouble = {}, f"{type(error).__name__}: {error}"
        rates = measure(contenders | renderers, rounds)
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
        data.qpos[: scene.N_ARM] = np.array(scene.HOME_RAD) + 0.3 * rng.uniform(-1, 1, scene.N_ARM)
        data.qpos[9:11] = np.array(contract.WORKSPACE_CENTER_M) + half * rng.uniform(-1, 1, 2)
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


def open_gl(model: mujoco.MjModel, scenes: Sequence[mujoco.MjData], camera: Camera) -> dict[str, Contender]:
    """MuJoCo's renderer on the scenes; raises what its back end raises where there is none."""
    model.vis.global_.fovy = math.degrees(2 * math.atan(camera.height_px / 2 / camera.fy_px))
    renderer = mujoco.Renderer(model, camera.height_px, camera.width_px)
    view = _free_camera()

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


def _free_camera() -> mujoco.MjvCamera:
    """MuJoCo's camera at the contract's place."""
    view = mujoco.MjvCamera()
    towards = np.subtract(contract.CAMERA_LOOK_AT_M, contract.CAMERA_POSITION_M)
    view.lookat = contract.CAMERA_LOOK_AT_M
    view.distance = np.linalg.norm(towards)
    view.azimuth = math.degrees(math.atan2(towards[1], towards[0]))
    view.elevation = math.degrees(math.asin(towards[2] / view.distance))
    return view
