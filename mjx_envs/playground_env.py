"""The grasping task in MuJoCo Playground's registry: importing this module registers `DdgraspPick`.

Playground's and Brax's wrappers count the steps and end an episode that is out of time; where one ended they
put its first state back, but leave what the environment keeps in `info` as it is. `PickEnv` is `GraspEnv` for
them.
"""

from collections.abc import Callable, Mapping, Sequence
from copy import copy
from dataclasses import asdict, fields, replace
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Float
from ml_collections import config_dict
from mujoco_playground import State, manipulation, render_array

from ddgrasp import contract
from ddgrasp.config import RandomConfig, RewardConfig, WorldConfig
from ddgrasp.errors import UserError, unknown_name
from mjx_envs import randomize
from mjx_envs.grasp_env import GraspEnv
from mjx_envs.physics.interface import ModelIndex

NAME = "DdgraspPick"
_PLAYGROUND_NAMES = {"sim_dt_s": "sim_dt", "episode_steps": "episode_length", "backend": "impl"}
"""`WorldConfig`'s field -> what Playground calls it."""
_COUNTED_BY_WRAPPERS = ("return", "length")
"""Metrics of `GraspEnv` that Brax's EpisodeWrapper sums up itself, one of them under the same name."""


def default_config() -> config_dict.ConfigDict:
    """`WorldConfig` under Playground's names (`ctrl_dt`, `sim_dt`, `episode_length`, `impl`), on MJX-JAX, and
    the `action_repeat` of 1 that Playground asks every environment for.

    `impl` is jax, warp (on an NVIDIA GPU) or cpu (MuJoCo's C engine, behind a call of the host).
    """
    world = asdict(WorldConfig(backend="jax"))
    named = {_PLAYGROUND_NAMES.get(name, name): value for name, value in world.items()}
    return config_dict.create(ctrl_dt=contract.CONTROL_DT_S, action_repeat=1, **named)


def world_config(config: config_dict.ConfigDict) -> WorldConfig:
    """The `WorldConfig` of what `default_config` made; UserError for a value or a name that it has not."""
    values: dict[str, Any] = config.to_dict()
    if (ctrl_dt := values.pop("ctrl_dt", contract.CONTROL_DT_S)) != contract.CONTROL_DT_S:
        raise UserError(f"ctrl_dt is {ctrl_dt!r}; expected {contract.CONTROL_DT_S:g}: the task has 10 Hz.")
    if (repeat := values.pop("action_repeat", 1)) != 1:
        raise UserError(f"action_repeat is {repeat!r}; expected 1: an action lasts a control step.")
    values = _in_our_names(values)
    for name, section in (("reward", RewardConfig), ("random", RandomConfig)):
        values[name] = section(**_known(section, values.get(name, {})))
    return WorldConfig(**_known(WorldConfig, values))


class PickEnv(GraspEnv):
    """`GraspEnv` for wrappers: `done` says that the object is lost, and never that time is up.

    Wrap it with the `episode_length` of its configuration, since success is what an episode's last steps say.

    Args:
      config: what `default_config` makes, changed; it is copied.
      config_overrides: flattened names -> values, for example {"random.size": 0.1, "impl": "cpu"}.
    """

    def __init__(
        self,
        config: config_dict.ConfigDict | None = None,
        config_overrides: Mapping[str, Any] | None = None,
    ):
        config = (config or default_config()).copy_and_resolve_references()
        config.update_from_flattened_dict(dict(config_overrides or {}))
        super().__init__(world_config(config))
        self._config = config.lock()

    def reset(self, rng: randomize.Key, exploring: randomize.Share = 1.0) -> State:
        """A new episode, as `GraspEnv.reset`; `info["first_episode"]` keeps how it began."""
        state = super().reset(rng, exploring)
        info = state.info | {"first_episode": state.info["episode"]}
        return replace(state, metrics=_without_counts(state.metrics), info=info)

    def step(self, state: State, action: Float[jax.Array, "8"]) -> State:
        """One control step with `action` (8,), as `GraspEnv.step`; see the class for `done`."""
        # A wrapper put the first state back: nothing moves and the solver has no last solution. A step leaves
        # no such state behind.
        put_back = jnp.all(state.data.qvel == 0) & jnp.all(state.data.warmstart == 0)
        first, now = state.info["first_episode"], state.info["episode"]
        episode = jax.tree.map(lambda a, b: jnp.where(put_back, a, b), first, now)
        new = super().step(replace(state, info=state.info | {"episode": episode}), action)
        lost = new.done * (1 - new.info["truncation"])
        # Wrappers keep metrics of their own there, and scan over this: what came in goes out.
        return replace(new, done=lost, metrics={**state.metrics, **_without_counts(new.metrics)})

    def render(
        self,
        trajectory: list[State] | State,
        height: int = 240,
        width: int = 320,
        camera: str | None = None,
        scene_option: mujoco.MjvOption | None = None,
        modify_scene_fns: Sequence[Callable[[mujoco.MjvScene], None]] | None = None,
    ) -> Any:
        """(height, width, 3) uint8 of each state of one environment, with its object, by MuJoCo's OpenGL.

        The object is that of the first state.
        """
        states = trajectory if isinstance(trajectory, list) else [trajectory]
        model = self._model_of(states[0])
        shown: Any = [SimpleNamespace(data=_data(model, state)) for state in states]
        return render_array(
            model, shown if states is trajectory else shown[0], height, width, camera,
            scene_option=scene_option, modify_scene_fns=modify_scene_fns,
        )  # fmt: skip

    @property
    def _mjx_model(self) -> Any:
        """What Playground's wrapper for a `randomization_fn` would replace, and no step reads."""
        raise UserError(
            "randomization_fn does nothing here: masses, friction, damping, gains and sizes are drawn by "
            "config.random (world.random), for each episode anew; leave it out."
        )

    def _model_of(self, state: State) -> mujoco.MjModel:
        """The scene with the object and the dynamics of the state's episode."""
        model, episode = copy(self.mj_model), state.info["episode"]
        index = ModelIndex(model)
        for name, value in index.fields(model, jax.tree.map(np.asarray, episode.params)).items():
            getattr(model, name)[:] = value
        model.geom_rgba[index.slots, :3] = self.table.rgb[int(episode.object_index)]
        return model


def _data(model: mujoco.MjModel, state: State) -> mujoco.MjData:
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = np.asarray(state.data.qpos), np.asarray(state.data.qvel)
    return data


def _in_our_names(values: Mapping[str, Any]) -> dict[str, Any]:
    """`values` under `WorldConfig`'s names; UserError for one of those that Playground calls otherwise."""
    for name in values:
        if theirs := _PLAYGROUND_NAMES.get(name):
            raise UserError(f"setting {name!r} has Playground's name here: write {theirs!r}.")
    ours = {theirs: name for name, theirs in _PLAYGROUND_NAMES.items()}
    return {ours.get(name, name): value for name, value in values.items()}


def _known(section: type, values: Mapping[str, Any]) -> Mapping[str, Any]:
    names = [field.name for field in fields(section)]
    for name in values:
        if name not in names:
            raise unknown_name("setting", name, [_PLAYGROUND_NAMES.get(known, known) for known in names])
    return values


def _without_counts(metrics: Mapping[str, jax.Array]) -> dict[str, jax.Array]:
    return {name: value for name, value in metrics.items() if name not in _COUNTED_BY_WRAPPERS}


manipulation.register_environment(NAME, PickEnv, default_config)
