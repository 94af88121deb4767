"""One teacher on several physics backends."""

from collections.abc import Iterator, Sequence
from dataclasses import replace

from ddgrasp.config import WorldConfig
from mjx_envs.grasp_env import GraspEnv
from ppo.evaluate import evaluate
from ppo.policy import TeacherPolicy

DEFAULT_TRIALS = {"cpu": 1000, "jax": 200, "warp": 1000}
"""Episodes by backend: on two CPU cores MJX-JAX takes minutes for so many, the C engine seconds."""


def evaluate_backends(
    world: WorldConfig, policy: TeacherPolicy, backends: Sequence[str], trials: int | None, seed: int
) -> Iterator[tuple[str, dict]]:
    """(backend, what `ppo.evaluate.evaluate` gives) for each; `trials` None takes DEFAULT_TRIALS.

    UserError for a backend that is unknown or cannot run here, before any has run.
    """
    environments = {name: GraspEnv(replace(world, backend=name)) for name in backends}
    for name, env in environments.items():
        yield name, evaluate(env, policy, DEFAULT_TRIALS[name] if trials is None else trials, seed)
