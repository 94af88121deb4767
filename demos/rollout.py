"""Lock-step episodes of many environments with pictures: for demos, DAgger and evaluation alike."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8, UInt16

from ddgrasp import contract
from ddgrasp.config import Config
from ddgrasp.layout import ACTION, QPOS
from demos.spool import Spool
from learning.programs import Program, shape
from mjx_envs import randomize
from mjx_envs.grasp_env import GraspEnv
from mjx_envs.physics.interface import warn_of_dropped
from mjx_envs.render.visual import Viewer
from mjx_envs.views import Views, observed
from ppo.policy import TeacherPolicy

Actor = Callable[["Scene"], np.ndarray]
"""What moves the robots: sees a `Scene`, returns actions (B, 8)."""


@dataclass
class Scene:
    """One control step of B environments, before the action is taken."""

    depth_mm: UInt16[np.ndarray, "B H W"]
    """Clean."""
    state: Float[np.ndarray, "B 8"]
    """Joint positions and gripper width."""
    expert: Float[np.ndarray, "B 8"]
    """The teacher's action here: the label."""
    observation: Float[np.ndarray, "B 40"]
    held: Bool[np.ndarray, " B"]
    """Object in the hand."""
    step: int
    rgb: UInt8[np.ndarray, "B H W 3"] | None = None
    views: Views | None = None
    """What the pictures are of."""


@dataclass
class Episodes:
    """B episodes of equal allotted length T; `length` says how many steps of each count."""

    state: Float[np.ndarray, "B T 8"]
    action: Float[np.ndarray, "B T 8"]
    """The teacher's labels."""
    observation: Float[np.ndarray, "B T 40"]
    held: Bool[np.ndarray, "B T"]
    length: Int[np.ndarray, " B"]
    success: Bool[np.ndarray, " B"]
    object_index: Int[np.ndarray, " B"]
    T_world_cam: Float[np.ndarray, "B 4 4"]
    variant: Int[np.ndarray, " B"]
    """See `Views`."""
    size: Float[np.ndarray, " B"]
    """See `Views`."""
    depth_mm: Spool | None = None
    """Clean, (B, H, W) uint16 a step; None unless kept."""
    rgb: Spool | None = None
    """(B, H, W, 3) uint8 a step; None unless drawn and kept."""


class Roller:
    """Compiled pieces for rolling out `count` environments at a time.

    Args:
      config: world, camera and randomisation.
      teacher: gives the labels.
      count: environments in lock-step.
      with_rgb: draw colour as well (slow).
      with_depth: draw depth; without, pictures have no pixels.
      keep: folder for a scratch file with the pictures of `Episodes`; None shows them to the actor alone.
    """

    def __init__(
        self,
        config: Config,
        teacher: TeacherPolicy,
        count: int,
        with_rgb: bool = False,
        with_depth: bool = True,
        keep: Path | None = None,
    ):
        self.env = GraspEnv(config.world)
        self.viewer = Viewer(config.world.profile, self.env.table.layout, config.world.renderer)
        self.count, self.steps = count, config.world.episode_steps
        self._teacher, self._random, self._with_rgb = teacher, config.world.random, with_rgb
        self._with_depth, self._keep = with_depth, keep
        self._begin = jax.jit(self._begin_batch)
        self._look = jax.jit(self._look_batch)
        self._pose = jax.jit(self._pose_batch)
        self._draw_depth = jax.jit(self.viewer.depth_mm)
        self._draw_rgb = jax.jit(self.viewer.rgb)
        self._advance = jax.jit(jax.vmap(self.env.step))

    def run(self, key: jax.Array, actor: Actor, on_step: Callable[[int], None] = lambda _: None) -> Episodes:
        """One episode in each environment under `actor`. Says on standard error what physics lost."""
        state, cameras = self._begin(key)
        alive = np.ones(self.count, bool)
        length = np.zeros(self.count, int)
        success = np.zeros(self.count, bool)
        dropped = 0.0
        columns: dict[str, list[np.ndarray]] = {"state": [], "expert": [], "observation": [], "held": []}
        pictures = self._spools()
        for t in range(self.steps):
            scene = self._scene(state, cameras, t)
            for name, values in columns.items():
                values.append(getattr(scene, name))
            for name, spool in pictures.items():
                spool.add(getattr(scene, name))
            length += alive
            state = self._advance(state, jnp.asarray(actor(scene), jnp.float32))
            dropped += float(np.asarray(state.metrics["contacts_dropped"])[alive].sum())
            success |= alive & (np.asarray(state.metrics["success"]) > 0)
            alive &= np.asarray(state.done) == 0
            on_step(t)
            if not alive.any():
                break

        warn_of_dropped(dropped, int(length.sum()))
        whole = {name: np.stack(values, axis=1) for name, values in columns.items()}
        return Episodes(
            state=whole["state"],
            action=whole["expert"],
            observation=whole["observation"],
            held=whole["held"],
            depth_mm=pictures.get("depth_mm"),
            rgb=pictures.get("rgb"),
            length=length,
            success=success,
            object_index=np.asarray(state.info["episode"].object_index),
            T_world_cam=np.asarray(cameras),
            **self._objects(state),
        )

    def programs(self) -> dict[str, Program]:
        """Its compiled pieces, each with the shapes of its arguments: to look at without running them."""
        key = shape(2, dtype=jnp.uint32)
        state, cameras = jax.eval_shape(self._begin, key)
        geoms = jax.eval_shape(self._pose, state)
        action = shape(self.count, contract.ACTION_SIZE)
        return {
            "begin": (self._begin, (key,)),
            "look": (self._look, (state,)),
            "pose": (self._pose, (state,)),
            "depth": (self._draw_depth, (geoms, cameras)),
            "rgb": (self._draw_rgb, (geoms, cameras)),
            "advance": (self._advance, (state, action)),
        }

    def _spools(self) -> dict[str, Spool]:
        """An empty spool for each kind of picture that is kept."""
        if self._keep is None:
            return {}
        return {name: Spool(self._keep) for name in ("depth_mm", *["rgb"] * self._with_rgb)}

    def _scene(self, state, cameras, t: int) -> Scene:
        seen = jax.tree.map(np.asarray, self._look(state))
        if not self._with_depth:
            return Scene(depth_mm=np.zeros((self.count, 0, 0), np.uint16), step=t, **seen)
        geoms = self._pose(state)
        depth_mm = np.asarray(self._draw_depth(geoms, cameras))
        rgb = np.asarray(self._draw_rgb(geoms, cameras)) if self._with_rgb else None
        views = observed(seen["observation"], T_world_cam=np.asarray(cameras), **self._objects(state))
        return Scene(depth_mm=depth_mm, step=t, rgb=rgb, views=views, **seen)

    def _objects(self, state) -> dict[str, np.ndarray]:
        """`variant` (B,) and `size` (B,), see `Views`."""
        episode = state.info["episode"]
        variant = np.asarray(episode.variant)
        size = np.asarray(episode.rest_height) / self.env.table.rest_height[variant]
        return {"variant": variant, "size": size.astype(np.float32)}

    def _begin_batch(self, key):
        k_env, k_cam = jax.random.split(key)
        state = jax.vmap(self.env.reset)(jax.random.split(k_env, self.count))
        camera = partial(randomize.sample_camera, config=self._random, T_world_cam=self.viewer.nominal_pose)
        return state, jax.vmap(camera)(jax.random.split(k_cam, self.count))

    def _look_batch(self, state):
        return {
            "state": student_state(state.data.qpos),
            "expert": self._teacher(state.obs, jnp),
            "observation": state.obs,
            "held": state.info["episode"].grasped,
        }

    def _pose_batch(self, state):
        episode = state.info["episode"]
        colours = jnp.asarray(self.env.table.rgb, jnp.float32)[episode.object_index]
        return jax.vmap(self.viewer.geoms)(state.data.qpos, episode.params, colours)


def student_state(qpos: Float[jax.Array, "*batch 16"]) -> Float[jax.Array, "*batch 8"]:
    """(..., 8) what the student knows of the joints: seven positions and the gripper's width."""
    return jnp.concatenate([qpos[..., QPOS.arm], qpos[..., QPOS.fingers].sum(-1, keepdims=True)], axis=-1)


def noisy_teacher(rng: np.random.Generator, count: int, noise: float, share: float) -> Actor:
    """Acts as the teacher with held random perturbations, so that labels cover recoveries.

    Args:
      rng: source of the perturbations.
      count: environments.
      noise: standard deviation of the perturbation of each joint action.
      share: probability that a perturbation of four steps starts in a step.
    """
    left = np.zeros(count, int)
    push = np.zeros((count, contract.ACTION_SIZE))

    def actor(scene: Scene) -> np.ndarray:
        start = (left == 0) & (rng.random(count) < share)
        left[start] = 4
        push[start, ACTION.arm] = noise * rng.standard_normal(push[start, ACTION.arm].shape)
        active = left > 0
        left[active] -= 1
        return np.clip(scene.expert + push * active[:, None], -1.0, 1.0)

    return actor


def successful(episodes: Episodes) -> Iterator[tuple[dict[str, np.ndarray], dict[str, np.ndarray]]]:
    """(per-step arrays, per-episode arrays) of each successful episode, for `EpisodeStore.append`.

    The roller must have kept the pictures.
    """
    assert episodes.depth_mm is not None
    for i in np.flatnonzero(episodes.success):
        n = int(episodes.length[i])
        steps = {
            "depth_mm": episodes.depth_mm.episode(int(i), n),
            "state": episodes.state[i, :n].astype(np.float32),
            "action": episodes.action[i, :n].astype(np.float32),
            "observation": episodes.observation[i, :n].astype(np.float32),
            "held": episodes.held[i, :n],
        }
        if episodes.rgb is not None:
            steps["rgb"] = episodes.rgb.episode(int(i), n)
        yield (
            steps,
            {
                "object_index": np.asarray(episodes.object_index[i], np.int32),
                "T_world_cam": episodes.T_world_cam[i].astype(np.float32),
                "variant": np.asarray(episodes.variant[i], np.int32),
                "size": np.asarray(episodes.size[i], np.float32),
            },
        )
