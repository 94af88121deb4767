"""PPO: exact resume, the saved policy is the trained one, warm start."""

import contextlib
import dataclasses
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from brax.training import types
from brax.training.agents.ppo import networks as ppo_networks
from optax.tree_utils import tree_get_all_with_path

from app.commands import parse
from ddgrasp.config import Config, EvalConfig, TeacherConfig, WorldConfig
from ddgrasp.errors import UserError
from ddgrasp.presets import PRESETS
from ddgrasp.progress import Progress, read_curves
from learning.checkpoints import Checkpoints
from mjx_envs import devices
from mjx_envs.grasp_env import AutoReset
from ppo import learner
from ppo import policy as teacher_policy
from ppo import train as ppo_train
from teacher_support import learner_without_envs

TEACHER = TeacherConfig(
    total_steps=4 * 8 * 4, num_envs=8, unroll_steps=4, minibatches=2, epochs=1, hidden=(16,), eval_every=100,
    checkpoint_every=2, pregrasp_share=0.2, held_share=0.2, settle_from=0.5, target_kl=0.02, start="nothing",
    critic_warmup=0,
)  # fmt: skip
CONFIG = Config(
    "test", world=WorldConfig(episode_steps=6), teacher=TEACHER, evaluation=EvalConfig(teacher_trials=4)
)


@pytest.fixture(scope="module")
def directory(tmp_path_factory):
    return tmp_path_factory.mktemp("whole")


@pytest.fixture(scope="module")
def uninterrupted(directory):
    return ppo_train.train(CONFIG, directory, Progress(directory, quiet=True))


class _StopsAfter(Progress):
    """Raises KeyboardInterrupt at the given advance of a bar."""

    def __init__(self, advances):
        super().__init__(quiet=True)
        self.left = advances

    @contextlib.contextmanager
    def task(self, label, total):
        with super().task(label, total) as task:
            advance = task.advance

            def counted(n=1, **shown):
                self.left -= n
                if self.left == 0:
                    raise KeyboardInterrupt
                advance(n, **shown)

            task.advance = counted
            yield task


def test_resume_equals_an_uninterrupted_run_to_the_bit(uninterrupted, tmp_path):
    assert TEACHER.iterations == 4
    with pytest.raises(KeyboardInterrupt):
        ppo_train.train(CONFIG, tmp_path, _StopsAfter(3))  # after the checkpoint of iteration 2
    resumed = ppo_train.train(CONFIG, tmp_path, Progress(quiet=True))
    assert int(resumed.iteration) == 4
    pairs = zip(jax.tree.leaves(uninterrupted.params), jax.tree.leaves(resumed.params), strict=True)
    for whole, again in pairs:
        np.testing.assert_array_equal(np.asarray(whole), np.asarray(again))


def test_what_the_last_iteration_left_is_evaluated(uninterrupted, directory):
    """Or it could never be the best."""
    assert [step for step, _ in read_curves(directory)["eval_success"]] == [0, 4]


def test_saved_policy_acts_as_braxs_deterministic_policy(uninterrupted, tmp_path):
    path = tmp_path / teacher_policy.PARAMS_FILE
    teacher_policy.save(path, uninterrupted.normalizer, uninterrupted.params.policy)
    ours = teacher_policy.load(tmp_path)
    networks = learner.make_networks(TEACHER)
    params = (uninterrupted.normalizer, uninterrupted.params.policy)
    theirs = ppo_networks.make_inference_fn(networks)(params, deterministic=True)
    obs = np.random.default_rng(0).normal(size=(5, 40)).astype(np.float32)
    np.testing.assert_allclose(ours(obs), theirs(jnp.asarray(obs), jax.random.PRNGKey(0))[0], atol=1e-5)


def test_warm_start_takes_the_policy_and_its_normaliser_alone(uninterrupted, tmp_path):
    teacher_policy.save(
        tmp_path / teacher_policy.PARAMS_FILE, uninterrupted.normalizer, uninterrupted.params.policy
    )
    saved = teacher_policy.load_state(tmp_path)
    other = _scaled(uninterrupted, 2.0)
    fresh = replace(other, normalizer=replace(other.normalizer, mean=other.normalizer.mean + 1.0))
    started = learner.warm_start(fresh, saved)
    jax.tree.map(np.testing.assert_array_equal, started.params.policy, uninterrupted.params.policy)
    jax.tree.map(np.testing.assert_array_equal, started.params.value, fresh.params.value)
    for name in ("mean", "std"):
        kept = getattr(uninterrupted.normalizer, name)
        np.testing.assert_array_equal(getattr(started.normalizer, name), kept)
    learner.check_start(TEACHER, saved)


def _scaled(state: learner.LearnerState, factor: float) -> learner.LearnerState:
    """`state` with another policy and value network."""
    return replace(state, params=jax.tree.map(lambda leaf: factor * leaf, state.params))


def test_the_best_policy_is_kept_the_later_of_equals_and_after_a_resume(uninterrupted, tmp_path):
    def kept() -> float:
        layer = teacher_policy.load_state(tmp_path)["layers"]["hidden_0"]["kernel"]
        return float(np.median(layer / uninterrupted.params.policy["params"]["hidden_0"]["kernel"]))

    best = ppo_train._Best(tmp_path)
    for factor, (rate, expected) in enumerate(((0.5, 1), (0.7, 2), (0.6, 2), (0.7, 4)), 1):
        best.offer(rate, _scaled(uninterrupted, factor))
        assert kept() == pytest.approx(expected), rate
    resumed = ppo_train._Best(tmp_path)
    resumed.offer(0.65, _scaled(uninterrupted, 9.0))
    assert kept() == pytest.approx(4)


def test_a_start_with_other_layers_is_refused_before_any_work(tmp_path):
    teacher = {"start": "pretrained/teacher", "total-steps": "100000"}
    options = [word for name, value in teacher.items() for word in (f"--teacher.{name}", value)]
    options += ["--teacher.hidden", "256", "256", "128", "--out", str(tmp_path / "run")]
    with pytest.raises(UserError, match=r"has layers 256 128, .* 256 256 128: add --teacher.hidden 256 128"):
        parse("run", ["--preset", "debug", *options]).run()
    assert not (tmp_path / "run").exists()


def test_an_unroll_that_ends_more_than_one_episode_is_refused(tmp_path):
    options = ["--preset", "debug", "--teacher.unroll-steps", "300", "--out", str(tmp_path / "run")]
    with pytest.raises(UserError, match=r"unroll_steps is 300; expected 1 to \d+ \(world.episode_steps\)"):
        parse("teacher train", [*options, "--teacher.start", "nothing"]).run()


def test_presets_that_go_on_from_a_policy_have_its_layers():
    going_on = [preset.teacher for preset in PRESETS.values() if preset.teacher.starts_from_file]
    assert going_on
    for teacher in going_on:
        learner.check_start(teacher, teacher_policy.load_state(teacher.start))


def test_missing_teacher_and_indivisible_batch_are_named(tmp_path):
    with pytest.raises(UserError, match="holds no teacher"):
        teacher_policy.load(tmp_path)
    with pytest.raises(UserError, match="num_envs 8 is no multiple of teacher.minibatches 3"):
        dataclasses.replace(TEACHER, minibatches=3)


def test_an_early_end_is_not_trained_past_when_it_is_resumed(uninterrupted, tmp_path, monkeypatch):
    """A checkpoint may hold the evaluation that ended training: killed after it, a stage is resumed there."""
    ended = uninterrupted.replace(iteration=jnp.asarray(3), good_evaluations=jnp.asarray(2))
    monkeypatch.setattr(ppo_train, "_start", lambda *_: ended)
    monkeypatch.setattr(ppo_train, "compile_iteration", lambda *_: None)  # called, it would fail
    unused = object.__new__(AutoReset)
    with Checkpoints(tmp_path) as saved:
        assert ppo_train._train(CONFIG, tmp_path, unused, saved, Progress(quiet=True)) is ended


def test_two_good_evaluations_in_a_row_end_training(tmp_path, monkeypatch):
    """The first, of what it starts from, counts for nothing; a rate that just reaches `stop_at` is good."""
    teacher = dataclasses.replace(TEACHER, total_steps=8 * 8 * 4, eval_every=1, stop_at=0.9)
    rates, counts = iter([1.0, 0.9, 0.8, 0.95, 0.9, 0.0]), []

    def iterate(state):
        counts.append(int(state.good_evaluations))
        curves = {name: jnp.zeros(()) for name in ("success", *learner.COUNTED)}
        return replace(state, iteration=state.iteration + 1), curves, {}

    monkeypatch.setattr(ppo_train, "_start", lambda *_: learner_without_envs(teacher))
    monkeypatch.setattr(ppo_train, "compile_iteration", lambda *_: iterate)
    monkeypatch.setattr(ppo_train, "_evaluate", lambda *_: next(rates))
    with Checkpoints(tmp_path) as saved:
        config = dataclasses.replace(CONFIG, teacher=teacher)
        ended = ppo_train._train(config, tmp_path, object.__new__(AutoReset), saved, Progress(quiet=True))
    assert counts == [0, 1, 0, 1] and int(ended.good_evaluations) == 2
    assert teacher.iterations == 8 and int(ended.iteration) == 4


def test_good_evaluations_count_while_they_come_one_after_another():
    state, counts = learner_without_envs(TEACHER), []
    for good in (True, False, True, True):
        state = learner.with_evaluation(state, good)
        counts.append(int(state.good_evaluations))
    assert counts == [1, 0, 1, 2]


@pytest.mark.parametrize("kl", [1.0, 0.05, 0.001])
def test_a_step_size_below_the_least_is_not_raised_by_a_large_divergence(kl):
    config = dataclasses.replace(TEACHER, target_kl=0.02, learning_rate=2e-5)
    params = learner.network_params({"w": jnp.zeros(2)}, {"w": jnp.zeros(2)})
    state = learner.make_optimizer(config).init(params)
    steered = learner.steered(state, jnp.asarray(kl), config.target_kl, learner.least_rate(config))
    rate = float(optax.tree_utils.tree_get(steered, "learning_rate"))
    assert rate == pytest.approx(2e-5 if kl > 0.02 else 3e-5)


SETTLING = dataclasses.replace(TEACHER, start="guide", settle_from=0.5, target_kl=4.0, learning_rate=2e-4)
"""Of its four iterations the first two explore, the last settles wholly."""


class _Asked(AutoReset):
    """No environments: keeps what share of exploring starts `refresh` is asked for."""

    def __init__(self):
        self.exploring: list[float] = []

    def refresh(self, state, exploring=1.0):
        self.exploring.append(float(exploring))
        return state


def test_episodes_start_as_the_worlds_do_once_training_settles():
    env, state = _Asked(), learner_without_envs(SETTLING)
    for iteration in range(SETTLING.iterations):
        learner.refresh(SETTLING, env, replace(state, iteration=jnp.asarray(iteration)))
    assert env.exploring == [1, 1, 0, 0]


def _experience(
    config: TeacherConfig, state: learner.LearnerState, seen: jax.Array | None = None
) -> types.Transition:
    """Eight stretches of four steps, made up, in which the policy of `state` acted on `seen` (8, 4, 40)."""
    key, steps = state.key, jnp.ones((8, 4))
    seen = jax.random.normal(key, (8, 4, 40)) if seen is None else seen
    policy = (state.normalizer, state.params.policy)
    action, extras = ppo_networks.make_inference_fn(learner.make_networks(config))(policy)(seen, key)
    return types.Transition(
        observation=seen, action=action, reward=jax.random.normal(key, (8, 4)), discount=steps,
        next_observation=seen,
        extras={"policy_extras": extras, "state_extras": {"truncation": 0 * steps}},
    )  # fmt: skip


def test_an_update_is_made_with_the_configured_numbers(monkeypatch):
    """None of them is Brax's default."""
    asked = {}

    class Asked(Exception):
        pass

    def loss(*_, **given):
        asked.update(given)
        raise Asked

    monkeypatch.setattr(learner.ppo_losses, "compute_ppo_loss", loss)
    odd: dict[str, float] = {
        "discount": 0.8, "gae_lambda": 0.7, "clip": 0.1, "entropy_cost": 0.01, "reward_scaling": 0.3,
    }  # fmt: skip
    config = replace(SETTLING, **odd)
    state = learner_without_envs(config)
    data = _experience(config, state)
    with pytest.raises(Asked):
        learner.improve(config, devices.make_mesh(), state, data, {})
    names = ("discounting", "gae_lambda", "clipping_epsilon", "entropy_cost", "reward_scaling")
    assert [asked[name] for name in names] == list(odd.values())


@pytest.fixture(scope="module")
def settled() -> dict[int, tuple[learner.LearnerState, learner.LearnerState, float]]:
    """Iteration -> learner before and after it, divergence: of a policy that moved as far as `target_kl`."""
    state = learner_without_envs(SETTLING)
    data = _experience(SETTLING, state)
    layers = state.params.policy["params"]
    last = layers["hidden_1"]
    means = last["bias"].at[:8].add(SETTLING.action_std)  # each by about its deviation: 8 x 1 / 2 nats
    policy = {"params": layers | {"hidden_1": last | {"bias": means}}}
    moved = learner.with_policy(state, policy, state.normalizer)
    improve = jax.jit(lambda state: learner.improve(SETTLING, devices.make_mesh(), state, data, {})[:2])
    made = {}
    for iteration in (0, SETTLING.iterations - 1):
        before = replace(moved, iteration=jnp.asarray(iteration))
        after, metrics = improve(before)
        made[iteration] = before, after, float(metrics["policy/kl"])
    return made


def test_settling_wants_a_tenth_of_the_divergence_and_allows_a_tenth_of_the_least_step_size(settled):
    for iteration, rate in ((0, 2e-4), (SETTLING.iterations - 1, 2e-4 / 1.5**2)):  # two minibatches
        _, after, divergence = settled[iteration]
        assert 0.5 < divergence / SETTLING.target_kl < 2  # alone no reason to change anything
        assert float(optax.tree_utils.tree_get(after.opt_state, "learning_rate")) == pytest.approx(rate)


def test_a_policy_that_acts_already_keeps_its_normaliser(settled):
    before, after, _ = settled[0]
    for name in ("mean", "std"):
        kept, now = (getattr(state.normalizer, name) for state in (before, after))
        np.testing.assert_array_equal(kept, now)


def test_exploring_starts_reach_training_alone(tmp_path, monkeypatch):
    shares = {"pregrasp_share": 0.5, "pregrasp_turn_rad": 1.0, "held_share": 0.25}
    config = dataclasses.replace(CONFIG, teacher=dataclasses.replace(TEACHER, **shares))
    worlds = {}

    def compiled(_, env):
        worlds["training"] = env.env.config
        return lambda state: pytest.fail("nothing is left to do")

    def evaluated(env, *_):
        worlds["evaluation"] = env.config
        return 1.0

    done = replace(learner_without_envs(TEACHER), good_evaluations=jnp.asarray(2))
    monkeypatch.setattr(ppo_train, "compile_iteration", compiled)
    monkeypatch.setattr(ppo_train, "_start", lambda *_: done)
    monkeypatch.setattr(ppo_train, "_evaluate", evaluated)
    ppo_train.train(config, tmp_path, Progress(quiet=True))
    random = dataclasses.replace(CONFIG.world.random, **shares)
    assert worlds == {
        "training": dataclasses.replace(CONFIG.world, random=random), "evaluation": CONFIG.world,
    }  # fmt: skip


def test_contacts_dropped_and_states_blown_up_are_told_of_every_iteration(tmp_path, monkeypatch):
    """At the fifth, at the third and sixth, whose checkpoints a resumed run would begin with, and after the
    seventh, which an evaluation makes the last of more."""
    teacher = dataclasses.replace(
        TEACHER, total_steps=20 * 8 * 4, eval_every=6, stop_at=0.9, checkpoint_every=3
    )
    dropped, blown_up, said = iter([3, 0, 4, 0, 0, 1, 5]), iter([0, 2, 0, 0, 1, 0, 0]), []

    def iterate(state):
        counts = {"contacts_dropped": next(dropped), "blown_up": next(blown_up)}
        curves = {name: jnp.float32(count) for name, count in counts.items()} | {"success": jnp.zeros(())}
        good = jnp.asarray(2 if state.iteration == 6 else 0)
        return replace(state, iteration=state.iteration + 1, good_evaluations=good), curves, {}

    monkeypatch.setattr(ppo_train, "_start", lambda *_: learner_without_envs(teacher))
    monkeypatch.setattr(ppo_train, "compile_iteration", lambda *_: iterate)
    monkeypatch.setattr(ppo_train, "_evaluate", lambda *_: 0.0)
    progress = Progress(tmp_path, quiet=True)
    monkeypatch.setattr(progress, "note", said.append)
    with Checkpoints(tmp_path / "checkpoints") as saved:
        config = dataclasses.replace(CONFIG, teacher=teacher)
        ppo_train._train(config, tmp_path, object.__new__(AutoReset), saved, progress)
    told = [note for note in said if "contacts" in note]
    counts = ("7 contacts in 96 control", "1 contacts in 32 control", "5 contacts in 32 control")
    assert all(count in note for count, note in zip(counts, told, strict=True))
    curves = read_curves(tmp_path)
    assert curves["contacts_dropped"] == [(3, 7.0), (5, 0.0), (6, 1.0)]
    assert curves["blown_up"] == [(3, 2.0), (5, 1.0), (6, 0.0)]


FROM_NOTHING = dataclasses.replace(TEACHER, target_kl=0.02, learning_rate=2e-5, critic_warmup=2)


@pytest.fixture(scope="module")
def from_nothing() -> tuple[np.ndarray, list[tuple[learner.LearnerState, dict[str, float]]]]:
    """Observations (8, 4, 40) about 2, the last of them all 1.5, and the learner and its scalars after each
    of three iterations on them, in the first two of which the critic warms up."""
    mesh, state = devices.make_mesh(), learner_without_envs(FROM_NOTHING)
    seen = (2.0 + jax.random.normal(jax.random.key(1), (8, 4, 40))).at[..., 39].set(1.5)
    data, made = _experience(FROM_NOTHING, state, seen), []
    improve = jax.jit(lambda state: learner.improve(FROM_NOTHING, mesh, state, data, {})[:2])
    for _ in range(3):
        state, metrics = improve(state)
        made.append((state, {name: float(value) for name, value in metrics.items()}))
    return np.asarray(seen), made


def test_an_actor_that_does_not_learn_yet_keeps_its_optimiser(from_nothing):
    """While the critic warms up the policy stands still: its KL says nothing of its step size, and an Adam
    that counts the steps without gradients would take the first ones with them several times too large."""
    _, made = from_nothing
    state, rates = made[-1][0], [metrics["policy/learning_rate"] for _, metrics in made]
    assert rates[:2] == pytest.approx([2e-5, 2e-5]) and rates[2] <= 3.01e-5
    actor, critic = (state.opt_state.inner_states[name] for name in ("policy", "value"))
    steps = [{int(count) for _, count in tree_get_all_with_path(part, "count")} for part in (actor, critic)]
    assert steps == [{2}, {6}]
    assert int(state.normalizer.count) == 3 * 8 * 4  # from nothing, what was seen counts


def test_an_update_sees_by_the_scales_that_its_experience_was_made_with(from_nothing):
    """And leaves those of what was seen: by these a policy that has not moved would act otherwise."""
    seen, ((state, metrics), *_) = from_nothing
    assert metrics["policy/kl"] == pytest.approx(8 * np.log(1 + 1e-5), abs=1e-5)  # of Brax's own 1e-5
    flat = seen.reshape(-1, 40)
    floored = np.maximum(flat.std(axis=0), learner.OBSERVATION_STD_MIN)
    assert flat.std(axis=0)[:39].min() > 0.5 and floored[39] == 0.01
    np.testing.assert_allclose(state.normalizer.mean, flat.mean(axis=0), rtol=1e-5)
    np.testing.assert_allclose(state.normalizer.std, floored, rtol=1e-5)


@pytest.mark.parametrize("target_kl", [0.0, 0.01])
def test_gradients_are_clipped_to_the_configured_norm(target_kl):
    """After one of 100 and one of 1 Adam moves as after two of 1."""
    params = learner.network_params({"w": jnp.zeros(1)}, {"w": jnp.zeros(1)})
    moved = {}
    for most in (1.0, 1000.0):
        teacher = replace(TEACHER, max_grad_norm=most, target_kl=target_kl, total_steps=1000 * 8 * 4)
        optimizer = learner.make_optimizer(teacher)
        state = optimizer.init(params)
        for size in (100.0, 1.0):
            gradient = learner.network_params({"w": jnp.full(1, size)}, {"w": jnp.full(1, size)})
            update, state = optimizer.update(gradient, state, params)
        moved[most] = (float(update.policy["w"][0]), float(update.value["w"][0]))
    for clipped, free, rate in zip(
        moved[1.0], moved[1000.0], (teacher.learning_rate, teacher.critic_learning_rate), strict=True
    ):
        assert clipped == pytest.approx(-rate, rel=0.01) and abs(free) < 0.9 * rate


def test_step_sizes_fall_to_a_tenth_while_each_of_both_learns():
    """Adam's steps along one constant gradient are as large as its step size."""
    teacher = dataclasses.replace(TEACHER, total_steps=10 * 8 * 4, critic_warmup=4, target_kl=0.0)
    optimizer = learner.make_optimizer(teacher)
    params = learner.network_params({"w": jnp.zeros(1)}, {"w": jnp.zeros(1)})
    gradient = learner.network_params({"w": jnp.ones(1)}, {"w": jnp.ones(1)})

    def step(state, _):
        moved, state = optimizer.update(gradient, state, params)
        return state, (-moved.policy["w"][0], -moved.value["w"][0])

    actor, critic = jax.lax.scan(step, optimizer.init(params), None, 1 + 10 * 2)[1]
    for steps, rate, taken in (
        (6 * 2, teacher.learning_rate, actor),
        (20, teacher.critic_learning_rate, critic),
    ):
        assert float(taken[0]) == pytest.approx(rate, rel=1e-3)
        assert float(taken[steps // 2]) == pytest.approx(0.55 * rate, rel=1e-3)
        assert float(taken[steps - 1]) == pytest.approx((0.1 + 0.9 / steps) * rate, rel=1e-3)
        assert float(taken[steps]) == pytest.approx(0.1 * rate, rel=1e-3)


def test_training_leaves_the_policy_of_its_best_evaluation(tmp_path, monkeypatch):
    """Each iteration doubles the weights: those after the second are four times the first ones."""
    teacher = dataclasses.replace(TEACHER, eval_every=1)
    first, rates = learner_without_envs(teacher), iter([0.1, 0.4, 0.9, 0.2, 0.3])

    def iterate(state):
        curves = {name: jnp.zeros(()) for name in ("success", *learner.COUNTED)}
        return replace(_scaled(state, 2.0), iteration=state.iteration + 1), curves, {}

    monkeypatch.setattr(ppo_train, "_start", lambda *_: first)
    monkeypatch.setattr(ppo_train, "compile_iteration", lambda *_: iterate)
    monkeypatch.setattr(ppo_train, "_evaluate", lambda *_: next(rates))
    with Checkpoints(tmp_path / "c") as saved:
        config = dataclasses.replace(CONFIG, teacher=teacher)
        ppo_train._train(config, tmp_path, object.__new__(AutoReset), saved, Progress(quiet=True))
    kept = teacher_policy.load_state(tmp_path)["layers"]["hidden_0"]["kernel"]
    np.testing.assert_allclose(kept, 4.0 * first.params.policy["params"]["hidden_0"]["kernel"], rtol=1e-6)
