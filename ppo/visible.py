"""What the depth camera sees of the object, by the ray caster's segmentation; pictures of an episode."""

from collections.abc import Callable
from functools import partial

import jax
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from ddgrasp import contract
from ddgrasp.layout import QPOS
from mjx_envs import kinematics, randomize
from mjx_envs.camera import look_at
from mjx_envs.grasp_env import GraspEnv
from mjx_envs.physics.interface import ModelParams
from mjx_envs.render.visual import Viewer

MOMENTS = ("start", "above", "contact", "lifted", "held")
ABOVE_M = 0.06
"""The hand is above the object while its grip point is at least this far over the object's centre."""
LIFTED_M = 0.1
PICTURE_SCALE = 0.5
"""Size of pictures for people, relative to 1280 x 720."""
_PICTURE_ROWS, _PICTURE_COLUMNS = slice(60, 360), slice(170, 470)
"""What they show at that scale: workspace and lift target."""
_BACK, _UP_M = 0.3, 0.18
"""They are seen from behind the depth camera, by this share of its distance, and aimed this much higher."""
_LOT = 32
"""Scenes drawn by a call."""


class Watcher:
    """Compiled pieces for looking at recorded states of `env`, with the camera that its configuration has."""

    def __init__(self, env: GraspEnv):
        self._env = env
        layout, renderer = env.table.layout, env.config.renderer
        self._viewer = Viewer(env.config.profile, layout, renderer)
        self._large = Viewer(contract.D455.scaled(PICTURE_SCALE), layout, renderer)
        self._geoms = jax.jit(jax.vmap(self._viewer.geoms))
        self._pixels = jax.jit(self._viewer.object_pixels)
        self._rgb = jax.jit(self._large.rgb)

    def visible_pixels(
        self, qpos: Float[np.ndarray, "steps n 16"], params: ModelParams, index: int,
        counted: Bool[np.ndarray, "steps n"], seed: int,
    ) -> Int[np.ndarray, " counted"]:  # fmt: skip
        """Pixels of the object in the student's crop, camera poses drawn per episode as for the student.

        Args:
          qpos: (T, N, 16).
          params: (N, ...).
          index: the object's index in the environment.
          counted: (T, N) bool, the steps to look at.
          seed: of the camera poses.

        Returns:
          (counted steps,) int.
        """
        pose = partial(
            randomize.sample_camera, config=self._env.config.random, T_world_cam=self._viewer.nominal_pose
        )
        cameras = np.asarray(jax.vmap(pose)(jax.random.split(jax.random.PRNGKey(seed), qpos.shape[1])))
        steps, episodes = np.nonzero(counted)
        params = jax.tree.map(lambda leaf: leaf[episodes], params)
        return self._draw(self._pixels, qpos[steps, episodes], params, index, cameras[episodes])

    def pictures(
        self, qpos: Float[np.ndarray, "m 16"], params: ModelParams, index: int
    ) -> UInt8[np.ndarray, "m 300 300 3"]:
        """(M, 300, 300, 3) uint8 of the states qpos (M, 16) of one environment: workspace and lift target."""
        params = jax.tree.map(lambda leaf: np.broadcast_to(leaf, (len(qpos), *leaf.shape)), params)
        cameras = np.broadcast_to(_picture_pose(), (len(qpos), 4, 4)).astype(np.float32)
        pictures = self._draw(self._rgb, qpos, params, index, cameras)
        return pictures[:, _PICTURE_ROWS, _PICTURE_COLUMNS]

    def _draw(
        self, draw: Callable, qpos: np.ndarray, params: ModelParams, index: int, cameras: np.ndarray
    ) -> np.ndarray:
        """`draw` of M scenes, in lots of one size so that it is compiled once."""
        rgb = np.broadcast_to(np.asarray(self._env.table.rgb, np.float32)[index], (_LOT, *self._rgb_shape))
        drawn = []
        for start in range(0, len(qpos), _LOT):
            take = np.minimum(np.arange(start, start + _LOT), len(qpos) - 1)
            some = jax.tree.map(lambda leaf, take=take: leaf[take], (qpos, params, cameras))
            geoms = self._geoms(some[0], some[1], rgb)
            drawn.append(np.asarray(draw(geoms, some[2]))[: len(qpos) - start])
        return np.concatenate(drawn)

    @property
    def _rgb_shape(self) -> tuple[int, ...]:
        return np.shape(self._env.table.rgb)[1:]


def _picture_pose() -> np.ndarray:
    """(4, 4) T_world_cam of pictures for people."""
    position, target = np.array(contract.CAMERA_POSITION_M), np.array(contract.CAMERA_LOOK_AT_M)
    return look_at(position + _BACK * (position - target), target + [0.0, 0.0, _UP_M])


def moments(
    qpos: Float[np.ndarray, "steps 16"],
    touched: Bool[np.ndarray, " steps"],
    running: Bool[np.ndarray, " steps"],
) -> Int[np.ndarray, "5"]:
    """(5,) the steps of one episode that show MOMENTS; where one never came, the one before it. Of an object
    that is never touched the last step with the hand above it counts.

    Args:
      qpos: (T, 16).
      touched: (T,) bool, the object has been touched.
      running: (T,) bool.
    """
    last = int(np.flatnonzero(running)[-1])
    grip_pos, _ = kinematics.grip_pose(qpos[:, QPOS.arm], np)
    met = touched & running
    height = qpos[:, QPOS.object_pos][:, 2]
    high = np.flatnonzero((grip_pos[:, 2] - height)[: _first(met, 0) if met.any() else last + 1] > ABOVE_M)
    above = int(high[-1]) if len(high) else 0
    contact = _first(met, above)
    lifted = _first((height > height[0] + LIFTED_M) & running, contact)
    return np.array([0, above, contact, lifted, last])


def _first(true: np.ndarray, otherwise: int) -> int:
    """The first index where `true`, at least `otherwise`."""
    where = np.flatnonzero(true[otherwise:])
    return otherwise + int(where[0]) if len(where) else otherwise
