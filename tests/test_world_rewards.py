"""Reward terms against the paper's equations, worked out by hand."""

import math

import jax.numpy as jnp
import pytest

from ddgrasp.config import PAPER_REWARD, RewardConfig
from mjx_envs import rewards

W = RewardConfig(
    reach=2.0, lift=3.0, orient=0.5, accel=0.1, bonus_base=1.5, bonus_growth=2.0, bonus_max_count=3,
    align=0.25, grasp=1.0, saturation=0.01, toggle=0.2,
)  # fmt: skip


def distances(**values):
    return rewards.Distances(**{name: jnp.array(value) for name, value in values.items()})


def transition(**changes):
    values = {
        "before": distances(hand=0.5, grip_to_object=0.5, object=0.4, grasp_angle=0.3, upright_angle=0.2),
        "after": distances(hand=0.4, grip_to_object=0.4, object=0.1, grasp_angle=0.1, upright_angle=0.0),
        "action": jnp.zeros(8).at[7].set(1.0),
        "last_action": jnp.zeros(8).at[7].set(1.0),
        "acceleration": jnp.array([1.0, 2.0, 0, 0, 0, 0, 0]),
        "grasped": jnp.array(False),
        "lifted": jnp.array(False),
        "bonus_count": jnp.array(0),
    }
    return rewards.Transition(**(values | changes))


def test_before_the_grasp():
    terms = rewards.terms(W, transition())
    assert float(terms["reach"]) == pytest.approx(2.0 * 0.1)
    assert float(terms["lift"]) == 0.0  # counts only while grasped
    assert float(terms["orient"]) == 0.0  # counts only while lifted
    assert float(terms["align"]) == pytest.approx(0.25 * 0.2)
    assert float(terms["accel"]) == pytest.approx(-0.1 * 5.0)
    assert float(terms["bonus"]) == 0.0
    assert float(terms["toggle"]) == 0.0


def test_lifting():
    terms = rewards.terms(W, transition(grasped=jnp.array(True), lifted=jnp.array(True)))
    assert float(terms["lift"]) == pytest.approx(3.0 * 0.3)
    assert float(terms["orient"]) == pytest.approx(0.5 * 0.2)
    assert float(terms["reach"]) == 0.0 and float(terms["align"]) == 0.0
    assert float(terms["grasp"]) == pytest.approx(1.0)


@pytest.mark.parametrize(("count", "bonus"), [(0, 0.0), (1, 3.0), (2, 6.0), (3, 12.0), (9, 12.0)])
def test_bonus_grows_and_stays_bounded(count, bonus):
    terms = rewards.terms(W, transition(bonus_count=jnp.array(count)))
    assert float(terms["bonus"]) == pytest.approx(bonus)


def test_saturation_and_toggle():
    action = jnp.zeros(8).at[0].set(1.0).at[7].set(-1.0)
    terms = rewards.terms(W, transition(action=action))
    assert float(terms["saturation"]) == pytest.approx(-0.01)
    assert float(terms["toggle"]) == pytest.approx(-0.2)


def test_every_sideways_step_towards_the_object_shortens_the_way():
    grasp = jnp.array([0.5, 0.0, 0.03])
    way = [
        float(rewards.approach_distance(jnp.array([0.5 + x, 0.0, 0.03 + 0.07]), grasp))
        for x in (0.2, 0.15, 0.1)
    ]
    assert way == sorted(way, reverse=True)
    near = [
        float(rewards.approach_distance(jnp.array([0.5 + x, 0.0, 0.06]), grasp)) for x in (0.05, 0.03, 0.01)
    ]
    assert near == sorted(near, reverse=True)
    assert float(rewards.approach_distance(grasp, grasp)) < 1e-4


NEAR, FAR = (
    distances(hand=metres, grip_to_object=metres, object=0.3, grasp_angle=0.0, upright_angle=0.0)
    for metres in (0.001, 0.029)
)


def nonzero_terms(t):
    return {name for name, value in rewards.terms(PAPER_REWARD, t).items() if float(value) != 0.0}


def test_the_papers_reward_has_five_terms_and_no_more():
    action = jnp.ones(8).at[7].set(-1.0)  # saturated, and the gripper's command changes
    yes = jnp.array(True)
    held = transition(action=action, grasped=yes, lifted=yes, bonus_count=jnp.array(2))
    assert nonzero_terms(held) == {"reach", "lift", "orient", "bonus", "accel"}
    assert nonzero_terms(transition(action=action)) == {"reach", "accel"}


def test_a_way_back_and_forth_pays_nothing_by_the_papers_reward():
    """Its r_reach has no indicator: to close, go away, open and come back is a loop without a gain."""
    away, back = (
        rewards.terms(PAPER_REWARD, transition(before=a, after=b, grasped=jnp.array(closed)))["reach"]
        for a, b, closed in ((NEAR, FAR, True), (FAR, NEAR, False))
    )
    assert float(away) == pytest.approx(-float(back)) and float(back) > 0.2


@pytest.mark.parametrize("grasped", [False, True])
@pytest.mark.parametrize("held", [False, True])
def test_what_the_bonus_is_paid_for(held, grasped):
    state = jnp.array(held), jnp.array(grasped)
    assert bool(rewards.succeeds(RewardConfig(), *state)) == (held and grasped)
    assert bool(rewards.succeeds(PAPER_REWARD, *state)) == held


def test_the_papers_distance_is_from_gripper_to_object_and_ours_goes_by_way_of_a_point_above():
    qpos = jnp.zeros(16).at[9:12].set(jnp.array([0.5, 0.1, 0.03])).at[12].set(1.0)
    grasp = jnp.array([0.5, 0.1, 0.03]), jnp.array([0.0, 1.0, 0.0, 0.0])
    beside = jnp.array([0.5, 0.0, 0.03]), jnp.array([0.0, 1.0, 0.0, 0.0])
    plain = rewards.distances(PAPER_REWARD, qpos, *grasp, beside)
    funnel = rewards.distances(RewardConfig(), qpos, *grasp, beside)
    assert float(plain.hand) == pytest.approx(0.1, abs=1e-4)
    assert float(funnel.hand) == pytest.approx(0.1 + 0.7 * 0.09, abs=1e-4)
    assert float(funnel.grip_to_object) == pytest.approx(0.1, abs=1e-4)


@pytest.mark.parametrize(
    ("aside_m", "hand", "target"), [(0.3, 0.3, 0.3), (0.45, 0.45, 0.45), (0.9, 0.5, 0.5)]
)
def test_an_object_knocked_away_costs_no_more_than_half_a_metre(aside_m, hand, target):
    """The grip point at the lift target, (0.5, 0, 0.4), the object beside it."""
    qpos = jnp.zeros(16).at[9:12].set(jnp.array([0.5, aside_m, 0.4])).at[12].set(1.0)
    down = jnp.array([0.0, 1.0, 0.0, 0.0])
    grip = jnp.array([0.5, 0.0, 0.4])
    seen = rewards.distances(PAPER_REWARD, qpos, qpos[9:12], down, (grip, down))
    assert float(seen.hand) == pytest.approx(hand, abs=1e-4)
    assert float(seen.object) == pytest.approx(target, abs=1e-4)
    assert float(seen.grip_to_object) == pytest.approx(aside_m, abs=1e-4)


@pytest.mark.parametrize("metres", [0.02, 0.04])
@pytest.mark.parametrize("closing", [0, 1])
@pytest.mark.parametrize("touching", [0, 1])
def test_what_counts_as_grasped(touching, closing, metres):
    state = jnp.array(bool(touching)), jnp.array(bool(closing)), jnp.array(metres)
    assert bool(rewards.grasped(RewardConfig(), *state)) == (touching and closing)
    assert bool(rewards.grasped(PAPER_REWARD, *state)) == (closing and metres < rewards.NEAR_M)


def test_the_angles_are_from_the_grasp_and_from_pointing_down_unturned():
    """The hand points down, turned by 0.5 about the vertical; the grasp is turned by 0.8."""

    def down(yaw_rad: float):
        return jnp.array([0.0, math.cos(yaw_rad / 2), math.sin(yaw_rad / 2), 0.0])

    there = jnp.array([0.5, 0.1, 0.03])
    qpos = jnp.zeros(16).at[9:12].set(there).at[12].set(1.0)
    for weights in (RewardConfig(), PAPER_REWARD):
        seen = rewards.distances(weights, qpos, there, down(0.8), (there, down(0.5)))
        assert float(seen.grasp_angle) == pytest.approx(0.3, abs=2e-3)
        assert float(seen.upright_angle) == pytest.approx(0.5, abs=2e-3)
