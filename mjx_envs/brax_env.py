"""The grasping task in Brax's registry: importing this module registers `ddgrasp_pick`.

Brax's own wrappers keep the physics under another name than Playground's. Brax's training takes Playground's
environments as well: `mjx_envs/playground_env.py` with `mujoco_playground.wrapper` needs nothing of this.
"""

from collections.abc import Mapping
from typing import Any

import jax
import mujoco_playground
from brax import envs
from jaxtyping import Float
from ml_collections import config_dict

from ddgrasp.errors import UserError
from mjx_envs import randomize
from mjx_envs.playground_env import PickEnv

NAME = "ddgrasp_pick"


class BraxPick(envs.Env):
    """`PickEnv` with Brax's `State`, whose `pipeline_state` is the `PhysicsState`.

    Args:
      config: as `PickEnv` takes it.
      config_overrides: as `PickEnv` takes them.
    """

    def __init__(
        self,
        config: config_dict.ConfigDict | None = None,
        config_overrides: Mapping[str, Any] | None = None,
    ):
        self._env = PickEnv(config, config_overrides)

    def reset(self, rng: randomize.Key) -> envs.State:
        """A new episode drawn from `rng` (2,)."""
        return _to_brax(self._env.reset(rng))

    def step(self, state: envs.State, action: Float[jax.Array, "8"]) -> envs.State:
        """One control step with `action` (8,)."""
        data: Any = state.pipeline_state
        inner = mujoco_playground.State(
            data, state.obs, state.reward, state.done, state.metrics, state.info
        )  # fmt: skip
        return _to_brax(self._env.step(inner, action))

    @property
    def observation_size(self) -> int:
        """40."""
        size = self._env.observation_size
        assert isinstance(size, int)
        return size

    @property
    def action_size(self) -> int:
        """8."""
        return self._env.action_size

    @property
    def sys(self) -> Any:
        """There is none of Brax's: UserError, for its wrapper of a `randomization_fn` above all."""
        raise UserError(
            f"{NAME} has no system of Brax's. A randomization_fn does nothing here: masses, friction, "
            "damping, gains and sizes are drawn by config.random (world.random), for each episode anew."
        )

    @property
    def backend(self) -> str:
        """The physics backend: jax, warp or cpu."""
        return self._env.config.backend


def _to_brax(state: mujoco_playground.State) -> envs.State:
    data: Any = state.data
    return envs.State(data, state.obs, state.reward, state.done, state.metrics, state.info)


envs.register_environment(NAME, BraxPick)
