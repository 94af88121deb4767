"""Depth, colour and segmentation of a batch of scenes, by the JAX ray caster or by Warp's renderer.

Both draw the same primitives with the same light; Warp's is for NVIDIA GPUs. Held against MuJoCo's
OpenGL renderer by the tests and by `benchmarks/gpu_check.py`.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
from mujoco import mjx

from ddgrasp.config import RENDERERS
from ddgrasp.errors import unknown_name
from mjx_envs.camera import Camera
from mjx_envs.physics.mjx_warp import require_gpu
from mjx_envs.render import raycast
from mjx_envs.render.raycast import Geoms
from mjx_envs.render.visible_geoms import AMBIENT, BACKGROUND_RGB, LIGHT_DIRECTION_W


class Pictures(NamedTuple):
    """What a camera sees of B scenes; NumPy or JAX arrays."""

    depth_m: Any
    """(B, H, W) float32 planar depth, metres; 0 where nothing is hit within the far limit."""
    rgb: Any
    """(B, H, W, 3) float32 in [0, 1], shaded; None of a renderer for depth alone."""
    segmentation: Any
    """(B, H, W) int32 geom id of the model, -1 where nothing is hit; None of a renderer for depth alone."""


Renderer = Callable[[Geoms, jax.Array], Pictures]
"""(geoms whose arrays have a leading B, T_world_cam (B, 4, 4)) -> pictures. May be jitted."""


def make_renderer(name: str, camera: Camera, *, depth_only: bool = False, far_m: float = 2.0) -> Renderer:
    """The named renderer: "jax" anywhere, "warp" on an NVIDIA GPU. Of `camera` the pose is not read.

    UserError for an unknown name, or for "warp" without a GPU.
    """
    check_renderer(name)
    make = warp_renderer if name == "warp" else jax_renderer
    return make(camera, depth_only=depth_only, far_m=far_m)


def check_renderer(name: str) -> None:
    """UserError unless the named renderer is there and can run here."""
    if name not in RENDERERS:
        raise unknown_name("renderer", name, RENDERERS)
    if name == "warp":
        require_gpu("renderer")


def jax_renderer(camera: Camera, *, depth_only: bool = False, far_m: float = 2.0) -> Renderer:
    """The JAX ray caster: on accelerators all scenes at once, on processors one after another (faster there).

    Which of the two is decided when a program is lowered for its device.
    """

    def draw(scene):
        geoms, T_world_cam = scene
        seen_from = replace(camera, T_world_cam=T_world_cam)
        if depth_only:
            return Pictures(raycast.render_depth(geoms, seen_from, far_m=far_m), None, None)
        seen = raycast.render(geoms, seen_from, far_m=far_m)
        return Pictures(seen.depth_m, seen.rgb, seen.segmentation)

    def one_after_another(geoms: Geoms, T_world_cam: jax.Array) -> Pictures:
        return jax.lax.map(draw, (geoms, T_world_cam))

    def at_once(geoms: Geoms, T_world_cam: jax.Array) -> Pictures:
        return jax.vmap(draw)((geoms, T_world_cam))

    def render(geoms: Geoms, T_world_cam: jax.Array) -> Pictures:
        T = jnp.asarray(T_world_cam)
        return jax.lax.platform_dependent(geoms, T, cpu=one_after_another, default=at_once)

    return render


def warp_renderer(camera: Camera, *, depth_only: bool = False, far_m: float = 2.0) -> Renderer:
    """MJX-Warp's renderer; makes buffers for each number of scenes. Runs on Warp's CPU device too, for tests.

    Warp's depth is planar from MuJoCo 3.17 on, 0 where nothing is hit: nothing to convert.
    """
    shape = (camera.height_px, camera.width_px)

    def render(geoms: Geoms, T_world_cam) -> Pictures:
        model, context = _stage(geoms.types, replace(camera, T_world_cam=None), len(geoms.pos_w), depth_only)
        draw = _warp_draw(model, context.pytree(), depth_only)
        depth, rgb, index = jax.vmap(draw)(geoms, jnp.asarray(T_world_cam, jnp.float32))
        depth = depth.reshape(-1, *shape)
        depth = jnp.where(depth <= far_m, depth, 0)
        if rgb is None or index is None:
            return Pictures(depth, None, None)
        ids = jnp.array((*(geoms.ids or range(len(geoms.types))), -1), jnp.int32)
        colours = mjx.get_rgb(context.pytree(), 0, rgb)
        return Pictures(depth, colours, ids[index].reshape(-1, *shape))

    return render


def _warp_draw(model: mujoco.MjModel, handle, depth_only: bool):
    """(geoms, T_world_cam) of one scene -> packed (depth, colours, geom indices); to be mapped."""
    mx, empty = mjx.put_model(model, impl="warp"), mjx.make_data(model, impl="warp", naconmax=1, njmax=1)
    light = jnp.asarray([[-c for c in LIGHT_DIRECTION_W]], jnp.float32)
    to_mujoco = jnp.array([1.0, -1.0, -1.0])  # its cameras have y up and look along -z

    def draw(geoms: Geoms, T_world_cam):
        rgba = jnp.concatenate([geoms.rgb, jnp.ones_like(geoms.rgb[:, :1])], axis=1)
        scene = mx.replace(geom_size=geoms.size, geom_rgba=rgba)
        data = empty.replace(
            geom_xpos=geoms.pos_w,
            geom_xmat=geoms.rot_w,
            cam_xpos=T_world_cam[None, :3, 3],
            cam_xmat=(T_world_cam[:3, :3] * to_mujoco)[None],
        ).tree_replace({"_impl.light_xdir": light})
        data = mjx.refit_bvh(scene, data, handle)
        if depth_only:
            _, depth, _ = mjx.render(scene, data, handle)
            return depth, None, None
        rgb, depth, seg, _ = mjx.render_with_segmentation(scene, data, handle)
        return depth, rgb, seg[:, 0]

    return draw


@cache
def _stage(types: tuple[str, ...], camera: Camera, count: int, depth_only: bool):
    """A model of nothing but G geoms, a camera and a light, posed from outside; the context that draws it.

    The light is the ray caster's: an ambient share, the rest from one direction. Kept for good: JAX
    may call a context's buffers after the last reference in Python is gone.
    """
    spec = mujoco.MjSpec()
    spec.visual.headlight.active = 0
    for kind in types:
        size = [0.0, 0.0, 1.0] if kind == "plane" else [0.01, 0.01, 0.01]
        spec.worldbody.add_geom(type=getattr(mujoco.mjtGeom, f"mjGEOM_{kind.upper()}"), size=size)
    spec.worldbody.add_camera()
    spec.worldbody.add_light(
        type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL, ambient=[AMBIENT] * 3, diffuse=[1 - AMBIENT] * 3,
        specular=[0.0] * 3, castshadow=False,
    )  # fmt: skip
    model = spec.compile()
    width, height = camera.width_px, camera.height_px
    model.cam_resolution[0] = width, height
    model.cam_sensorsize[0] = width, height  # in pixels; MuJoCo's principal point counts from the middle
    model.cam_intrinsic[0] = camera.fx_px, camera.fy_px, width / 2 - camera.cx_px, height / 2 - camera.cy_px
    context = mjx.create_render_context(
        model,
        nworld=count,
        cam_res=(width, height),
        render_rgb=not depth_only,
        render_depth=True,
        render_seg=not depth_only,
        use_textures=False,
        enable_specular=False,
        background_color=(*BACKGROUND_RGB, 1.0),
    )
    return model, context
