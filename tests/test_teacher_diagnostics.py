"""What people look at while PPO trains, against numbers worked out by hand."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax.training import types
from brax.training.agents.ppo import networks as ppo_networks

from ddgrasp.config import TeacherConfig
from ddgrasp.progress import Progress, read_curves
from mjx_envs import devices
from ppo import diagnostics, learner
from ppo import train as ppo_train
from teacher_support import learner_without_envs

TEACHER = TeacherConfig(hidden=(16,), action_std=0.2, gripper_std=0.4, clip=0.2, discount=0.9)
NETWORKS = learner.make_networks(TEACHER)
STATE = learner_without_envs(TEACHER)
POLICY, VALUE = STATE.params.policy, STATE.params.value
COUNT, STEPS = 64, 3


def shifted(params: dict, by: np.ndarray) -> dict:
    """`params` whose network gives `by` more for whatever it sees."""
    layers = params["params"]
    last = layers["hidden_1"]
    return {"params": layers | {"hidden_1": last | {"bias": last["bias"] + by}}}


@pytest.fixture(scope="module")
def data() -> types.Transition:
    """Experience of POLICY, all rewards 0, nowhere an end."""
    seen = jax.random.normal(jax.random.key(1), (COUNT, STEPS, 40))
    act = ppo_networks.make_inference_fn(NETWORKS)((STATE.normalizer, POLICY))
    action, extras = act(seen, jax.random.key(2))
    ones = jnp.ones((COUNT, STEPS))
    following = jnp.concatenate([seen[:, 1:], jax.random.normal(jax.random.key(3), (COUNT, 1, 40))], axis=1)
    return types.Transition(
        observation=seen, action=action, reward=0 * ones, discount=ones, next_observation=following,
        extras={"policy_extras": extras, "state_extras": {"truncation": 0 * ones}},
    )  # fmt: skip


def of(data: types.Transition, policy: dict = POLICY, value: dict = VALUE) -> dict[str, float]:
    made = diagnostics.of_update(TEACHER, NETWORKS, STATE.normalizer, data, value, policy)
    return {name: float(x) for name, x in made.items()}


def normals(policy: dict, data: types.Transition) -> tuple[np.ndarray, np.ndarray]:
    """Means and standard deviations (B, T, 8) before the tanh."""
    logits = np.asarray(NETWORKS.policy_network.apply(STATE.normalizer, policy, data.observation), np.float64)
    mean, raw = np.split(logits, 2, axis=-1)
    least = np.array([TEACHER.action_std] * 7 + [TEACHER.gripper_std]) / np.log(2)
    return mean, least * (np.logaddexp(0, raw) + TEACHER.min_std)


def test_the_same_policy_before_and_after_has_not_moved(data):
    same = of(data)
    # Brax adds 1e-5 to the ratio of two standard deviations
    assert same["policy/kl"] == pytest.approx(8 * np.log(1 + 1e-5), abs=1e-5)
    assert same["policy/clip_fraction"] == 0.0
    assert same["policy/std"] == pytest.approx(normals(POLICY, data)[1].mean(), rel=1e-5)


def test_the_divergence_is_that_of_two_normals_old_from_new(data):
    """KL(old || new) = sum log(s_new / s_old) + (s_old^2 + (m_old - m_new)^2) / (2 s_new^2) - 1/2."""
    by = np.concatenate([np.linspace(-0.05, 0.1, 8), np.linspace(0.5, -0.8, 8)])
    (m_old, s_old), (m_new, s_new) = (normals(policy, data) for policy in (POLICY, shifted(POLICY, by)))
    np.testing.assert_allclose(m_new - m_old, np.broadcast_to(by[:8], m_old.shape), atol=1e-5)
    terms = np.log(s_new / s_old) + (s_old**2 + (m_old - m_new) ** 2) / (2 * s_new**2) - 0.5
    backwards = np.log(s_old / s_new) + (s_new**2 + (m_old - m_new) ** 2) / (2 * s_old**2) - 0.5
    moved = of(data, shifted(POLICY, by))["policy/kl"]
    assert moved == pytest.approx(terms.sum(-1).mean(), rel=1e-3)
    assert abs(moved - backwards.sum(-1).mean()) > 0.1 * moved


def test_the_clip_fraction_counts_probabilities_that_moved_too_far_either_way(data):
    by = np.concatenate([np.linspace(-0.02, 0.04, 8), np.zeros(8)])
    (m_old, s), (m_new, _) = (normals(policy, data) for policy in (POLICY, shifted(POLICY, by)))
    raw = np.asarray(data.extras["policy_extras"]["raw_action"])
    moved = np.exp(np.sum(((raw - m_old) ** 2 - (raw - m_new) ** 2) / (2 * s**2), axis=-1))
    more, less = np.mean(moved > 1 + TEACHER.clip), np.mean(moved < 1 - TEACHER.clip)
    assert min(more, less) > 0.05
    counted = of(data, shifted(POLICY, by))["policy/clip_fraction"]
    assert counted == pytest.approx(more + less, abs=1.5 / (COUNT * STEPS))  # one may lie on the edge


def test_a_critic_that_foresees_every_return_explains_all_and_one_number_nothing(data):
    """Rewards of V(s) - discount V(s') leave GAE nothing to correct."""
    values, following = (
        NETWORKS.value_network.apply(STATE.normalizer, VALUE, seen)
        for seen in (data.observation, data.next_observation)
    )
    foreseen = data._replace(reward=(values - TEACHER.discount * following) / TEACHER.reward_scaling)
    assert of(foreseen)["value/explained_variance"] == pytest.approx(1.0, abs=1e-4)
    constant = jax.tree.map(jnp.zeros_like, VALUE)
    assert of(foreseen, value=constant)["value/explained_variance"] == pytest.approx(0.0, abs=1e-4)


def test_what_comes_after_the_time_limit_is_nothing_or_what_the_critic_expects(data):
    """Every episode ends at its second step, by the time limit. Values of 5 everywhere, rewards of 0."""
    at_limit = jnp.zeros((COUNT, STEPS)).at[:, 1].set(1.0)
    extras = data.extras | {"state_extras": {"truncation": at_limit}}
    limited = data._replace(discount=1.0 - at_limit, extras=extras)
    five = jax.tree.map(jnp.zeros_like, VALUE)
    five["params"]["hidden_1"]["bias"] = five["params"]["hidden_1"]["bias"] + 5.0
    found = [
        np.asarray(diagnostics._returns(TEACHER, NETWORKS, STATE.normalizer, made, five)[1])[:, 0]
        for made in (limited, learner.ended(limited))
    ]
    # Brax's masks the last step: its return is its own value. Ended, it is its reward, which is 0.
    np.testing.assert_allclose(found[0], [0.9 * 5, 5.0, 0.9 * 5], rtol=1e-5)
    step = 0.9 * 5 - 5 + 0.9 * TEACHER.gae_lambda * (0 - 5)  # delta of the first, and the second's
    np.testing.assert_allclose(found[1], [5 + step, 0.0, 0.9 * 5], rtol=1e-4)


@pytest.mark.parametrize("bootstrap", [False, True])
def test_an_update_learns_from_the_end_that_the_configuration_asks_for(data, monkeypatch, bootstrap):
    given = []

    def caught(config, networks, normalizer, data, *rest):
        given.append(data.extras["state_extras"]["truncation"])
        raise StopIteration

    monkeypatch.setattr(learner, "_improve", caught)
    limited = data._replace(extras=data.extras | {"state_extras": {"truncation": jnp.ones((COUNT, STEPS))}})
    config = replace(TEACHER, bootstrap_time_limit=bootstrap)
    with pytest.raises(StopIteration):
        learner.improve(config, devices.make_mesh(), STATE, limited, {})
    assert bool(given[0].all()) == bool(given[0].any()) == bootstrap


def test_where_no_episode_ended_the_curves_of_episodes_have_no_point(tmp_path):
    """A 0 there would say that none succeeded, of a few environments or short unrolls most of the time."""
    progress = Progress(tmp_path, quiet=True)
    none = dict.fromkeys(("success", "lost", "episode/return", "episode/length"), 0.0) | {"policy/kl": 0.1}
    with progress.task("PPO", 15) as task:
        ppo_train._log(5, none | {"success": 0.5, "episode/length": 6.0}, progress, task)
        ppo_train._log(10, none, progress, task)
        assert task.shown == "success 0.5"
        ppo_train._log(15, none | {"episode/length": 6.0}, progress, task)
    progress.close()
    curves = read_curves(tmp_path)
    assert curves.pop("policy/kl") == [(5, 0.1), (10, 0.1), (15, 0.1)]
    assert curves == {
        "success": [(5, 0.5), (15, 0.0)],
        "lost": [(5, 0.0), (15, 0.0)],
        "episode/return": [(5, 0.0), (15, 0.0)],
        "episode/length": [(5, 6.0), (15, 6.0)],
    }
