"""Cloning the guide: the policy learns its actions, the normaliser what was seen, and no NaN gets through."""

from typing import Any

import jax
import numpy as np
import pytest

from ddgrasp.config import TeacherConfig, WorldConfig
from ddgrasp.errors import UserError
from ddgrasp.layout import OBSERVATION
from ddgrasp.progress import Progress
from mjx_envs.grasp_env import GraspEnv
from ppo import learner, warmup
from ppo.policy import TeacherPolicy, from_learner
from teacher_support import learner_without_envs, still_teacher

TEACHER = TeacherConfig(
    start="guide", clone_rounds=2, clone_steps=200, clone_envs=64, hidden=(64,), gripper_std=0.4
)
STEPS = 8
ENV = GraspEnv(WorldConfig(objects=("cube",), episode_steps=STEPS))
UNSEEN = 123
"""Seed of episodes that cloning does not draw: its own begin at 60,000."""


class Collected(warmup.Collector):
    """Keeps what it collects; compiled once for all tests."""

    def __init__(self, env: GraspEnv, count: int):
        super().__init__(env, count)
        self.kept: list[np.ndarray] = []
        self.shares: list[float] = []

    def __call__(self, policy: TeacherPolicy, seed: int, guide_share: float) -> tuple[np.ndarray, np.ndarray]:
        """See `warmup.Collector`."""
        observations, labels = super().__call__(policy, seed, guide_share)
        self.kept.append(observations)
        self.shares.append(guide_share)
        return observations, labels


@pytest.fixture(scope="module")
def collector() -> Collected:
    return Collected(ENV, TEACHER.clone_envs)


@pytest.fixture
def clone(collector, monkeypatch):
    """Clones into a fresh learner by way of `collector`."""
    monkeypatch.setattr(warmup, "Collector", lambda env, count: collector)
    collector.kept, collector.shares = [], []

    def cloned():
        state = learner_without_envs(TEACHER)
        return state, *warmup.clone_guide(TEACHER, ENV, state, 0, Progress(quiet=True))

    return cloned


def test_the_clone_acts_as_the_guide_does_where_it_has_never_been(clone, collector):
    fresh, policy, normalizer = clone()
    kept, shares = np.concatenate(collector.kept), list(collector.shares)
    seen, wanted = collector(from_learner(normalizer, policy), UNSEEN, 0.5)

    def off(normalizer, params) -> float:
        acted = from_learner(*jax.tree.map(np.asarray, (normalizer, params)))(seen)
        return float(np.sqrt(np.mean((acted - wanted) ** 2)))

    cloned, spread = off(normalizer, policy), np.sqrt(np.mean(wanted.var(0)))
    assert cloned < 0.5 * off(fresh.normalizer, fresh.params.policy)
    assert cloned < 0.7 * spread  # one action for all observations is off by that
    assert shares == [1.0, 0.0]
    assert len(kept) == int(normalizer.count) == TEACHER.clone_rounds * TEACHER.clone_envs * STEPS
    np.testing.assert_allclose(normalizer.mean, kept.mean(0), rtol=1e-4, atol=1e-5)
    std = np.maximum(kept.std(0), learner.OBSERVATION_STD_MIN)
    np.testing.assert_allclose(normalizer.std, std, rtol=1e-3)


def test_every_round_of_cloning_is_of_episodes_of_its_own(clone, collector):
    clone()
    first, second = (seen[: TEACHER.clone_envs] for seen in collector.kept)  # the first step of each
    assert len(np.unique(np.concatenate([first, second]), axis=0)) == 2 * TEACHER.clone_envs


def test_what_a_clone_explores_with_is_action_std_whatever_it_sees(clone, collector):
    _, policy, normalizer = clone()
    seen, networks = np.concatenate(collector.kept), learner.make_networks(TEACHER)
    logits = networks.policy_network.apply(normalizer, policy, seen)
    noise: Any = networks.parametric_action_distribution
    std = noise.create_dist(logits).scale
    asked = [TEACHER.action_std] * 7 + [TEACHER.gripper_std]
    floor = TEACHER.min_std * np.array(asked) / np.log(2)
    np.testing.assert_allclose(std - floor, np.broadcast_to(asked, std.shape), rtol=0.1)


def test_a_clone_that_diverges_ends_in_one_line(clone, monkeypatch):
    monkeypatch.setattr(warmup, "LEARNING_RATE", float("nan"))
    with pytest.raises(UserError, match="Cloning the guide diverged in round 0: clone_loss is nan") as error:
        clone()
    assert "\n" not in str(error.value)


def test_the_guide_acts_in_its_share_and_the_policy_otherwise(collector, monkeypatch):
    """A policy of zeros stands still."""
    monkeypatch.setattr(warmup, "ACTION_NOISE", 0.0)
    moved = []
    for share in (0.0, 1.0):
        seen, _ = collector(still_teacher(), UNSEEN, share)
        arm = seen[:, OBSERVATION.arm].reshape(STEPS, -1, 7)
        moved.append(np.abs(arm[-1] - arm[0]).max(axis=1))
    assert moved[0].max() < 0.03 and moved[1].min() > 0.1
