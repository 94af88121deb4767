"""The student at the wheel of many simulated environments, on clean depth or a depth source's."""

from collections import deque
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import Float, UInt16

from ddgrasp import contract
from ddgrasp.arrays import AnyArray
from ddgrasp.config import StudentConfig
from ddgrasp.depth import to_metres
from ddgrasp.gripper import ClosingLatch, WidthChange
from demos.rollout import Scene
from demos.spool import Spool
from student_jax.depth_source import DepthSource
from student_jax.policy import Aux, StudentPolicy, sample_actions

Corrupt = Callable[[Scene], UInt16[np.ndarray, "B H W"]]
"""The scene of B environments -> depth as the student sees it."""


def keep_clean(scene: Scene) -> UInt16[np.ndarray, "B H W"]:
    """Ideal camera."""
    return scene.depth_mm


class SourceCamera:
    """A depth source before environments in lock-step: number i is its episode `first + i`."""

    def __init__(self, source: DepthSource, first: int = 0):
        self._source, self._first = source, first

    def __call__(self, scene: Scene) -> UInt16[np.ndarray, "B H W"]:
        """(B, H, W) uint16 with artefacts."""
        count = len(scene.depth_mm)
        episode, frame = self._first + np.arange(count), np.full(count, scene.step)
        return self._source.frames(scene.depth_mm, scene.rgb, episode, frame, scene.views)


class StudentActor:
    """Acts in `demos.rollout.Roller` and keeps what the student saw.

    Args:
      params: the policy's, a tree of arrays.
      noise: start of the reverse diffusion, as in `DeployConfig.noise`: zero or normal.
      teacher_share: probability that an action is the teacher's instead.
      keep: folder for the scratch file of `seen`; None takes the system's place for temporary files.
    """

    def __init__(
        self,
        params: Any,
        config: StudentConfig,
        profile: contract.CameraProfile,
        corrupt: Corrupt,
        rng: np.random.Generator,
        noise: str = "zero",
        teacher_share: float = 0.0,
        keep: Path | None = None,
    ):
        self._act = partial(act_on_depth, config, profile, params)
        self._config, self._corrupt, self._rng, self._teacher_share = config, corrupt, rng, teacher_share
        self._noise_scale = float(noise == "normal")
        self._chunk = np.zeros(0)
        self._latch, self._width_change = ClosingLatch(config.head.closing_steps), WidthChange()
        self._stack: deque[np.ndarray] = deque(maxlen=contract.DEPTH_FRAMES)
        self.seen = Spool(keep)
        """What the student saw, (B, H, W) uint16 millimetres a step."""

    def __call__(self, scene: Scene) -> Float[np.ndarray, "B 8"]:
        """(B, 8) actions for the scene."""
        depth_mm = self._corrupt(scene)
        self.seen.add(depth_mm)
        self._stack.append(depth_mm)
        state = self._width_change(scene.state)
        position = scene.step % self._config.head.execute_steps
        if position == 0:
            frames = [self._stack[0]] * (contract.DEPTH_FRAMES - len(self._stack)) + [*self._stack]
            shape = (len(state), self._config.head.chunk, contract.ACTION_SIZE)
            noise = self._noise_scale * self._rng.standard_normal(shape)
            self._chunk = np.asarray(self._act(np.stack(frames, axis=1), state, noise.astype(np.float32)))
        action = self._chunk[:, position]
        taught = self._rng.random(len(action)) < self._teacher_share
        return self._latch(np.where(taught[:, None], scene.expert, action))


@partial(jax.jit, static_argnums=(0, 1))
def act_on_depth(
    config: StudentConfig,
    profile: contract.CameraProfile,
    params: Any,
    depth_mm: UInt16[jax.Array, "B 3 H W"],
    state: Float[jax.Array, "B 9"],
    noise: Float[jax.Array, "B K 8"],
) -> Float[jax.Array, "B K 8"]:
    """Chunks of actions for frames, from the start `noise` of the reverse diffusion."""
    return sample_actions(params, to_metres(depth_mm), state, noise, config, profile)


def perceive(
    config: StudentConfig,
    profile: contract.CameraProfile,
    params: Any,
    depth_mm: UInt16[np.ndarray, "B 3 H W"],
    state: Float[np.ndarray, "B 9"],
) -> Aux:
    """What the network reports of the frames that a policy is given: where to grasp, and whether it holds."""
    return jax.tree.map(np.asarray, perceived(config, profile, params, depth_mm, state))


@partial(jax.jit, static_argnums=(0, 1))
def perceived(
    config: StudentConfig,
    profile: contract.CameraProfile,
    params: Any,
    depth_mm: UInt16[AnyArray, "B 3 H W"],
    state: Float[AnyArray, "B 9"],
) -> Aux:
    """What `perceive` gives, on the device."""
    policy = StudentPolicy(config, profile)
    seen: Any = policy.apply({"params": params}, to_metres(depth_mm), state, method="encode")
    return seen.aux
