"""Teachers made by hand: quick to have, and enough where nothing is learned."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from brax.training.acme import running_statistics, specs

from ddgrasp.config import TeacherConfig
from ppo import learner
from ppo.policy import TeacherPolicy


def learner_without_envs(config: TeacherConfig) -> learner.LearnerState:
    """A fresh learner of networks, normaliser and optimiser alone; its `env_state` is None."""
    key, networks = jax.random.key(0), learner.make_networks(config)
    params: Any = learner.network_params(learner.fresh_policy(config, key), networks.value_network.init(key))
    normalizer = running_statistics.init_state(specs.Array((40,), jnp.dtype("float32")))
    begun, zero = learner.make_optimizer(config).init(params), jnp.zeros((), jnp.int32)
    return learner.LearnerState(params, normalizer, begun, None, key, zero, zero)  # pyright: ignore


def still_teacher() -> TeacherPolicy:
    """A policy of zeros: the arm keeps its pose."""
    layer = np.zeros((40, 16), np.float32), np.zeros(16, np.float32)
    return TeacherPolicy(np.zeros(40, np.float32), np.ones(40, np.float32), [layer])
