"""Clones the guide into the policy network by DAgger (Ross et al. 2011), before PPO starts."""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from brax.training.acme import running_statistics

from ddgrasp import contract
from ddgrasp.config import TeacherConfig
from ddgrasp.errors import UserError
from ddgrasp.layout import ACTION
from ddgrasp.progress import Progress
from learning.programs import Program, shape
from mjx_envs.grasp_env import GraspEnv
from mjx_envs.physics.interface import warn_of_dropped
from ppo import learner
from ppo.guide import guide
from ppo.policy import TeacherPolicy, from_learner

BATCH = 1024
LEARNING_RATE = 2e-3
ACTION_NOISE = 0.2
NOISE_SHARE = 0.3
_SEED = 60_000


def clone_guide(
    config: TeacherConfig, env: GraspEnv, state: learner.LearnerState, seed: int, progress: Progress
) -> tuple[Any, running_statistics.RunningStatisticsState]:
    """The guide's policy in the networks of `state`, and its observations' statistics.

    On one device of this process: the batches are small.
    """
    policy, normalizer = jax.tree.map(
        lambda x: jnp.asarray(np.asarray(x)), (state.params.policy, state.normalizer)
    )
    opt_state = _optimizer(config).init(policy)
    observations, labels = [], []
    rng = np.random.default_rng([seed, _SEED])
    collect = Collector(env, config.clone_envs)
    fit, _ = program(config, state)
    with progress.task("cloning the guide", config.clone_rounds) as task:
        for i in range(config.clone_rounds):
            share = guide_share(i, config.clone_rounds)
            numbers = jax.tree.map(np.asarray, (normalizer, policy))
            seen, label = collect(from_learner(*numbers), _SEED + 1000 * seed + i, share)
            observations.append(seen)
            labels.append(label)
            normalizer = running_statistics.update(
                normalizer, jnp.asarray(seen), std_min_value=learner.OBSERVATION_STD_MIN
            )
            everything, wanted = np.concatenate(observations), np.concatenate(labels)
            index = rng.integers(0, len(everything), (config.clone_steps, BATCH))
            policy, opt_state, loss = fit(normalizer, policy, opt_state, everything[index], wanted[index])
            if not np.isfinite(loss):
                raise UserError(
                    f"Cloning the guide diverged in round {i}: clone_loss is {float(loss)}. Check "
                    "world.random and world.sim_dt_s."
                )
            progress.scalars(i, clone_loss=float(loss))
            task.advance(loss=float(loss))
    return policy, normalizer


def program(config: TeacherConfig, state: learner.LearnerState) -> Program:
    """The optimiser steps of a round, from a learner's state, of which shapes will do."""
    optimizer, policy = _optimizer(config), state.params.policy
    seen, wanted = (
        shape(config.clone_steps, BATCH, size) for size in (contract.OBSERVATION_SIZE, contract.ACTION_SIZE)
    )
    opt_state = jax.eval_shape(optimizer.init, policy)
    return jax.jit(partial(_fit, optimizer)), (state.normalizer, policy, opt_state, seen, wanted)


def _optimizer(config: TeacherConfig) -> optax.GradientTransformation:
    return optax.adam(optax.cosine_decay_schedule(LEARNING_RATE, config.clone_rounds * config.clone_steps))


def guide_share(number: int, rounds: int) -> float:
    """Share of the actions that the guide takes in round `number`, from 0: all, a half, a quarter, and none
    in the last, unless that is the only one, of which a policy that has seen nothing would make nothing."""
    return 0.5**number if number < max(1, rounds - 1) else 0.0


class Collector:
    """Whole episodes acted by a mix of guide and policy. A host loop over small programs."""

    def __init__(self, env: GraspEnv, count: int):
        self._count, self._steps = count, env.config.episode_steps
        self._reset = jax.jit(jax.vmap(env.reset))
        self._step = jax.jit(jax.vmap(env.step))
        self._guide = jax.jit(jax.vmap(guide))

    def __call__(self, policy: TeacherPolicy, seed: int, guide_share: float) -> tuple[np.ndarray, np.ndarray]:
        """Observations (N, 40) and the guide's actions there (N, 8)."""
        rng = np.random.default_rng(seed)
        state = self._reset(jax.random.split(jax.random.PRNGKey(seed), self._count))
        alive = np.ones(self._count, bool)
        observations, labels = [], []
        dropped = 0.0
        for _ in range(self._steps):
            seen = np.asarray(state.obs)
            label = np.asarray(self._guide(state.obs))
            observations.append(seen[alive])
            labels.append(label[alive])
            guided = rng.random((self._count, 1)) < guide_share
            noise = (
                ACTION_NOISE * rng.standard_normal(label.shape) * (rng.random((self._count, 1)) < NOISE_SHARE)
            )
            noise[:, ACTION.gripper] = 0.0
            action = np.clip(np.where(guided, label, policy(seen)) + noise, -1, 1)
            state = self._step(state, action.astype(np.float32))
            dropped += float(np.asarray(state.metrics["contacts_dropped"])[alive].sum())
            alive &= np.asarray(state.done) == 0
        warn_of_dropped(dropped, sum(map(len, observations)))
        return np.concatenate(observations), np.concatenate(labels)


def _fit(optimizer, normalizer, policy_params, opt_state, observations, labels):
    """One optimiser step for each batch in observations (S, B, 40) and labels (S, B, 8)."""

    def loss_fn(params, batch):
        observation, label = batch
        return jnp.mean((from_learner(normalizer, params)(observation, jnp) - label) ** 2)

    def step(carry, batch):
        params, opt_state = carry
        loss, grads = jax.value_and_grad(loss_fn)(params, batch)
        updates, opt_state = optimizer.update(grads, opt_state)
        return (optax.apply_updates(params, updates), opt_state), loss

    (params, opt_state), losses = jax.lax.scan(step, (policy_params, opt_state), (observations, labels))
    return params, opt_state, losses[-10:].mean()
