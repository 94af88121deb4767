"""The grasping task behind Gymnasium's API: its own checks, and many environments against single ones."""

import re
import warnings
from pathlib import Path

import numpy as np
import pytest

gymnasium = pytest.importorskip("gymnasium", reason="needs pip install -e '.[gym]'")
from gymnasium.utils.env_checker import check_env, data_equivalence  # noqa: E402
from gymnasium.vector import AutoresetMode  # noqa: E402

from ddgrasp.config import WorldConfig  # noqa: E402
from ddgrasp.errors import UserError  # noqa: E402
from mjx_envs.gym.env import PickEnv  # noqa: E402
from mjx_envs.gym.spaces import action_space, check_shape  # noqa: E402
from mjx_envs.gym.vector import PickVectorEnv  # noqa: E402
from ppo import policy  # noqa: E402

ROOT = Path(__file__).parents[1]
ID = "mjx_envs.gym:ddgrasp/Pick-v0"
WORLD = WorldConfig(objects=("cube", "apple"), camera_scale=0.125)
"""That of docs/environment.md, so that all of this file shares what is compiled."""


def make_vec(mode: str = "vector_entry_point", **options):
    return gymnasium.make_vec(ID, num_envs=2, vectorization_mode=mode, world=WORLD, **options)


def assert_like(one, other) -> None:
    """Like `data_equivalence`, for what a batch of one and a batch of two compute; names what differs."""
    assert type(one) is type(other)
    if isinstance(one, dict):
        assert one.keys() == other.keys()
        for name in one:
            assert_like(one[name], other[name])
    elif isinstance(one, np.ndarray) and one.dtype != object:
        np.testing.assert_allclose(one, other, atol=2e-3)
        assert one.dtype == other.dtype
    else:
        assert data_equivalence(one, other)


@pytest.mark.parametrize("observation", ["state", "depth"])
def test_gymnasiums_own_check_has_nothing_to_say(observation):
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        check_env(gymnasium.make(ID, world=WORLD, observation=observation).unwrapped)
    assert [str(w.message) for w in said if "WARN" in str(w.message)] == []


@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
def test_an_environment_of_many_does_what_a_single_one_does(mode):
    """The pretrained teacher grasps in both, through an episode's end and into the next."""
    ours = make_vec(autoreset_mode=mode)
    singles = make_vec("sync", vector_kwargs={"autoreset_mode": mode})
    assert (ours.observation_space, ours.action_space) == (singles.observation_space, singles.action_space)
    assert ours.metadata["autoreset_mode"] is mode
    teacher = policy.load(ROOT / "pretrained")
    seen, info = ours.reset(seed=5)
    for mine, theirs in zip((seen, info), singles.reset(seed=5), strict=True):
        assert_like(mine, theirs)
    ended = []
    for _ in range(62):
        action = teacher(seen).astype(np.float32)
        seen, reward, terminated, truncated, info = made = ours.step(action)
        for mine, theirs in zip(made, singles.step(action), strict=True):
            assert_like(mine, theirs)
        assert seen in ours.observation_space and not terminated.any()
        ended.append(truncated.all())
    assert np.flatnonzero(ended).tolist() == [59]


def test_success_is_what_the_teachers_episodes_end_with():
    env, teacher = make_vec(), policy.load(ROOT / "pretrained")
    seen, info = env.reset(seed=5)
    for step in range(60):
        assert not info["success"].any(), step
        seen, *_, truncated, info = env.step(teacher(seen).astype(np.float32))
    assert truncated.all() and info["success"].all()


def test_an_object_knocked_off_the_table_ends_the_episode():
    """Thrown away by the physics' state itself: nothing an arm does is as sure."""
    env = gymnasium.make(ID, world=WORLD).unwrapped
    env.reset(seed=0)
    state = env._scenes.state
    away = state.data.replace(qpos=state.data.qpos.at[:, 9].set(1.5))
    env._scenes = env._scenes.replace(state=state.replace(data=away))
    *_, terminated, truncated, info = env.step(np.zeros(8, np.float32))
    assert (terminated, truncated, info["success"]) == (True, False, False)


@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
def test_of_many_the_one_whose_object_is_lost_ends_alone(mode):
    env = make_vec(autoreset_mode=mode)
    env.reset(seed=5)
    many = env.unwrapped
    state = many._scenes.state
    away = state.data.replace(qpos=state.data.qpos.at[0, 9].set(1.5))
    many._scenes = many._scenes.replace(state=state.replace(data=away))
    seen, _, terminated, truncated, info = env.step(np.zeros((2, 8), np.float32))
    assert (terminated.tolist(), truncated.tolist()) == ([True, False], [False, False])
    if mode is AutoresetMode.SAME_STEP:
        assert info["final_info"]["success"].tolist() == [False, False]
        assert (
            info["_final_info"].tolist() == [True, False] and abs(seen[0, 25]) < 1.0
        )  # the next one's object
    else:
        assert seen[0, 25] == pytest.approx(1.5, abs=0.01)


def test_an_action_that_is_not_finite_ends_the_episode_where_it_stands():
    """The C engine takes a NaN for 0 on every joint and swings the arm there."""
    env = gymnasium.make(ID, world=WORLD).unwrapped
    env.reset(seed=0)
    before = np.asarray(env._scenes.state.data.qpos)
    action = np.zeros(8, np.float32)
    action[3] = np.nan
    _, reward, terminated, truncated, _ = env.step(action)
    assert reward == 0 and (terminated, truncated) == (True, False)
    np.testing.assert_array_equal(np.asarray(env._scenes.state.data.qpos), before)


def test_an_action_of_another_length_is_refused():
    for shape, space in (((7,), action_space()), ((2, 8), action_space())):
        with pytest.raises(ValueError, match=r"the action has shape .*; expected \(8,\)"):
            check_shape(np.zeros(shape, np.float32), space)
    check_shape(np.zeros(8), action_space())


def test_without_autoreset_chosen_environments_begin_anew():
    env = make_vec(autoreset_mode="Disabled")
    before, _ = env.reset(seed=[3, None])
    again, _ = env.reset(seed=[3, 4], options={"reset_mask": np.array([True, False])})
    np.testing.assert_array_equal(again, before)
    other, _ = env.reset(options={"reset_mask": np.array([False, True])})
    np.testing.assert_array_equal(other[0], before[0])
    assert not np.array_equal(other[1], before[1])
    env.unwrapped._over[:] = True
    with pytest.raises(gymnasium.error.ResetNeeded, match="reset_mask"):
        env.step(np.zeros((2, 8), np.float32))


@pytest.mark.parametrize(
    ("mask", "said"),
    [
        ([0, 1], r"reset_mask is int64 \(2,\)"),  # numbers of environments, both of which were meant
        (np.array(["no", "no"]), r"reset_mask is <U2 \(2,\)"),
        ([True], r"reset_mask is bool \(1,\)"),
        (True, r"reset_mask is bool \(\)"),
    ],
)
def test_a_mask_that_is_none_is_refused_and_begins_nothing_anew(mask, said):
    env = make_vec(autoreset_mode="Disabled")
    env.reset(seed=3)
    before = env.unwrapped._scenes
    with pytest.raises(UserError, match=rf"^{said}; expected bool \(2,\): True for each environment that"):
        env.reset(options={"reset_mask": mask})
    assert env.unwrapped._scenes is before


def test_the_camera_is_drawn_apart_from_the_object():
    env = gymnasium.make_vec(ID, num_envs=256, vectorization_mode="vector_entry_point", world=WORLD)
    env.reset(seed=0)
    scenes = env.unwrapped._scenes
    episode = scenes.state.info["episode"]
    cubes = np.asarray(episode.object_index) == 0
    size = np.asarray(episode.rest_height)[cubes]
    for axis in np.asarray(scenes.T_world_cam)[cubes, :3, 3].T:
        assert abs(np.corrcoef(size, axis)[0, 1]) < 0.35  # 1 where one key draws both


def test_a_seed_may_be_a_number_of_numpy():
    env = make_vec()
    np.testing.assert_array_equal(env.reset(seed=np.int64(0))[0], env.reset(seed=0)[0])
    np.testing.assert_array_equal(env.reset(seed=np.arange(2))[0], env.reset(seed=0)[0])


def test_the_depth_picture_is_the_window_of_the_cameras():
    env = make_vec(observation="depth")
    seen, _ = env.reset(seed=0)
    simulator, scenes = env.unwrapped._simulator, env.unwrapped._scenes
    profile = WORLD.profile
    row, column = profile.crop_origin_px
    window = np.s_[:, row : row + profile.crop_height_px, column : column + profile.crop_width_px]
    whole = np.asarray(simulator._viewer.depth_mm(simulator._geoms(scenes), scenes.T_world_cam))[window]
    near = np.abs(1000 * seen["depth"] - whole) < 1
    assert seen["depth"].dtype == np.float32 and near.mean() > 0.999
    width = seen["state"][:, 7]
    np.testing.assert_allclose(width, 0.08, atol=1e-3)  # the gripper is open
    assert not np.array_equal(scenes.T_world_cam[0], scenes.T_world_cam[1])  # each has its own camera


def test_wrong_options_are_refused():
    with pytest.raises(UserError, match="observation 'dept'.*Did you mean 'depth'"):
        gymnasium.make(ID, observation="dept")
    for environment in (PickEnv, PickVectorEnv):
        with pytest.raises(UserError, match="render_mode 'human'.* Known: rgb_array"):
            environment(render_mode="human")
    with pytest.raises(UserError, match="num_envs is 0"):
        gymnasium.make_vec(ID, num_envs=0)
    with pytest.raises(UserError, match="3 seeds"):
        make_vec().reset(seed=[1, 2, 3])


def test_the_documented_code_runs(capsys):
    page = (ROOT / "docs" / "environment.md").read_text().split("## Gymnasium")[1].split("\n## ")[0]
    for block in re.findall(r"```python\n(.*?)```", page, re.DOTALL):
        exec(block, {})
    assert capsys.readouterr().out.splitlines()[0] == "(40,) {'success': False, 'object': 'apple'}"
