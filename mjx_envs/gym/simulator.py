"""What Gymnasium's environments run on: N episodes as one pytree, stepped and drawn by compiled programs."""

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property, lru_cache
from threading import Lock
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from gymnasium import spaces
from jaxtyping import Bool, Float, UInt8, UInt32
from mujoco_playground import State

from ddgrasp.config import WorldConfig
from ddgrasp.errors import UserError, unknown_name
from ddgrasp.layout import OBSERVATION
from mjx_envs import randomize, rewards
from mjx_envs.camera import nominal_camera
from mjx_envs.grasp_env import GraspEnv
from mjx_envs.gym.spaces import FAR_M, KINDS, depth_space, joints_space, state_space, within
from mjx_envs.render.batch_render import make_renderer
from mjx_envs.render.visual import Viewer

Keys = UInt32[np.ndarray, "n 2"]
Observation = Any
"""(N, 40) float32, or {"depth": (N, H, W), "state": (N, 8)} float32."""
_CAMERA = 1000
"""Folded into an episode's key for its camera; beyond what `GraspEnv.reset` splits it into, since
fold_in(key, i) is split(key, n)[i]."""


@struct.dataclass
class Scenes:
    """N episodes where they stand."""

    state: State
    T_world_cam: jax.Array
    """(N, 4, 4) the depth camera's pose, drawn once per episode."""


class Simulator:
    """Programs for environments of one configuration, any number of them. Get one by `simulator`."""

    def __init__(self, world: WorldConfig):
        self.env = GraspEnv(world)
        self._nominal = nominal_camera(world.profile)
        self._begin = jax.jit(jax.vmap(self._episode))
        self._step = jax.jit(jax.vmap(self.env.step))
        self._lock = Lock()

    def begin(self, keys: Keys) -> Scenes:
        """New episodes, one for each of `keys` (N, 2)."""
        return self._begin(keys)

    def renew(self, scenes: Scenes, keys: Keys, which: Bool[np.ndarray, " n"]) -> Scenes:
        """`scenes`, with the new episodes of `keys` (N, 2) where `which` (N,) says so."""
        return _chosen(which, self.begin(keys), scenes) if which.any() else scenes

    def step(self, scenes: Scenes, actions: Float[np.ndarray, "n 8"]) -> Scenes:
        """One control step with `actions` (N, 8)."""
        with self._lock:  # the C engine's buffers belong to all who share the simulator
            state = jax.block_until_ready(self._step(scenes.state, actions))
        return replace(scenes, state=state)

    def space(self, kind: str) -> spaces.Box | spaces.Dict:
        """Space of one environment's observation; UserError for an unknown kind."""
        if kind not in KINDS:
            raise unknown_name("observation", kind, KINDS)
        return state_space() if kind == "state" else depth_space(self.env.config.profile)

    def observe(self, scenes: Scenes, kind: str) -> Observation:
        """N observations, new arrays."""
        seen = np.asarray(scenes.state.obs)
        if kind == "state":
            return within(state_space(), seen)
        width = seen[:, OBSERVATION.fingers].sum(axis=1, keepdims=True)
        joints = np.hstack([seen[:, OBSERVATION.arm], width])
        return {"depth": self._depth(scenes), "state": within(joints_space(), joints)}

    def facts(self, scenes: Scenes) -> dict[str, np.ndarray]:
        """(N,) each: success (bool), object (str), contacts that the physics backend had no room for in the
        last step, and the weighted terms of its reward."""
        metrics = scenes.state.metrics
        names = np.array(self.env.table.names, object)
        terms = {f"reward/{name}": np.array(metrics[f"reward/{name}"], float) for name in rewards.TERMS}
        index = np.asarray(scenes.state.info["episode"].object_index)
        lost = np.array(metrics["contacts_dropped"], float)
        success = np.asarray(metrics["success"]) > 0
        return {"success": success, "object": names[index], "contacts_dropped": lost} | terms

    def rgb(self, scenes: Scenes) -> UInt8[np.ndarray, "n height width 3"]:
        """(N, H, W, 3) the depth camera's whole picture, in colour."""
        return np.array(self._draw_rgb(self._geoms(scenes), scenes.T_world_cam))

    def _episode(self, key: jax.Array) -> Scenes:
        camera_key, nominal = jax.random.fold_in(key, _CAMERA), jnp.asarray(self._nominal.T_world_cam)
        return Scenes(
            self.env.reset(key), randomize.sample_camera(camera_key, self.env.config.random, nominal)
        )

    def _depth(self, scenes: Scenes) -> Float[np.ndarray, "n height width"]:
        return np.array(self._draw_window(self._geoms(scenes), scenes.T_world_cam).depth_m)

    def _geoms(self, scenes: Scenes):
        episode = scenes.state.info["episode"]
        rgb = np.asarray(self.env.table.rgb, np.float32)[np.asarray(episode.object_index)]
        return self._place(scenes.state.data.qpos, episode.params, rgb)

    @cached_property
    def _viewer(self) -> Viewer:
        return Viewer(self.env.config.profile, self.env.table.layout, self.env.config.renderer)

    @cached_property
    def _place(self):
        return jax.jit(jax.vmap(self._viewer.geoms))

    @cached_property
    def _draw_rgb(self):
        return jax.jit(self._viewer.rgb)

    @cached_property
    def _draw_window(self):
        profile = self.env.config.profile
        window = (*profile.crop_origin_px, profile.crop_height_px, profile.crop_width_px)
        camera = self._nominal.cropped(*window)
        return jax.jit(make_renderer(self.env.config.renderer, camera, depth_only=True, far_m=FAR_M))


def simulator(world: WorldConfig | None) -> Simulator:
    """The simulator of `world`, by default `WorldConfig()`: environments of one configuration share what is
    compiled. UserError for what is none."""
    if not isinstance(world, WorldConfig | None):
        raise UserError(f"world is a {type(world).__name__}; expected a ddgrasp.config.WorldConfig.")
    return _simulator(world or WorldConfig())


@lru_cache(maxsize=8)
def _simulator(world: WorldConfig) -> Simulator:
    return Simulator(world)


def draw_keys(generators: Sequence[np.random.Generator]) -> Keys:
    """(N, 2) the next episode's key from each of N generators."""
    return np.stack([rng.integers(0, 2**32, 2, np.uint32) for rng in generators])


@jax.jit
def _chosen(which, fresh: Scenes, old: Scenes) -> Scenes:
    def pick(new, kept):
        return jnp.where(which.reshape((-1,) + (1,) * (new.ndim - 1)), new, kept)

    return jax.tree.map(pick, fresh, old)
