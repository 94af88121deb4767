"""Reward terms against the paper's equations, worked out by hand."""

import jax.numpy as jnp
import pytest

from ddgrasp.config import RewardConfig
from mjx_envs import rewards

W = RewardConfig(
    reach=2.0, lift=3.0, orient=0.5, accel=0.1, bonus_base=1.5, bonus_growth=2.0, bonus_max_count=3,
    align=0.25, grasp=1.0, saturation=0.01, toggle=0.2,
)  # fmt: skip


def transition(**changes):
    values = {
        "before": rewards.Distances(jnp.array(0.5), jnp.array(0.4), jnp.array(0.3), jnp.array(0.2)),
        "after": rewards.Distances(jnp.array(0.4), jnp.array(0.1), jnp.array(0.1), jnp.array(0.0)),
        "action": jnp.zeros(8).at[7].set(1.0),
        "last_action": jnp.zeros(8).at[7].set(1.0),
        "acceleration": jnp.array([1.0, 2.0, 0, 0, 0, 0, 0]),
        "grasped": jnp.array(False),
        "lifted": jnp.array(False),
        "hold_count": jnp.array(0),
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
    terms = rewards.terms(W, transition(hold_count=jnp.array(count)))
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
