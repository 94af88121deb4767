"""Perception's error in new scenes, against errors that are known."""

from dataclasses import replace

import jax
import numpy as np
import pytest

from ddgrasp import contract
from ddgrasp.config import (
    Config,
    EncoderConfig,
    HandViewConfig,
    HeadConfig,
    StudentConfig,
    WorldConfig,
)
from ddgrasp.layout import OBSERVATION
from demos.rollout import Episodes
from demos.spool import Spool
from student_jax.act import perceive
from student_jax.data import with_change
from student_jax.evaluate import position_error_mm
from student_jax.policy import init_params, position_to_world

STUDENT = StudentConfig(
    encoder=EncoderConfig(width=8, keypoints=4, stage_blocks=(1, 1), features=16),
    head=HeadConfig(width=16, blocks=1, state_features=8),
    hand_view=HandViewConfig(size_px=8, width=8, blocks=1, channels=2, features=8),
)
CONFIG = Config(preset="debug", world=WorldConfig(camera_scale=0.25), student=STUDENT)
PROFILE = CONFIG.world.profile


@pytest.fixture(scope="module")
def params():
    return init_params(jax.random.key(0), STUDENT, PROFILE)


def episodes_of(
    rng: np.random.Generator, lengths=(12, 5), grasped: int = 4, lost: int | None = None
) -> tuple[Episodes, Spool]:
    count, steps = len(lengths), max(lengths)
    seen = Spool()
    for _ in range(steps):
        seen.add(rng.integers(400, 1500, (count, PROFILE.height_px, PROFILE.width_px)).astype(np.uint16))
    state = rng.uniform(-0.5, 0.5, (count, steps, contract.STATE_SIZE)).astype(np.float32)
    held = np.zeros((count, steps), bool)
    held[:, grasped:lost] = True
    shape = (count, steps)
    return Episodes(
        state=state, action=np.zeros((*shape, 8), np.float32), observation=np.zeros((*shape, 40), np.float32),
        held=held, length=np.array(lengths), success=np.ones(count, bool),
        object_index=np.zeros(count, int), T_world_cam=np.tile(np.eye(4), (count, 1, 1)),
        variant=np.zeros(count, int), size=np.ones(count),
    ), seen  # fmt: skip


@pytest.mark.parametrize(("lengths", "grasped", "lost"), [((12, 5), 4, None), ((12, 4), 1, 2)])
def test_the_error_is_the_distance_of_the_perceived_grasp_before_it_is_held(params, lengths, grasped, lost):
    episodes, seen = episodes_of(np.random.default_rng(0), lengths, grasped, lost)
    off_m = np.array([0.003, 0.0, 0.004])  # 5 mm
    for number, length in enumerate(map(int, episodes.length)):
        depth = seen.episode(number, length)
        state = with_change(episodes.state[number, :length]).astype(np.float32)
        for t in range(length):
            stack = depth[np.maximum([t - 2, t - 1, t], 0)]
            perceived = position_to_world(
                perceive(STUDENT, PROFILE, params, stack[None], state[[t]]).position
            )
            wrong_m = 0.5 * (t >= grasped)  # while it is held, or after it was lost, nobody asks
            episodes.observation[number, t, OBSERVATION.grasp_pos] = perceived[0] + off_m + wrong_m
    assert position_error_mm(CONFIG, params, episodes, seen) == pytest.approx(5.0, abs=0.05)


def test_an_episode_that_holds_from_the_start_counts_for_nothing(params):
    episodes, seen = episodes_of(np.random.default_rng(1))
    alone = replace(episodes, held=np.stack([episodes.held[0], np.ones(12, bool)]))
    first = replace(alone, **{
        name: getattr(alone, name)[:1]
        for name in ("state", "action", "observation", "held", "length", "success", "object_index")
    })  # fmt: skip
    both = position_error_mm(CONFIG, params, alone, seen)
    assert both > 0 and both == pytest.approx(position_error_mm(CONFIG, params, first, seen), rel=1e-4)
