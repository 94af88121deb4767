"""The active-stereo camera as a camera model: it looks at the surfaces of a clean depth picture.

It runs on the host (OpenCV's matcher), behind `jax.pure_callback`: jittable, not accelerated. What the
picture does not show is guessed (sensors/models/reprojection.py), materials come from its colour, and every
surface has the rig's table texture, fixed to the picture. The rig's own camera (rig/camera.py) renders the
scene instead.
"""

import threading

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float32

from ddgrasp.config import StereoConfig
from ddgrasp.contract import CameraProfile
from ddgrasp.depth import to_metres
from ddgrasp.errors import UserError
from mjx_envs.camera import nominal_camera
from sensors.models.active_stereo import albedo_texture, of_scale
from sensors.models.materials import TABLE_TEXTURE
from sensors.models.reprojection import from_beside
from sensors.models.sense import Key, Sense, batched

GREY = 0.5
"""Colour of everything where none is given."""


def stereo(config: StereoConfig, profile: CameraProfile) -> Sense:
    """The rig's camera on clean depth of `profile`'s size; the light is that of the nominal extrinsics."""
    camera = of_scale(config, profile)
    T_world_cam = nominal_camera(profile).T_world_cam
    texture = albedo_texture(profile.height_px, profile.width_px)
    wear = 1.0 + TABLE_TEXTURE * texture[..., None]
    one_at_a_time = threading.Lock()  # OpenCV's matcher keeps buffers of its own

    def on_host(seed, depth_m, rgb) -> Float32[np.ndarray, "*batch H W"]:
        seed, depth_m, rgb = (np.asarray(a) for a in (seed, depth_m, rgb))
        out = np.empty(depth_m.shape, np.float32)
        with one_at_a_time:
            for index in np.ndindex(depth_m.shape[:-2]):
                worn = np.clip(rgb[index] * wear, 0, 1)
                render = from_beside(depth_m[index], worn, profile, T_world_cam)
                rng = np.random.default_rng(seed[index])
                out[index] = to_metres(camera.sense(render, T_world_cam, rng))
        return out

    def sense_frame(
        key: Key, depth_m: Float32[Array, "H W"], rgb: Float32[Array, "H W 3"] | None
    ) -> Float32[Array, "H W"]:
        if depth_m.shape != (profile.height_px, profile.width_px):
            raise UserError(
                f"Depth is {depth_m.shape[1]}x{depth_m.shape[0]}; this stereo camera was made for "
                f"{profile.width_px}x{profile.height_px}: give it that profile, or resize."
            )
        colour = jnp.full((*depth_m.shape, 3), GREY, jnp.float32) if rgb is None else rgb
        shape = jax.ShapeDtypeStruct(depth_m.shape, jnp.float32)
        seed = jax.random.bits(key, (4,), jnp.uint32)
        return jax.pure_callback(on_host, shape, seed, depth_m, colour, vmap_method="broadcast_all")

    return batched(sense_frame)
