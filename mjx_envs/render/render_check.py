"""Random scenes with all objects, drawn by MuJoCo's OpenGL renderer or in NumPy, and how close ours come."""

import dataclasses
from collections.abc import Iterator, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from scipy import ndimage

from ddgrasp import contract
from ddgrasp.config import RandomConfig
from ddgrasp.layout import QPOS
from mjx_envs import randomize, scene
from mjx_envs.camera import Camera, nominal_camera
from mjx_envs.objects import OBJECTS
from mjx_envs.render import raycast_numpy
from mjx_envs.render.batch_render import Pictures
from mjx_envs.render.raycast import Geoms
from mjx_envs.render.visible_geoms import AMBIENT, LIGHT_DIRECTION_W
from mjx_envs.render.visual import Viewer

LIMITS: Mapping[str, float] = {
    "median_depth_error_m": 1e-3,
    "depth_off_by_5_mm": 0.005,
    "other_geom": 0.005,
    "mean_colour_error": 0.02,
    "edge_pixels": 0.2,
}
"""Largest values: median; shares of the pixels away from edges; mean over them, of 1; share of all pixels."""

_FAR_M, _OFF_M = 2.0, 0.005


@dataclasses.dataclass(frozen=True)
class Scenes:
    """B states of the grasping scene and the cameras that see them."""

    table: randomize.ObjectTable
    index: np.ndarray
    """(B,) of the object in `table`."""
    params: Any
    """`ModelParams` with a leading B."""
    qpos: np.ndarray
    """(B, 16)."""
    camera: Camera
    """Intrinsics; its pose is not read."""
    T_world_cam: np.ndarray
    """(B, 4, 4)."""
    geoms: Geoms
    """What the renderers draw, leading B."""


def random_scenes(count: int, seed: int = 0, camera_scale: float = 0.25) -> Scenes:
    """Objects in turn, in random poses (upside down too), sizes and places; joints and cameras random."""
    table = randomize.ObjectTable(tuple(OBJECTS))
    viewer = Viewer(contract.D455.scaled(camera_scale), table.layout)
    config = RandomConfig(joint_rad=0.4, camera_position_m=0.05, camera_angle_rad=0.05)
    index = jnp.arange(count) % len(table.names)
    keys = jax.random.split(jax.random.PRNGKey(seed), (count, 4))

    def draw(key, index):
        params, size = randomize.sample_params(key[0], config, table, index)
        qpos = randomize.sample_qpos(key[1], config, jnp.asarray(table.rest_height)[index] * size)
        quat = jax.random.normal(key[2], (4,))
        qpos = (
            qpos.at[QPOS.object_pos.stop - 1].add(0.05).at[QPOS.object_quat].set(quat / jnp.linalg.norm(quat))
        )
        T = randomize.sample_camera(key[3], config, viewer.nominal_pose)
        return params, qpos, T, viewer.geoms(qpos, params, jnp.asarray(table.rgb, jnp.float32)[index])

    params, qpos, T, geoms = jax.jit(jax.vmap(draw))(keys, index)
    camera = nominal_camera(viewer.profile)
    return Scenes(table, np.asarray(index), params, np.asarray(qpos), camera, np.asarray(T), geoms)


def draw_with_open_gl(scenes: Scenes, make_renderer: Any = mujoco.Renderer) -> Pictures:
    """The scenes as MuJoCo draws them, under the ray caster's light; depth is not limited by distance.

    Raises whatever the OpenGL back end raises where there is none.
    """
    model = _lit_model(scenes)
    data = mujoco.MjData(model)
    pictures = []
    with make_renderer(model, scenes.camera.height_px, scenes.camera.width_px) as renderer:
        for camera in _posed(model, data, scenes):
            pictures.append(_draw(renderer, data, camera))
    return Pictures(*(np.stack(buffer) for buffer in zip(*pictures, strict=True)))


def draw_with_numpy(scenes: Scenes) -> Pictures:
    """The scenes as the rigs draw them, on any machine; depth is not limited by distance."""
    model = _lit_model(scenes)
    data = mujoco.MjData(model)
    seen = [raycast_numpy.render(model, data, camera, np.inf) for camera in _posed(model, data, scenes)]
    return Pictures(*(np.stack(buffer) for buffer in zip(*(one[:3] for one in seen), strict=True)))


def compare(ours: Pictures, expected: Pictures) -> dict[str, float]:
    """The measures of `LIMITS`, over all scenes."""
    depth, wanted = np.asarray(ours.depth_m), expected.depth_m
    edges = np.stack([edges_of(picture) for picture in expected.segmentation])
    near = wanted < _FAR_M
    error = np.abs(depth - wanted)
    plain = near & ~edges
    return {
        "median_depth_error_m": float(np.median(error[near & (depth > 0)])),
        "depth_off_by_5_mm": float((error[plain] > _OFF_M).mean()),
        "other_geom": float((np.asarray(ours.segmentation) != expected.segmentation)[plain].mean()),
        "mean_colour_error": float(np.abs(np.asarray(ours.rgb) - expected.rgb)[plain].mean()),
        "edge_pixels": float(edges.mean()),
    }


def violations(measures: Mapping[str, float]) -> list[str]:
    """One line for each measure beyond its limit (or not a number)."""
    return [
        f"{name} is {measures[name]:.3g}, limit {limit:.3g}"
        for name, limit in LIMITS.items()
        if not measures[name] <= limit
    ]


def edges_of(segmentation: np.ndarray) -> np.ndarray:
    """(H, W) bool, pixels next to another geom: a rasteriser may decide them differently."""
    low, high = (f(segmentation, size=3) for f in (ndimage.minimum_filter, ndimage.maximum_filter))
    return low != high


def aim(renderer: mujoco.Renderer, data: mujoco.MjData, camera: Camera) -> None:
    """Makes the renderer's scene that of `data` seen by `camera`, given to OpenGL by forward and up."""
    renderer.update_scene(data)
    near = data.model.vis.map.znear * data.model.stat.extent
    for gl_camera in renderer.scene.camera:
        gl_camera.pos = camera.T_world_cam[:3, 3]
        gl_camera.forward = camera.T_world_cam[:3, 2]
        gl_camera.up = -camera.T_world_cam[:3, 1]
        gl_camera.frustum_top = near * camera.cy_px / camera.fy_px
        gl_camera.frustum_bottom = -near * (camera.height_px - camera.cy_px) / camera.fy_px
        gl_camera.frustum_center = 0
        gl_camera.frustum_width = near * camera.width_px / 2 / camera.fx_px


def _lit_model(scenes: Scenes) -> mujoco.MjModel:
    """Fine facets; one directional light as the ray caster has it; one sample a pixel, at its centre."""
    model = scene.build_model(layout=scenes.table.layout)
    model.vis.quality.offsamples = 0
    model.vis.quality.numslices = model.vis.quality.numstacks = 128
    model.vis.headlight.active = 0
    model.light_ambient[:], model.light_diffuse[:], model.light_specular[:] = AMBIENT, 1 - AMBIENT, 0
    model.light_dir[:] = [-c for c in LIGHT_DIRECTION_W]
    model.light_castshadow[:] = False
    return model


def _pose(model: mujoco.MjModel, data: mujoco.MjData, scenes: Scenes, i: int) -> None:
    slots = scene.slot_ids(model)
    model.geom_size[slots] = scenes.params.slot_size[i]
    model.geom_pos[slots] = scenes.params.slot_pos[i]
    model.geom_quat[slots] = scenes.params.slot_quat[i]
    model.geom_rgba[slots, :3] = scenes.table.rgb[scenes.index[i]]
    data.qpos[:] = scenes.qpos[i]
    mujoco.mj_forward(model, data)


def _posed(model: mujoco.MjModel, data: mujoco.MjData, scenes: Scenes) -> Iterator[Camera]:
    """Sets up scene after scene; yields the camera of each."""
    for i in range(len(scenes.index)):
        _pose(model, data, scenes, i)
        yield dataclasses.replace(scenes.camera, T_world_cam=scenes.T_world_cam[i])


def _draw(renderer: mujoco.Renderer, data: mujoco.MjData, camera: Camera) -> tuple[np.ndarray, ...]:
    """(depth, rgb, segmentation) of one scene."""
    aim(renderer, data, camera)
    rgb = renderer.render().astype(np.float32) / 255
    renderer.enable_depth_rendering()
    depth = renderer.render().copy()
    renderer.disable_depth_rendering()
    renderer.enable_segmentation_rendering()
    segmentation = renderer.render()[..., 0].copy()
    renderer.disable_segmentation_rendering()
    return depth, rgb, segmentation
