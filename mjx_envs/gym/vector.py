"""Many environments behind Gymnasium's vector API, stepped as one batch on all cores.

Environment i of N does what the single environment does with seed `seed + i`.
"""

import operator
from collections.abc import Sequence
from typing import Any, SupportsIndex

import jax
import numpy as np
from gymnasium import error
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from jaxtyping import Bool, Float

from ddgrasp.config import WorldConfig
from ddgrasp.errors import UserError
from mjx_envs.gym.env import PickEnv
from mjx_envs.gym.simulator import Scenes, draw_keys, simulator
from mjx_envs.gym.spaces import action_space, check_render_mode, check_shape

Seeds = SupportsIndex | Sequence[SupportsIndex | None] | np.ndarray | None
Step = tuple[Any, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]
"""(observations, rewards (N,) float64, terminations (N,) bool, truncations (N,) bool, infos)."""


class PickVectorEnv(VectorEnv):
    """N environments of `PickEnv`.

    Args:
      num_envs: N.
      world: as for `PickEnv`.
      observation: as for `PickEnv`.
      render_mode: as for `PickEnv`.
      autoreset_mode: when a new episode begins where one ended: NextStep, SameStep or Disabled.
    """

    def __init__(
        self,
        num_envs: int = 1,
        world: WorldConfig | None = None,
        observation: str = "state",
        render_mode: str | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
    ):
        if num_envs < 1:
            raise UserError(f"num_envs is {num_envs}; expected 1 or more.")
        check_render_mode(render_mode)
        self._simulator = simulator(world)
        self._mode = AutoresetMode(autoreset_mode)
        self.metadata = PickEnv.metadata | {"autoreset_mode": self._mode}
        self.num_envs, self.render_mode = num_envs, render_mode
        self.single_observation_space, self._kind = self._simulator.space(observation), observation
        self.single_action_space = action_space()
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._generators = [seeding.np_random()[0] for _ in range(num_envs)]
        self._scenes: Scenes | None = None
        self._over = np.zeros(num_envs, bool)

    def reset(
        self, *, seed: Seeds = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """New episodes: (observations, infos).

        Args:
          seed: environment i's is `seed + i`; or one for each; None goes on with the random numbers.
          options: reset_mask, (N,) bool, which environments begin anew; all without.
        """
        seeds = _seeds(seed, self.num_envs)
        super().reset(seed=None if isinstance(seed, Sequence | np.ndarray) else seeds[0])
        everyone = np.ones(self.num_envs, bool)
        mask = np.asarray((options or {}).get("reset_mask", everyone))
        if len(seeds) != self.num_envs:
            raise UserError(f"seed has {len(seeds)} seeds; expected {self.num_envs}, or one number.")
        if mask.shape != (self.num_envs,) or mask.dtype != bool:  # numbers of environments, say
            raise UserError(
                f"reset_mask is {mask.dtype} {mask.shape}; expected bool ({self.num_envs},): True for each "
                "environment that begins anew."
            )
        for i, own in enumerate(seeds):
            if own is not None and mask[i]:
                self._generators[i] = seeding.np_random(own)[0]
        if mask.all() or self._scenes is None:
            self._scenes = self._simulator.begin(draw_keys(self._generators))
        else:
            self._scenes = self._begin_anew(self._scenes, mask)
        self._over = self._over & ~mask
        return self._observations(self._scenes), self._infos(self._scenes)

    def step(self, actions: Float[np.ndarray, "n 8"]) -> Step:
        """One control step with `actions` (N, 8). Raises ValueError for actions of another shape."""
        check_shape(actions, self.action_space)
        if self._scenes is None:
            raise error.ResetNeeded("call reset() before step()")
        begin = self._over if self._mode is AutoresetMode.NEXT_STEP else np.zeros(self.num_envs, bool)
        if self._mode is AutoresetMode.DISABLED and self._over.any():
            raise error.ResetNeeded("an episode is over: reset() with options reset_mask before step()")
        scenes = self._simulator.step(self._scenes, np.asarray(actions, np.float32))
        state = scenes.state
        truncations = (np.asarray(state.info["truncation"]) > 0) & ~begin
        terminations = (np.asarray(state.done) > 0) & ~truncations & ~begin
        rewards = np.where(begin, 0.0, np.asarray(state.reward, float))
        scenes = self._begin_anew(scenes, begin)
        self._over, final = terminations | truncations, {}
        if self._mode is AutoresetMode.SAME_STEP and self._over.any():
            final = self._final(scenes, self._over)
            scenes = self._begin_anew(scenes, self._over)
        self._scenes = scenes
        return self._observations(scenes), rewards, terminations, truncations, final | self._infos(scenes)

    def render(self) -> tuple[np.ndarray, ...] | None:
        """N pictures (H, W, 3), as `PickEnv.render`; None without a render mode."""
        if self.render_mode != "rgb_array":
            return None
        if self._scenes is None:
            raise error.ResetNeeded("call reset() before render()")
        return tuple(self._simulator.rgb(self._scenes))

    def _begin_anew(self, scenes: Scenes, which: Bool[np.ndarray, " n"]) -> Scenes:
        """New episodes where `which` (N,) says so; the other environments' random numbers stay."""
        if not which.any():
            return scenes
        keys = np.zeros((self.num_envs, 2), np.uint32)
        keys[which] = draw_keys([self._generators[i] for i in np.flatnonzero(which)])
        return self._simulator.renew(scenes, keys, which)

    def _observations(self, scenes: Scenes) -> Any:
        return self._simulator.observe(scenes, self._kind)

    def _infos(self, scenes: Scenes) -> dict[str, Any]:
        facts = self._simulator.facts(scenes)
        return facts | {f"_{name}": np.ones(self.num_envs, bool) for name in facts}

    def _final(self, scenes: Scenes, over: Bool[np.ndarray, " n"]) -> dict[str, Any]:
        """What Gymnasium's vector environments report of episodes that end in a step that begins others."""
        observations, facts = self._observations(scenes), self._simulator.facts(scenes)
        infos: dict[str, Any] = {}
        for i in np.flatnonzero(over):
            final = {
                "final_obs": jax.tree.map(lambda values, i=i: values[i].copy(), observations),
                "final_info": {name: values.tolist()[i] for name, values in facts.items()},
            }
            infos = self._add_info(infos, final, int(i))
        return infos


def _seeds(seed: Seeds, count: int) -> list[int | None]:
    """One for each of `count` environments, or as many as were given."""
    if seed is None:
        return [None] * count
    if isinstance(seed, Sequence | np.ndarray):
        return [None if own is None else operator.index(own) for own in seed]
    first = operator.index(seed)
    return [first + i for i in range(count)]
