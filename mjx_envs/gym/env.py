"""One environment behind Gymnasium's API."""

from typing import Any

import gymnasium
import jax
import numpy as np
from jaxtyping import Float, UInt8

from ddgrasp import contract
from ddgrasp.config import WorldConfig
from mjx_envs.gym.simulator import Scenes, draw_keys, simulator
from mjx_envs.gym.spaces import RENDER_MODES, action_space, check_render_mode, check_shape


class PickEnv(gymnasium.Env):
    """Grasp the object and hold it 40 cm up, at 10 Hz.

    Args:
      world: objects, physics backend, randomisation, reward, length of an episode; the defaults without.
      observation: state (the teacher's 40 numbers) or depth (the student's picture and joints).
      render_mode: rgb_array, or None for no pictures.
    """

    metadata = {"render_modes": [*RENDER_MODES], "render_fps": round(contract.CONTROL_HZ)}

    def __init__(
        self, world: WorldConfig | None = None, observation: str = "state", render_mode: str | None = None
    ):
        check_render_mode(render_mode)
        self._simulator = simulator(world)
        self.observation_space, self._kind = self._simulator.space(observation), observation
        self.action_space = action_space()
        self.render_mode = render_mode
        self._scenes: Scenes | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """A new episode: (observation, info). Everything drawn follows from `seed`; no `options` are read."""
        super().reset(seed=seed)
        self._scenes = self._simulator.begin(draw_keys([self.np_random]))
        return self._observation(self._scenes), self._info(self._scenes)

    def step(self, action: Float[np.ndarray, "8"]) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """One control step with `action` (8,): (observation, reward, terminated, truncated, info).

        Raises ValueError for an action of another shape.
        """
        check_shape(action, self.action_space)
        scenes = self._simulator.step(self._begun(), np.asarray(action, np.float32)[None])
        self._scenes, state = scenes, scenes.state
        reward, over, truncated = (
            np.asarray(values)[0].item() for values in (state.reward, state.done, state.info["truncation"])
        )
        terminated = over > 0 and not truncated
        return self._observation(scenes), reward, terminated, truncated > 0, self._info(scenes)

    def render(self) -> UInt8[np.ndarray, "height width 3"] | None:
        """(H, W, 3) what the depth camera would see in colour; None without a render mode."""
        return self._simulator.rgb(self._begun())[0] if self.render_mode == "rgb_array" else None

    def _begun(self) -> Scenes:
        if self._scenes is None:
            raise gymnasium.error.ResetNeeded("call reset() before step() or render()")
        return self._scenes

    def _observation(self, scenes: Scenes) -> Any:
        batch = self._simulator.observe(scenes, self._kind)
        return jax.tree.map(lambda values: values[0], batch)

    def _info(self, scenes: Scenes) -> dict[str, Any]:
        return {name: values.tolist()[0] for name, values in self._simulator.facts(scenes).items()}
