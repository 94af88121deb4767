"""PPO from nothing improves a policy: a small problem, from 1 of 64 to nearly always in some 80,000 steps."""

from dataclasses import replace

import jax.numpy as jnp
import optax
import pytest

from ddgrasp.config import Config, RandomConfig, RewardConfig, TeacherConfig, WorldConfig
from mjx_envs.grasp_env import AutoReset, GraspEnv
from ppo import learner
from ppo.evaluate import evaluate
from ppo.train import compile_iteration, initial, policy_of

TEACHER = TeacherConfig(
    start="nothing", total_steps=160_000, num_envs=256, unroll_steps=10, minibatches=4, learning_rate=6e-4,
    target_kl=0.03, critic_learning_rate=1e-3, discount=0.95, action_std=0.2, gripper_std=0.5, min_std=0.2,
    entropy_cost=0.0, hidden=(128, 64), critic_warmup=0, bootstrap_time_limit=True,
)  # fmt: skip
WORLD = WorldConfig(
    objects=("apple",), episode_steps=20, random=RandomConfig(held_share=1.0),
    reward=RewardConfig(grasp=0.5, lift=20.0, align=0.0, reach=0.0),
)  # fmt: skip
"""Episodes start with the apple in the open hand, anywhere up to the lift target: close, lift, hold."""
TRIALS = 64
SEED = 3
"""Learns by iteration 30 of 60, seed 4 by 35, seed 2 by 40, whatever order XLA adds in; seed 1 never does in
60."""


def test_ppo_from_nothing_learns_to_lift_and_hold():
    config = Config("test", teacher=TEACHER, seed=SEED)
    env = AutoReset(GraspEnv(WORLD))
    state, iterate = initial(config, env)(), compile_iteration(config, env)

    def successes() -> int:
        return evaluate(env.env, policy_of(state), TRIALS, seed=1)["success"]["successes"]

    before = successes()
    after, metrics = 0, {}
    for iteration in range(1, TEACHER.iterations + 1):
        state, metrics, _ = iterate(state)
        if iteration % 5 == 0 and (after := successes()) > 0.95 * TRIALS:
            break  # the bound is of its steps; most of the test's time is physics
    assert before < 0.2 * TRIALS
    assert after > 0.6 * TRIALS
    shown = {name: float(value) for name, value in metrics.items()}
    assert shown["episode/length"] == WORLD.episode_steps and shown["episode/return"] > 20.0
    assert 0.5 < shown["value/explained_variance"] <= 1.0
    assert 0.0 < shown["policy/kl"] < 0.3 and 0.0 < shown["policy/clip_fraction"] < 1.0
    assert 0.05 < shown["policy/std"] < TEACHER.action_std + TEACHER.gripper_std


@pytest.mark.parametrize(("kl", "expected"), [(1.0, 4e-4), (0.001, 9e-4), (0.03, 6e-4)])
def test_the_step_size_follows_the_divergence_of_an_update(kl, expected):
    optimizer = learner.make_optimizer(TEACHER)
    params = learner.network_params({"w": jnp.zeros(2)}, {"w": jnp.zeros(2)})
    state = learner.steered(optimizer.init(params), jnp.asarray(kl), TEACHER.target_kl)
    assert float(optax.tree_utils.tree_get(state, "learning_rate")) == pytest.approx(expected)
    for _ in range(20):
        state = learner.steered(state, jnp.asarray(1.0), TEACHER.target_kl)
    assert float(optax.tree_utils.tree_get(state, "learning_rate")) == pytest.approx(learner.STEERED_RATE_MIN)


@pytest.mark.parametrize(
    ("settle_from", "expected"),
    [(1.0, [0, 0, 0, 0, 0]), (0.6, [0, 0, 0, 0.5, 1]), (0.0, [0.2, 0.4, 0.6, 0.8, 1])],
)
def test_training_settles_in_its_last_iterations(settle_from, expected):
    teacher = replace(
        TEACHER, total_steps=5 * TEACHER.num_envs * TEACHER.unroll_steps, settle_from=settle_from
    )
    assert [float(learner.settling(teacher, jnp.asarray(i))) for i in range(5)] == pytest.approx(expected)
