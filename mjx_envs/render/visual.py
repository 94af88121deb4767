"""What a depth camera sees of a batch of environments: physics state to pictures."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int32, UInt8, UInt16

from ddgrasp import contract, depth
from ddgrasp.arrays import AnyArray
from mjx_envs import kinematics, scene
from mjx_envs.camera import Camera, nominal_camera
from mjx_envs.object_spec import DEFAULT_SLOTS, SlotLayout
from mjx_envs.physics.interface import ModelParams
from mjx_envs.render.batch_render import make_renderer
from mjx_envs.render.raycast import Geoms, render
from mjx_envs.render.visible_geoms import visible_geoms


class Viewer:
    """Draws environments. Jit `geoms` and the drawing apart: in one program XLA repeats the kinematics
    for every chunk of pixels.

    Args:
      profile: the camera at the scale wanted.
      layout: the object's slots, as the environments have them (`ObjectTable.layout`).
      renderer: one of `ddgrasp.config.RENDERERS`.
    """

    def __init__(
        self, profile: contract.CameraProfile, layout: SlotLayout = DEFAULT_SLOTS, renderer: str = "jax"
    ):
        self.profile = profile
        model = scene.build_model(layout=layout)
        table = visible_geoms(model)
        self._types = table.types
        self._size, self._rgb = table.size, table.rgb
        self._pos, self._quat = model.geom_pos[table.ids], model.geom_quat[table.ids]
        self._slots = np.searchsorted(table.ids, scene.slot_ids(model))
        self._bodies = [model.body(int(b)).name for b in model.geom_bodyid[table.ids]]
        self._camera = nominal_camera(profile)
        self._draw = make_renderer(renderer, self._camera)
        self._draw_depth = make_renderer(renderer, self._camera, depth_only=True)

    @property
    def nominal_pose(self) -> np.ndarray:
        """(4, 4) T_world_cam of the contract's camera."""
        return self._camera.T_world_cam

    def geoms(
        self, qpos: Float[jax.Array, "16"], params: ModelParams, object_rgb: Float[AnyArray, "*slots 3"]
    ) -> Geoms:
        """World geometry of the configuration qpos (16,) with the slots' colours (S, 3), or one (3,)."""
        poses = kinematics.body_poses(qpos, jnp)
        poses["world"] = (jnp.zeros(3), jnp.asarray([1.0, 0.0, 0.0, 0.0]))
        body_pos = jnp.stack([poses[name][0] for name in self._bodies])
        body_quat = jnp.stack([poses[name][1] for name in self._bodies])
        local_pos = jnp.asarray(self._pos, jnp.float32).at[self._slots].set(params.slot_pos)
        local_quat = jnp.asarray(self._quat, jnp.float32).at[self._slots].set(params.slot_quat)
        quat = kinematics.quat_mul(body_quat, local_quat, jnp)
        return Geoms(
            types=self._types,
            pos_w=body_pos + kinematics.rotate(body_quat, local_pos, jnp),
            rot_w=kinematics.quat_to_mat(quat, jnp),
            size=jnp.asarray(self._size).at[self._slots].set(params.slot_size),
            rgb=jnp.asarray(self._rgb).at[self._slots].set(jnp.asarray(object_rgb, jnp.float32)),
        )

    def depth_mm(
        self, geoms: Geoms, T_world_cam: Float[AnyArray, "b 4 4"]
    ) -> UInt16[jax.Array, "b height width"]:
        """(B, H, W) uint16 planar depth of a batch of scenes, 0 where nothing is hit."""
        return depth.to_millimetres(self._draw_depth(geoms, T_world_cam).depth_m, jnp)

    def rgb(
        self, geoms: Geoms, T_world_cam: Float[AnyArray, "b 4 4"]
    ) -> UInt8[jax.Array, "b height width 3"]:
        """(B, H, W, 3) uint8 colour of a batch of scenes."""
        return jnp.round(255 * self._draw(geoms, T_world_cam).rgb).astype(jnp.uint8)

    def object_pixels(self, geoms: Geoms, T_world_cam: Float[AnyArray, "b 4 4"]) -> Int32[jax.Array, " b"]:
        """(B,) int32 pixels of the object in the centred crop window, for a batch of scenes."""
        window = (self.profile.crop_height_px, self.profile.crop_width_px)

        def count(a):
            camera = self._seen_from(a[1]).cropped(*self.profile.crop_origin_px, *window)
            return jnp.isin(render(a[0], camera).segmentation, self._slots).sum()

        return jax.lax.map(count, (geoms, T_world_cam))

    def _seen_from(self, T_world_cam: jax.Array) -> Camera:
        return dataclasses.replace(self._camera, T_world_cam=T_world_cam)
