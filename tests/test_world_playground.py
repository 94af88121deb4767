"""The grasping task in Playground's and Brax's registries, under the wrappers of both."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax import envs
from mujoco_playground import manipulation, registry, wrapper
from mujoco_playground.config import manipulation_params

from ddgrasp.config import RandomConfig, WorldConfig
from ddgrasp.errors import UserError
from mjx_envs import brax_env, playground_env

ON_CPU = {"impl": "cpu", "objects": ("cube",)}


@pytest.fixture(autouse=True, scope="module")
def no_download():
    """Playground's `load` clones MuJoCo Menagerie for every environment of manipulation, needed or not."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(manipulation.mjx_env, "ensure_menagerie_exists", lambda: None)
        yield


@pytest.fixture(scope="module")
def rollout(no_download):
    """(environment, first state, the seven after it) of a batch of two, in episodes of three steps."""
    loaded = registry.load(playground_env.NAME, config_overrides=ON_CPU)
    env = wrapper.wrap_for_brax_training(loaded, episode_length=3)
    first = state = jax.jit(env.reset)(jax.random.split(jax.random.PRNGKey(0), 2))
    actions = jax.random.uniform(jax.random.PRNGKey(1), (3, 2, 8), minval=-1.0)
    step, seen = jax.jit(env.step), []
    for i in range(7):
        state = step(state, actions[i % 3])
        seen.append(state)
    return env, first, seen


def structure(tree) -> tuple:
    return jax.tree.structure(tree), [(leaf.shape, leaf.dtype) for leaf in jax.tree.leaves(tree)]


def traced(env, keys) -> list[tuple]:
    """What reset and step return, by structure: alike, as a scan needs."""
    state = jax.eval_shape(env.reset, keys)
    action = jax.ShapeDtypeStruct((*state.done.shape, env.action_size), jnp.float32)
    return [structure(state), structure(jax.eval_shape(env.step, state, action))]


def test_numbers_of_64_bits_are_refused():
    jax.config.update("jax_enable_x64", True)
    try:
        with pytest.raises(UserError, match="jax_enable_x64 is on"):
            playground_env.PickEnv()
    finally:
        jax.config.update("jax_enable_x64", False)


def test_the_configuration_is_the_worlds_under_playgrounds_names():
    config = registry.get_default_config(playground_env.NAME)
    assert (config.ctrl_dt, config.sim_dt, config.episode_length, config.impl) == (0.1, 0.005, 60, "jax")
    assert playground_env.world_config(config) == WorldConfig(backend="jax")
    overrides = ON_CPU | {"random.size": 0.1, "episode_length": 30}
    env = registry.load(playground_env.NAME, config_overrides=overrides)
    assert env.unwrapped.config == WorldConfig(
        objects=("cube",), episode_steps=30, random=RandomConfig(size=0.1)
    )
    assert (env.observation_size, env.action_size, env.dt, env.n_substeps) == (40, 8, 0.1, 20)
    with pytest.raises(UserError, match="ctrl_dt is 0.02"):
        registry.load(playground_env.NAME, config_overrides={"ctrl_dt": 0.02})
    with pytest.raises(UserError, match="action_repeat is 2; expected 1"):
        registry.load(playground_env.NAME, config_overrides={"action_repeat": 2})
    with pytest.raises(ValueError, match="Unsupported env"):  # its own answer, not a missing field's
        manipulation_params.brax_ppo_config(playground_env.NAME)
    for ours, theirs in playground_env._PLAYGROUND_NAMES.items():
        with pytest.raises(UserError, match=f"'{ours}' has Playground's name here: write '{theirs}'"):
            playground_env.PickEnv(config_overrides={ours: WorldConfig().__dict__[ours]})
    with config.unlocked():
        config.sim_dtt = 0.005
    with pytest.raises(UserError, match="'sim_dtt'. Did you mean 'sim_dt'"):
        registry.load(playground_env.NAME, config=config)


def test_episodes_repeat_under_playgrounds_wrapper(rollout):
    """It puts each episode's first state back: the same actions then earn the same again, step by step."""
    _, first, seen = rollout
    done = np.array([s.done for s in seen])
    assert done[:, 0].tolist() == [0, 0, 1, 0, 0, 1, 0]
    np.testing.assert_array_equal(done, [s.info["truncation"] for s in seen])  # nothing was lost
    rewards = np.array([s.reward for s in seen])
    np.testing.assert_array_equal(rewards[:3], rewards[3:6])
    np.testing.assert_array_equal(seen[2].obs, first.obs)
    assert np.abs(rewards).min() > 0 and seen[6].info["episode"].steps.tolist() == [1, 1]
    metrics = seen[5].info["episode_metrics"]
    np.testing.assert_array_equal(metrics["length"], [3, 3])
    np.testing.assert_allclose(metrics["sum_reward"], rewards[3:6].sum(axis=0), rtol=1e-6)


def _with_one_lost(state: Any, data: str) -> Any:
    """The first environment's object beyond reach."""
    return state.tree_replace({f"{data}.qpos": getattr(state, data).qpos.at[0, 9].set(1.5)})


def _ends_alone_and_begins_again(first: Any, step: Any, data: str) -> None:
    ended = step(_with_one_lost(first, data), jnp.zeros((2, 8)))
    assert ended.done.tolist() == [1, 0] and ended.info["truncation"].tolist() == [0, 0]
    np.testing.assert_array_equal(ended.obs[0], first.obs[0])  # put back
    after = step(ended, jnp.zeros((2, 8)))
    assert after.done.tolist() == [0, 0] and after.info["episode"].steps.tolist() == [1, 2]
    assert abs(float(getattr(after, data).qpos[0, 9]) - float(getattr(first, data).qpos[0, 9])) < 0.01


def test_an_episode_whose_object_is_lost_ends_alone_and_no_time_was_up(rollout):
    env, first, _ = rollout
    _ends_alone_and_begins_again(first, jax.jit(env.step), "data")


def test_playgrounds_render_shows_the_object_in_its_place(rollout, open_gl):
    env, first, _ = rollout
    state = jax.tree.map(lambda leaf: leaf[0], first)
    gone = state.tree_replace({"data.qpos": state.data.qpos.at[9].add(9.0)})
    shown, without = env.render([state, gone], height=120, width=160)
    colour = np.array(env.unwrapped.table.rgb[0][0])  # the cube's colour, on its first slot
    changed = np.abs(shown.astype(float) - without).max(axis=-1) > 30
    assert shown.shape == (120, 160, 3) and 5 < changed.sum() < 100
    mean = shown[changed].mean(axis=0) / shown[changed].mean()
    np.testing.assert_allclose(mean, colour / colour.mean(), atol=0.1)


@pytest.mark.parametrize("full_reset", [False, True])
def test_playgrounds_wrapper_can_be_scanned(full_reset):
    loaded = registry.load(playground_env.NAME, config_overrides=ON_CPU)
    env = wrapper.wrap_for_brax_training(loaded, episode_length=60, action_repeat=2, full_reset=full_reset)
    start, after = traced(env, jax.ShapeDtypeStruct((4, 2), jnp.uint32))
    assert start == after


def test_braxs_own_wrappers_take_it():
    """`envs.create` wraps in EpisodeWrapper, VmapWrapper and AutoResetWrapper."""
    wrapped = env = envs.create(brax_env.NAME, episode_length=60, batch_size=4, config_overrides=ON_CPU)
    names = []
    while isinstance(env, envs.Wrapper):
        names.append(type(env).__name__)
        env = env.env
    assert names == ["AutoResetWrapper", "VmapWrapper", "EpisodeWrapper"]
    assert (env.observation_size, env.action_size, env.backend) == (40, 8, "cpu")
    start, after = traced(wrapped, jax.ShapeDtypeStruct((2,), jnp.uint32))
    assert start == after


@pytest.mark.parametrize("of", ["brax", "playground"])
def test_braxs_training_evaluates_it(of):
    """`EvalWrapper`, around what `brax.training` trains on, keeps a metric of its own in the state."""
    env: Any
    if of == "brax":
        env = envs.create(brax_env.NAME, episode_length=2, batch_size=4, config_overrides=ON_CPU)
        keys = jax.random.PRNGKey(0)
    else:
        loaded = playground_env.PickEnv(config_overrides=ON_CPU)
        env = wrapper.wrap_for_brax_training(loaded, episode_length=2)
        keys = jax.random.split(jax.random.PRNGKey(0), 4)
    env = envs.training.EvalWrapper(env)
    state = jax.jit(env.reset)(keys)
    step, rewards = jax.jit(env.step), []
    for _ in range(3):  # into the next episode, which does not count
        state = step(state, jnp.full((4, 8), 0.3))
        rewards.append(np.asarray(state.reward))
    counted: Any = state.info["eval_metrics"]
    np.testing.assert_allclose(counted.episode_metrics["reward"], rewards[0] + rewards[1], rtol=1e-6)
    assert counted.episode_steps.tolist() == [2, 2, 2, 2]


def test_under_braxs_wrappers_too_a_lost_object_ends_one_episode_alone():
    env = envs.create(brax_env.NAME, episode_length=4, batch_size=2, config_overrides=ON_CPU)
    first = jax.jit(env.reset)(jax.random.PRNGKey(0))
    _ends_alone_and_begins_again(first, jax.jit(env.step), "pipeline_state")


def test_a_randomisation_function_is_refused_with_what_there_is_instead():
    def mine(model, *_):
        return model, None

    with pytest.raises(UserError, match=r"no system of Brax's. A randomization_fn .*: .*config\.random"):
        envs.training.wrap(brax_env.BraxPick(config_overrides=ON_CPU), randomization_fn=mine)
    loaded = playground_env.PickEnv(config_overrides=ON_CPU)
    env = wrapper.wrap_for_brax_training(loaded, randomization_fn=mine)
    with pytest.raises(UserError, match=r"randomization_fn .*: .*config\.random"):
        env.reset(jax.random.split(jax.random.PRNGKey(0), 2))


def test_episodes_repeat_under_braxs_wrappers():
    """AutoResetWrapper puts each episode's first state back: the same actions earn the same again."""
    env = envs.create(brax_env.NAME, episode_length=3, batch_size=2, config_overrides=ON_CPU)
    first = state = jax.jit(env.reset)(jax.random.PRNGKey(0))
    actions = jax.random.uniform(jax.random.PRNGKey(1), (3, 2, 8), minval=-1.0)
    step, seen = jax.jit(env.step), []
    for i in range(6):
        state = step(state, actions[i % 3])
        seen.append(state)
    assert [s.done.tolist() for s in seen] == [[0, 0], [0, 0], [1, 1]] * 2
    rewards = np.array([s.reward for s in seen])
    np.testing.assert_array_equal(rewards[:3], rewards[3:])
    assert np.abs(rewards).min() > 0 and (rewards[:, 0] != rewards[:, 1]).all()
    np.testing.assert_array_equal(seen[2].obs, first.obs)
