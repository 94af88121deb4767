"""What a control step counts and calls a success, and which episode comes next: physics that stand still."""

from collections.abc import Callable
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mujoco_playground import State

from ddgrasp import contract
from ddgrasp.config import PAPER_REWARD, WorldConfig
from ddgrasp.layout import QPOS
from mjx_envs.grasp_env import AutoReset, GraspEnv

WORLD = WorldConfig(objects=("cube",), episode_steps=6)
CLOSE, OPEN = (jnp.zeros(8).at[7].set(command) for command in (1.0, -1.0))
HELD_M, BESIDE_M = np.add(contract.LIFT_TARGET_M, (0, 0.04, 0)), np.add(contract.LIFT_TARGET_M, (0, 0.06, 0))


class Still:
    """Physics in which all stays as it is; a joint faster than 1e6 rad/s blows them up."""

    def step(self, params, state, ctrl):
        """The state as it was."""
        return replace(state, qvel=jnp.where(state.qvel > 1e6, jnp.nan, 0.0))


@pytest.fixture(scope="module")
def env() -> GraspEnv:
    env = GraspEnv(WORLD)
    env.physics = Still()
    return env


@pytest.fixture(scope="module")
def first(env) -> State:
    return jax.jit(env.reset)(jax.random.PRNGKey(0))


@pytest.fixture(scope="module")
def stepped(env, first) -> Callable[..., State]:
    """(object's place, m; action; the one before; speed of the joints, rad/s; force of both pads, N; what the
    hand was off by before besides, rad; counters of the episode) -> the state a step later."""
    step = jax.jit(env.step)

    def after(
        place_m, action=CLOSE, last=CLOSE, speed_rad_s=0.0, touch_n=(1.0, 1.0), off_rad=0.0, **counters: int
    ) -> State:
        qpos = first.data.qpos.at[QPOS.object_pos].set(place_m)
        data = replace(first.data, qpos=qpos, qvel=jnp.full(15, speed_rad_s), touch=jnp.array(touch_n))
        counted = {name: jnp.asarray(value, jnp.int32) for name, value in counters.items()}
        episode = replace(first.info["episode"], action=last, **counted)
        off = {name: getattr(episode.distances, name) + off_rad for name in ("grasp_angle", "upright_angle")}
        episode = replace(episode, distances=replace(episode.distances, **off))
        return step(first.replace(data=data, info=first.info | {"episode": episode}), action)

    return after


def test_what_an_action_has_beyond_its_box_counts_for_nothing(stepped):
    within, beyond = (stepped(BESIDE_M, jnp.full(8, size, jnp.float32)) for size in (1.0, 1e20))
    jax.tree.map(np.testing.assert_array_equal, within, beyond)


@pytest.mark.parametrize(
    ("place_m", "action", "before", "after"),
    [(HELD_M, CLOSE, 3, 4), (HELD_M, CLOSE, 0, 1), (BESIDE_M, CLOSE, 3, 0), (HELD_M, OPEN, 3, 0)],
)
def test_holding_is_counted_while_it_goes_on(stepped, place_m, action, before, after):
    assert int(stepped(place_m, action, hold_count=before).info["episode"].hold_count) == after


@pytest.mark.parametrize(("held", "steps", "success"), [(3, 5, 0), (4, 5, 1), (5, 5, 1), (4, 4, 0)], ids=str)
def test_success_is_an_object_held_for_the_last_five_steps(stepped, held, steps, success):
    assert (contract.HOLD_STEPS, WORLD.episode_steps) == (5, 6)
    state = stepped(HELD_M, hold_count=held, steps=steps)
    assert (state.metrics["success"], state.done) == (success, steps == 5)


@pytest.mark.parametrize(
    ("touch_n", "grasped"), [((1.0, 1.0), 1), ((1.0, 0.0), 0), ((0.0, 1.0), 0), ((0.2, 1.0), 0)], ids=str
)
def test_an_object_is_grasped_by_both_pads(stepped, touch_n, grasped):
    state = stepped(HELD_M, touch_n=touch_n, hold_count=4, steps=5)
    assert bool(state.info["episode"].grasped) == bool(grasped)
    assert state.metrics["success"] == grasped
    assert (float(state.metrics["reward/grasp"]) > 0) == bool(grasped)


def test_the_reward_s_acceleration_is_of_the_joints_in_rad_per_s2(stepped):
    accel = float(stepped(HELD_M, speed_rad_s=0.02).metrics["reward/accel"])
    assert accel == pytest.approx(-WORLD.reward.accel * 7 * (0.02 / 0.1) ** 2, rel=1e-4)


@pytest.mark.parametrize(
    ("height_m", "touch_n", "lifted"),
    [(0.04, (1.0, 1.0), True), (0.02, (1.0, 1.0), False), (0.04, (0.0, 0.0), False)],
)
def test_what_is_lifted_is_kept_upright_and_what_lies_is_aligned_with(
    stepped, first, height_m, touch_n, lifted
):
    place_m = first.data.qpos[QPOS.object_pos].at[2].set(first.info["episode"].rest_height + height_m)
    metrics = stepped(place_m, touch_n=touch_n, off_rad=0.5).metrics
    expected = {
        "orient": 0.5 * WORLD.reward.orient * lifted,
        "align": 0.5 * WORLD.reward.align * (not lifted),
    }
    assert {name: float(metrics[f"reward/{name}"]) for name in expected} == pytest.approx(expected, abs=1e-5)


def test_an_episode_whose_physics_blow_up_at_its_end_has_not_succeeded(stepped):
    state = stepped(HELD_M, speed_rad_s=1e9, hold_count=5, steps=5)
    assert state.info["episode"].hold_count == 6
    assert (state.metrics["success"], state.done, state.info["truncation"]) == (0, 1, 0)
    assert (state.metrics["blown_up"], state.metrics["lost"]) == (1, 1)


@pytest.mark.parametrize(("beside_m", "action", "lost"), [(0.34, OPEN, 0), (0.36, OPEN, 1), (0.36, CLOSE, 0)])
def test_an_object_out_of_reach_is_lost_unless_it_is_held(stepped, beside_m, action, lost):
    state = stepped(np.add(contract.WORKSPACE_CENTER_M + (0.03,), (0, beside_m, 0)), action)
    assert (state.metrics["lost"], state.done, state.metrics["blown_up"]) == (lost, lost, 0)


@pytest.mark.parametrize(("last", "reward"), [(CLOSE, -WORLD.reward.toggle), (OPEN, 0.0)])
def test_an_action_that_is_not_finite_counts_as_zeros_which_open_the_gripper(stepped, first, last, reward):
    state = stepped(first.data.qpos[QPOS.object_pos], CLOSE.at[3].set(jnp.nan), last)
    assert state.done == 1 and float(state.reward) == pytest.approx(reward)
    assert (state.metrics["lost"], state.metrics["blown_up"]) == (1, 0)


def test_an_action_that_is_not_finite_earns_no_bonus_of_the_papers_reward(first):
    env = GraspEnv(replace(WORLD, reward=PAPER_REWARD))
    env.physics = Still()
    data = replace(first.data, qpos=first.data.qpos.at[QPOS.object_pos].set(contract.LIFT_TARGET_M))
    begun = first.replace(data=data)
    bonus = [
        float(jax.jit(env.step)(begun, action).metrics["reward/bonus"]) for action in (CLOSE, CLOSE * jnp.nan)
    ]
    assert bonus[0] > 0 and bonus[1] == 0


def test_joint_actions_beyond_95_percent_are_saturated(stepped):
    action = CLOSE.at[:3].set(jnp.array([0.96, -0.96, 0.94]))
    assert float(stepped(HELD_M, action).metrics["saturated"]) == pytest.approx(2 / 7)


def test_a_new_episode_is_drawn_by_each_refresh_and_follows_the_one_that_ends(env, first):
    batch, refresh = AutoReset(env), jax.jit(AutoReset(env).refresh)
    state = jax.tree.map(lambda leaf: jnp.stack([leaf] * 2), first)
    episode = replace(state.info["episode"], steps=jnp.array([4, 5]))  # of six
    info = state.info | {"rng": jax.random.split(jax.random.PRNGKey(1)), "episode": episode}
    once = refresh(state.replace(info=info))
    twice = refresh(once)
    earlier, later = (np.asarray(some.info["next"][1]) for some in (once, twice))
    assert (np.abs(later - earlier).max(axis=1) > 1e-3).all()
    stepped = jax.jit(batch.step)(twice, jnp.zeros((2, 8)))
    assert stepped.done.tolist() == [0, 1] and stepped.info["episode"].steps.tolist() == [5, 0]
    assert stepped.info["truncation"].tolist() == [0, 1] and stepped.metrics["length"].tolist() == [5, 6]
    begun = (np.asarray(stepped.obs) == later).all(axis=1)
    assert begun.tolist() == [False, True]
