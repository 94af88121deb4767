"""True poses with the errors that perception will make: what the action head learns from first.

A simulation without pictures gives a hundred thousand labelled steps a minute, so that the head can
act before the encoder sees anything. The error grows with the object's distance from the hand, as the
hand view's does, and an episode keeps its own.
"""

from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from ddgrasp.config import StudentConfig
from ddgrasp.contract import CameraProfile
from ddgrasp.gripper import ClosingLatch, WidthChange
from ddgrasp.layout import ACTION, OBSERVATION
from demos.rollout import Scene
from student_jax import train
from student_jax.data import aux_targets
from student_jax.encoder import POSITION_SCALE_M
from student_jax.policy import AUX, Aux, Seen, feature_count

NEAR_ERROR_M = 0.002
ERROR_PER_DISTANCE = 0.08
FAR_ERROR_M = 0.010
"""Standard deviation of a position per axis: near + slope * distance, at most far."""
YAW_ERROR = 0.15
"""Standard deviation of cosine and sine of the doubled angle: four degrees."""
HELD_LOGIT = 6.0
HELD_WRONG = 0.01
"""Share of steps whose held probability is the wrong way round."""
ACTION_NOISE, NOISE_SHARE = 0.3, 0.15
"""Perturbation of the executed joint actions, and the share of steps that have one."""


def noisy_seen(
    observation: Float[np.ndarray, "B 40"],
    held: Float[np.ndarray, " B"] | Bool[np.ndarray, " B"],
    bias: Float[np.ndarray, "B 5"],
    rng: np.random.Generator,
    config: StudentConfig,
) -> Seen:
    """What perception might report of true poses.

    Args:
        observation: (B, 40).
        held: (B,) object in the hand.
        bias: (B, 5) standard normal: position and yaw errors in units of their size.
    """
    truth = aux_targets(observation, held)
    way = observation[:, OBSERVATION.grip_pos] - observation[:, OBSERVATION.grasp_pos]
    distance = np.linalg.norm(way, axis=1, keepdims=True)
    size_m = np.minimum(NEAR_ERROR_M + ERROR_PER_DISTANCE * distance, FAR_ERROR_M)
    wrong = rng.random(len(held)) < HELD_WRONG
    logit = HELD_LOGIT * (2 * (truth.held_logit > 0.5) - 1.0) * np.where(wrong, -1.0, 1.0)
    aux = Aux(
        (truth.position + size_m / POSITION_SCALE_M * bias[:, AUX.position]).astype(np.float32),
        (truth.yaw + YAW_ERROR * bias[:, AUX.yaw]).astype(np.float32),
        logit.astype(np.float32),
    )
    return Seen(np.zeros((len(held), feature_count(config)), np.float32), aux)


class PoseActor:
    """Acts in `demos.rollout.Roller` from noisy true poses, mixed with the teacher and perturbed.

    Args:
      head: parameters of HEAD_PARAMS; None lets the teacher act.
      count: environments that it acts in.
      teacher_share: probability that an action is the teacher's instead.
    """

    def __init__(
        self,
        head: dict[str, Any] | None,
        config: StudentConfig,
        profile: CameraProfile,
        rng: np.random.Generator,
        count: int,
        teacher_share: float,
    ):
        self._head, self._config, self._profile = head, config, profile
        self._rng, self._share = rng, 1.0 if head is None else teacher_share
        self._bias = rng.standard_normal((count, 5))
        self._latch, self._width_change = ClosingLatch(config.head.closing_steps), WidthChange()

    def __call__(self, scene: Scene) -> Float[np.ndarray, "B 8"]:
        """(B, 8) actions for the scene."""
        rng, action = self._rng, np.array(scene.expert)
        state = self._width_change(scene.state)
        if self._head is not None:
            seen = noisy_seen(scene.observation, scene.held, self._bias, rng, self._config)
            noise = np.zeros((len(action), self._config.head.chunk, action.shape[1]), np.float32)
            chosen = train.act_on_seen(self._config, self._profile, self._head, seen, state, noise)
            taught = rng.random((len(action), 1)) < self._share
            action = np.where(taught, action, np.asarray(chosen)[:, 0])
        pushed = rng.random((len(action), 1)) < NOISE_SHARE
        push = ACTION_NOISE * rng.standard_normal(action.shape) * pushed
        push[:, ACTION.gripper] = 0.0
        return self._latch(np.clip(action + push, -1.0, 1.0))
