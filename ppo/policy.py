"""The trained teacher as a function from observation to action: in NumPy for the rig, in JAX for batches."""

from collections.abc import Mapping
from pathlib import Path
from types import ModuleType
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float

from ddgrasp import contract
from ddgrasp.arrays import AnyArray
from ddgrasp.errors import UserError
from ddgrasp.shipped import holding
from learning.params import load_params, save_params

PARAMS_FILE = "policy.msgpack"
_STD_MIN = 1e-6


@runtime_checkable
class Normalizer(Protocol):
    """Statistics of observations (40,), as far as a policy needs them: Brax's `RunningStatisticsState`."""

    @property
    def mean(self) -> Any:
        """(40,)."""

    @property
    def std(self) -> Any:
        """(40,)."""


class TeacherPolicy:
    """Deterministic action (the mode) of the PPO policy: an MLP on the normalised observation."""

    def __init__(self, mean: AnyArray, std: AnyArray, layers: list[tuple[AnyArray, AnyArray]]):
        self.mean, self.std, self.layers = mean, std, layers

    def __call__(
        self, observation: Float[AnyArray, "*batch 40"], xp: ModuleType = np
    ) -> Float[AnyArray, "*batch 8"]:
        """(..., 8) action in [-1, 1] for observation (..., 40). `xp`: numpy or jax.numpy."""
        x = (observation - self.mean) / self.std
        for kernel, bias in self.layers[:-1]:
            x = x @ kernel + bias
            x = xp.where(x > 0, x, xp.expm1(xp.minimum(x, 0.0)))
        kernel, bias = self.layers[-1]
        return xp.tanh((x @ kernel + bias)[..., : contract.ACTION_SIZE])


def save(path: Path, normalizer: Normalizer, policy_params: Mapping[str, Any]) -> None:
    """Writes what `load` reads. `policy_params`: Brax's policy network parameters."""
    layers = policy_params["params"]
    save_params(
        path,
        {
            "mean": np.asarray(normalizer.mean),
            "std": np.maximum(np.asarray(normalizer.std), _STD_MIN),
            "layers": {name: {k: np.asarray(v) for k, v in layer.items()} for name, layer in layers.items()},
        },
    )


def from_learner(normalizer: Normalizer, policy_params: Mapping[str, Any]) -> TeacherPolicy:
    """The policy of a learner's current parameters; works on traced arrays."""
    return _policy(normalizer.mean, normalizer.std, policy_params["params"])


def find(directory: Path | str) -> Path:
    """The parameter file in a stage directory, a run directory or a pretrained folder; UserError if none."""
    if found := holding(directory, PARAMS_FILE, "teacher"):
        return found / PARAMS_FILE
    raise UserError(f"{directory} holds no teacher ({PARAMS_FILE}): train one with `ddgrasp teacher train`.")


def load_state(directory: Path | str) -> dict:
    """The saved parameters: normaliser's mean and std, and the layers."""
    path = find(directory)
    state = load_params(path)
    if state["mean"].shape != (contract.OBSERVATION_SIZE,):
        raise UserError(
            f"The teacher in {path} takes {state['mean'].shape[0]} inputs, this contract "
            f"{contract.OBSERVATION_SIZE}: train a new one."
        )
    return state


def load(directory: Path | str) -> TeacherPolicy:
    """The teacher in a stage directory, a run directory or a pretrained folder."""
    state = load_state(directory)
    return _policy(state["mean"], state["std"], state["layers"])


def _policy(mean: AnyArray, std: AnyArray, layers: Mapping[str, Any]) -> TeacherPolicy:
    ordered = [layers[f"hidden_{i}"] for i in range(len(layers))]
    return TeacherPolicy(mean, std, [(layer["kernel"], layer["bias"]) for layer in ordered])
