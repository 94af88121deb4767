"""NaN guard: what is watched in every iteration, and the error that names the first term to go wrong."""

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ddgrasp import contract
from ddgrasp.arrays import AnyArray
from ddgrasp.errors import UserError

ORDER = ("observation", "action", "reward", "loss", "gradient", "state")
"""Kinds of terms, causes before what they spoil within one iteration."""
SUM = "loss/total_loss"
"""Not watched: the terms of the sum are."""
_REMEDY = {
    "observation": "check world.random and world.sim_dt_s",
    "reward": "lower the weight of that term under world.reward",
}
_LOWER_RATES = "lower teacher.learning_rate or teacher.critic_learning_rate"


def watch(observation: jax.Array, action: jax.Array, metrics: Mapping[str, jax.Array], state: Any) -> dict:
    """Term -> () number that is not finite if any of the term's numbers is not.

    Args:
      observation: (..., 40).
      action: (..., 8).
      metrics: means by name; those whose name starts with a kind in ORDER are watched.
      state: the learner's new state, a dataclass.
    """
    ends = np.cumsum(list(contract.OBSERVATION_PARTS.values()))[:-1]
    parts = zip(contract.OBSERVATION_PARTS, jnp.split(observation, ends, axis=-1), strict=True)
    watched = {f"observation/{name}": _worst(part) for name, part in parts} | {"action": _worst(action)}
    watched |= {name: x for name, x in metrics.items() if _kind(name) in ORDER and name != SUM}
    return watched | {f"state/{name}": _worst(part) for name, part in vars(state).items()}


def check(iteration: int, watched: Mapping[str, AnyArray], saved: int | None, directory: Any) -> None:
    """UserError naming the first term that is not finite; `saved` is the iteration of the last checkpoint."""
    wrong = {name: float(value) for name, value in watched.items() if not np.isfinite(value)}
    if not wrong:
        return
    first = min(wrong, key=lambda name: (ORDER.index(_kind(name)), name))
    remedy = _REMEDY.get(_kind(first), _LOWER_RATES)
    if saved is None:
        kept = "Nothing was saved yet"
    else:
        kept = (
            f"The checkpoint of iteration {saved} is sound: --resume goes on from it, to the same end unless "
            "the machine was at fault"
        )
    raise UserError(
        f"PPO diverged at iteration {iteration}: {first} is {wrong[first]}. {kept}. For a new run, {remedy}; "
        f"--teacher.start {directory} --teacher.critic-warmup 10 starts it from the best policy so far."
    )


def _kind(name: str) -> str:
    return name.partition("/")[0]


def _worst(tree: Any) -> jax.Array:
    """() the largest magnitude in a tree of arrays; NaN if there is one."""
    leaves = [x for x in jax.tree.leaves(tree) if jnp.issubdtype(x.dtype, jnp.floating)]
    return jnp.max(jnp.stack([jnp.max(jnp.abs(x)) for x in leaves])) if leaves else jnp.zeros(())
