"""What people look at while PPO trains: how far an update went, how well the critic foresees the returns."""

from typing import Any

import jax
import jax.numpy as jnp
from brax.training import types
from brax.training.agents.ppo import losses as ppo_losses
from brax.training.agents.ppo import networks as ppo_networks

from ddgrasp.config import TeacherConfig


def of_update(
    config: TeacherConfig,
    networks: ppo_networks.PPONetworks,
    normalizer: Any,
    data: types.Transition,
    value_before: Any,
    policy_after: Any,
) -> dict[str, jax.Array]:
    """Scalars about one iteration's update.

    Args:
      normalizer: of the observations, as the update used it.
      data: the experience it was made on, transitions (B, T, ...).
      value_before: the critic's parameters before it.
      policy_after: the actor's after it.

    Returns:
      policy/kl: KL divergence of the action distributions, KL(old || new), mean, nats.
      policy/clip_fraction: share of the actions whose probability moved further than PPO's clipping range.
      policy/std: mean standard deviation of the exploration noise, before the tanh.
      value/max: the largest value before the update; no more than what the reward can pay, in a sound one.
      value/explained_variance: 1 - Var(return - value) / Var(return), with the return as GAE estimates it
        and the value before the update: 1 foresees every return, 0 knows no more than their mean.
    """
    distribution: Any = networks.parametric_action_distribution
    logits = networks.policy_network.apply(normalizer, policy_after, data.observation)
    policy = data.extras["policy_extras"]
    new, old = distribution.create_dist(logits), distribution.create_dist(policy["distribution_params"])
    moved = jnp.exp(distribution.log_prob(logits, policy["raw_action"]) - policy["log_prob"])
    values, returns = _returns(config, networks, normalizer, data, value_before)
    return {
        "policy/kl": jnp.mean(new.kl_divergence(old)),
        "policy/clip_fraction": jnp.mean(jnp.abs(moved - 1.0) > config.clip),
        "policy/std": jnp.mean(new.scale),
        "value/max": jnp.max(values),
        "value/explained_variance": 1.0 - jnp.var(returns - values) / jnp.maximum(jnp.var(returns), 1e-8),
    }


def _returns(config: TeacherConfig, networks, normalizer, data: types.Transition, value_params):
    """(T, B) values and the returns that GAE makes of them and the rewards."""
    data = jax.tree.map(lambda x: jnp.swapaxes(x, 0, 1), data)
    values = networks.value_network.apply(normalizer, value_params, data.observation)
    last = networks.value_network.apply(normalizer, value_params, data.next_observation[-1])
    truncation = data.extras["state_extras"]["truncation"]
    returns, _ = ppo_losses.compute_gae(
        truncation=truncation,
        termination=(1 - data.discount) * (1 - truncation),
        rewards=data.reward * config.reward_scaling,
        values=values,
        bootstrap_value=last,
        lambda_=config.gae_lambda,
        discount=config.discount,
    )
    return values, returns
