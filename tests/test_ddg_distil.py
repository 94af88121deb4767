"""Progressive distillation: its equations by hand, a student that does what its teacher does, resume."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from ddg_jax import distil, sample, train
from ddg_jax.data import Frames
from ddg_jax.prior import make_prior
from ddg_jax.train import config_schedule, step_keys
from ddgrasp.config import (
    DDGConfig,
    DDGDepthConfig,
    DDGDiffusionConfig,
    DDGTrainingConfig,
    PriorConfig,
    SamplingConfig,
    UNetConfig,
)
from ddgrasp.errors import UserError
from ddgrasp.progress import Progress, read_curves
from learning import diffusion
from learning.params import load_params
from learning.train_state import first_state

TINY = DDGConfig(
    depth=DDGDepthConfig(height_px=16, width_px=24),
    unet=UNetConfig(widths=(8, 8), blocks=(0, 1), attention_heads=1),
    diffusion=DDGDiffusionConfig(steps=100),
    training=DDGTrainingConfig(batch_size=8, checkpoint_every=20, learning_rate=1e-2),
    sampling=SamplingConfig(batch_size=8),
    prior=PriorConfig(noise=0.0),
)
DISTILLED = dataclasses.replace(
    TINY,
    sampling=dataclasses.replace(TINY.sampling, sampler="progressive", steps=1),
    training=dataclasses.replace(TINY.training, distil_from=4, distil_steps=60),
)


def test_log_odds_are_not_distilled():
    with pytest.raises(UserError, match="hole_loss is cross_entropy.*take sampler ddim"):
        dataclasses.replace(
            DISTILLED, training=dataclasses.replace(DISTILLED.training, hole_loss="cross_entropy")
        )


def pictures(count: int = 32) -> Frames:
    """Random blocks of holes on a random slope."""
    rng = np.random.default_rng(0)
    depth = rng.uniform(0.5, 2.0, (count, 2, 3)).repeat(8, 1).repeat(8, 2).astype(np.float32)
    depth[rng.random((count, 4, 6)).repeat(4, 1).repeat(4, 2) < 0.2] = 0
    c = rng.normal(0, 0.5, depth.shape).astype(np.float16)
    return Frames(depth, depth, c, np.zeros(count, int))


def made_up_teacher():
    """A network that answers to all of its inputs, whatever they mean."""
    leaves, tree = jax.tree.flatten(train.init_params(TINY, jax.random.key(0)))
    keys = jax.random.split(jax.random.key(1), len(leaves))
    pairs = zip(leaves, keys, strict=True)
    return jax.tree.unflatten(tree, [leaf + 0.1 * jax.random.normal(key, leaf.shape) for leaf, key in pairs])


def test_halvings_end_at_the_samplers_evaluations():
    def rounds(start: int, end: int) -> list[int]:
        return distil.rounds(
            dataclasses.replace(
                DISTILLED,
                training=dataclasses.replace(DISTILLED.training, distil_from=start),
                sampling=dataclasses.replace(DISTILLED.sampling, steps=end),
            )
        )

    assert (rounds(8, 4), rounds(8, 1), rounds(64, 4)) == ([4], [4, 2, 1], [32, 16, 8, 4])
    for start, end in ((8, 3), (8, 8), (12, 4), (4, 8)):
        with pytest.raises(
            UserError, match=f"ddg.training.distil_from is {start} and ddg.sampling.steps {end}"
        ):
            rounds(start, end)


def test_the_teacher_visits_the_students_steps_and_those_between():
    path = distil.teacher_path(1000, 4, np.array([0, 1, 3]), "trailing")
    assert path.tolist() == [[999, 749, 249], [874, 624, 124], [749, 499, -1]]
    for spacing in ("trailing", "quadratic"):
        student = diffusion.timesteps(1000, 4, spacing)
        k, _, end = distil.teacher_path(1000, 4, np.arange(4), spacing)
        np.testing.assert_array_equal(k, student)
        np.testing.assert_array_equal(end, diffusion.previous_steps(student))


@pytest.mark.parametrize("spacing", ["linspace", "leading"])
def test_steps_that_are_no_halves_of_others_are_not_distilled(spacing):
    """Those of 4 evaluations are not every second of 8: the student would be asked what it never saw."""
    assert (diffusion.timesteps(1000, 8, spacing)[::2] != diffusion.timesteps(1000, 4, spacing)).any()
    with pytest.raises(UserError, match=f"spacing is {spacing}; .*give --ddg.sampling.spacing quadratic"):
        dataclasses.replace(DISTILLED, sampling=dataclasses.replace(DISTILLED.sampling, spacing=spacing))


def test_a_round_whose_steps_are_not_halves_of_its_teacher_s_is_refused_before_the_fit():
    distil.check(DISTILLED)
    many = dataclasses.replace(
        DISTILLED,
        training=dataclasses.replace(DISTILLED.training, distil_from=128),
        sampling=dataclasses.replace(DISTILLED.sampling, steps=4, spacing="quadratic"),
        diffusion=dataclasses.replace(DISTILLED.diffusion, steps=1000),
    )
    with pytest.raises(
        UserError, match="distil_from is 128: of 1000 diffusion steps, spacing quadratic, 128 "
    ):
        distil.check(many)


def test_one_step_to_the_target_ends_where_the_teacher_does():
    made = diffusion.make_schedule("cosine", 1000)
    x_k, x_end = jax.random.normal(jax.random.key(0), (2, 3, 4, 5))
    k, end = jnp.array([899, 499, 249]), jnp.array([749, 249, -1])
    x_0 = distil.one_step_target(made, x_k, k, x_end, end)
    eps = diffusion.eps_from_x_0(made, x_k, k, x_0)
    step = diffusion.ddim_coefficients(made, k, end, x_k)
    np.testing.assert_allclose(diffusion.ddim_step(step, x_k, eps, None), x_end, atol=2e-5)
    np.testing.assert_allclose(x_0[2], x_end[2], atol=1e-6)  # the last step ends at x_0 itself


def test_teacher_and_student_see_the_prior_under_the_same_noise(monkeypatch):
    """Not compiled; in the networks' place what they are given."""
    given = []

    def clean(config, params, x_k, c, step):
        given.append(np.asarray(c))
        return params["w"] * x_k

    monkeypatch.setattr(distil, "predict_clean", clean)
    monkeypatch.setattr(distil, "updated", lambda state, *_: state)
    config = dataclasses.replace(DISTILLED, prior=PriorConfig(noise=0.2))
    params = {"w": jnp.float32(0.5)}
    state = first_state(params, optax.identity(), jax.random.key_data(jax.random.key(0)))
    path = distil.teacher_path(100, 4, np.array([0, 1, 2, 3]), "trailing")
    x_0, c = jnp.zeros((4, 16, 24, 2)), jnp.full((4, 16, 24), 0.7)
    distil.distil_step.__wrapped__(config, state, params, 1.0, path, x_0, c)
    assert len(given) == 2
    np.testing.assert_array_equal(given[0], given[1])
    off = given[0] - np.float32(0.7)
    assert off.std() == pytest.approx(0.2, rel=0.05) and abs(off.mean()) < 0.02


@pytest.mark.parametrize(("limit", "order"), [(1.0, 2), (np.inf, 1)])
def test_a_step_is_held_against_two_of_the_teacher_s(monkeypatch, limit, order):
    """The fitted network's x_0 is clipped and its second step of second order; a distilled one's of first.
    Not compiled; the network is linear, and the error weighs as much as the signal to the noise."""
    monkeypatch.setattr(distil, "predict_clean", lambda config, params, x_k, *_: params["w"] * x_k)
    monkeypatch.setattr(distil, "updated", lambda state, *_: state)
    made, w = config_schedule(DISTILLED), 0.8
    params = {"w": jnp.float32(w)}
    state = first_state(params, optax.identity(), jax.random.key_data(jax.random.key(0)))
    k, middle, end = path = distil.teacher_path(made.steps, 4, np.array([0, 1, 2, 3]), "quadratic")
    x_0 = jax.random.uniform(jax.random.key(1), (4, 16, 24, 2), minval=-1.0)
    _, metrics = distil.distil_step.__wrapped__(
        DISTILLED, state, params, limit, path, x_0, jnp.zeros((4, 16, 24))
    )

    eps_key, _, _ = step_keys(state)
    x_k = diffusion.q_sample(made, x_0, jnp.asarray(k), jax.random.normal(eps_key, x_0.shape))
    first = jnp.clip(w * x_k, -limit, limit)
    half = diffusion.dpm_solver_step(made, x_k, k, middle, first, k, x_k)
    second = jnp.clip(w * half, -limit, limit)
    before = k if order == 2 else middle
    x_end = diffusion.dpm_solver_step(made, half, middle, end, second, before, first)
    error = (distil.one_step_target(made, x_k, jnp.asarray(k), x_end, jnp.asarray(end)) - w * x_k) ** 2
    weight = np.clip(diffusion.signal_to_noise(made, jnp.asarray(k)), *DISTILLED.training.snr_limits)
    assert float(metrics["loss"]) == pytest.approx(float(jnp.mean(weight * error.mean((1, 2, 3)))), rel=1e-4)


def test_a_step_s_average_has_the_configured_decay(monkeypatch):
    """Not compiled; decay min(0.9, (1 + n) / (10 + n)) is 0.9 from step 80 on. Half the steps warm up."""
    monkeypatch.setattr(distil, "predict_clean", lambda config, params, x_k, *_: params["w"] * x_k)
    training = dataclasses.replace(DISTILLED.training, distil_steps=500, ema_decay=0.9)
    config = dataclasses.replace(DISTILLED, training=training)
    params = {"w": jnp.float32(0.5)}
    optimizer = train.make_optimizer(config, 500, distil.LEARNING_RATE)
    state = first_state(params, optimizer, jax.random.key_data(jax.random.key(0)))
    state = state.replace(step=jnp.asarray(200))
    path = distil.teacher_path(100, 4, np.array([0, 1, 2, 3]), "trailing")
    x_0, c = jnp.zeros((4, 16, 24, 2)), jnp.full((4, 16, 24), 0.7)
    for _ in range(2):
        state, _ = distil.distil_step.__wrapped__(config, state, params, 1.0, path, x_0, c)
    moved, averaged = (float(tree["w"]) - 0.5 for tree in (state.params, state.ema))
    assert abs(moved) > 1e-6 and averaged == pytest.approx(0.1 * moved, rel=1e-2)


@pytest.fixture(scope="module")
def teacher():
    return jax.tree.map(np.asarray, made_up_teacher())


@pytest.fixture(scope="module")
def directory(teacher, tmp_path_factory):
    """Where a distillation to one evaluation left its files."""
    directory = tmp_path_factory.mktemp("distil")
    progress = Progress(directory, quiet=True)
    distil.distil(DISTILLED, teacher, pictures(), directory, 0, progress)
    progress.close()
    return directory


def samples(config: DDGConfig, params, steps: int) -> np.ndarray:
    generator = sample.Generator(
        dataclasses.replace(config, sampling=dataclasses.replace(config.sampling, steps=steps)),
        params,
        make_prior(config),
    )
    return sample.predict(jax.random.key(7), generator, pictures().prior[:8])


def test_students_of_few_evaluations_follow_the_teacher_of_many(teacher, directory):
    wanted = samples(TINY, teacher, 4)
    for count in (2, 1):
        student = load_params(directory / distil.params_file(count))
        mine = np.mean((samples(DISTILLED, student, count) - wanted) ** 2)
        plain = np.mean((samples(TINY, teacher, count) - wanted) ** 2)
        assert mine < 0.5 * plain, (count, mine, plain)


def test_every_round_leaves_a_curve(directory):
    curves = read_curves(directory)
    for count in (2, 1):
        steps, losses = zip(*curves[f"distil_{count}/loss"], strict=True)
        assert steps == (10, 20, 30, 40, 50, 60)
        assert np.isfinite(losses).all() and np.mean(losses[-2:]) < losses[0]
    assert any((directory / "tb").iterdir())


def test_resume_equals_an_uninterrupted_distillation(teacher, directory, tmp_path):
    class Stop(Exception):
        pass

    class Interrupted(Progress):
        """Stops in the middle of the second round."""

        def scalars(self, step, **values):
            if "distil_1/loss" in values and step == 40:
                raise Stop

    with pytest.raises(Stop):
        distil.distil(DISTILLED, teacher, pictures(), tmp_path, 0, Interrupted(quiet=True))
    assert (tmp_path / distil.params_file(2)).exists() and not (tmp_path / distil.params_file(1)).exists()
    before = (tmp_path / distil.params_file(2)).stat().st_mtime_ns
    distil.distil(DISTILLED, teacher, pictures(), tmp_path, 0, Progress(quiet=True))
    assert (tmp_path / distil.params_file(2)).stat().st_mtime_ns == before
    for count in (2, 1):
        name = distil.params_file(count)
        assert (tmp_path / name).read_bytes() == (directory / name).read_bytes()


def test_a_student_runs_with_its_own_evaluations_only(directory):
    student = load_params(directory / distil.params_file(1))
    generator = sample.Generator(DISTILLED, student, make_prior(DISTILLED))
    with pytest.raises(UserError, match="distilled to 1 evaluations, not 4"):
        sample.predict(jax.random.key(0), generator, pictures().prior[:2], steps=4)
