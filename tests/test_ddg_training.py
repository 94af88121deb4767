"""Training, resume and sampling on pictures small enough for seconds."""

import dataclasses
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from ddg_jax import sample, train
from ddg_jax.data import Frames
from ddg_jax.prior import make_prior
from ddg_jax.representation import correlations
from ddgrasp.config import (
    CROSS_ENTROPY,
    HOLE_LOSSES,
    SQUARED,
    DDGConfig,
    DDGDepthConfig,
    DDGDiffusionConfig,
    DDGTrainingConfig,
    GraftConfig,
    PriorConfig,
    SamplingConfig,
    UNetConfig,
)
from ddgrasp.errors import UserError
from ddgrasp.progress import Progress
from learning import diffusion as schedule
from learning.train_state import first_state
from xla_support import optimized

TINY = DDGConfig(
    depth=DDGDepthConfig(height_px=16, width_px=24),
    unet=UNetConfig(widths=(16, 16), blocks=(0, 1), attention_heads=2),
    diffusion=DDGDiffusionConfig(steps=100),
    training=DDGTrainingConfig(steps=6, batch_size=8, checkpoint_every=4, learning_rate=3e-3),
    sampling=SamplingConfig(batch_size=4),
    prior=PriorConfig(blur_px=0.0),
)


def pictures(count: int = 16) -> Frames:
    """A near square at a random place; the sensor loses the four columns left of it."""
    rng = np.random.default_rng(0)
    clean = np.full((count, TINY.depth.height_px, TINY.depth.width_px), 2.0, np.float32)
    noisy = clean.copy()
    for i in range(count):
        row, column = rng.integers(2, 8), rng.integers(6, 16)
        clean[i, row : row + 6, column : column + 6] = 0.8
        noisy[i, row : row + 6, column : column + 6] = 0.8
        noisy[i, row : row + 6, column - 4 : column] = 0
    c = np.stack([make_prior(TINY).from_sim(f[None], None)[0] for f in clean]).astype(np.float16)
    return Frames(noisy, clean, c, np.zeros(count, int))


def test_an_error_in_the_clean_map_weighs_snr_within_its_limits():
    config = dataclasses.replace(TINY, training=dataclasses.replace(TINY.training, snr_limits=(0.5, 3.0)))
    step = np.arange(config.diffusion.steps)
    snr = np.asarray(schedule.signal_to_noise(train.config_schedule(config), step))
    assert snr.min() < 0.5 and snr.max() > 3.0
    # An error e in x_0 is sqrt(SNR) e in eps.
    per_x_0 = np.asarray(train.loss_weight(config, step)) * snr
    np.testing.assert_allclose(per_x_0, np.clip(snr, 0.5, 3.0), rtol=1e-5)


def test_log_odds_are_those_of_bayes_rule():
    config, k = (
        dataclasses.replace(TINY, training=dataclasses.replace(TINY.training, hole_loss=CROSS_ENTROPY)),
        np.array([5, 50, 90]),
    )
    alpha_bar = train.config_schedule(config).alpha_bars[k].astype(np.float64)[:, None, None]
    rng = np.random.default_rng(0)
    x_k, output = rng.normal(0, 0.3, (2, 3, 4, 5, 2))

    def log_density(x_0):
        return -((x_k[..., 0] - np.sqrt(alpha_bar) * x_0) ** 2) / (2 * (1 - alpha_bar))

    prior = train.LOG_ODDS_PER_OUTPUT * output[..., 0]
    expected = prior + log_density(1.0) - log_density(-1.0)
    made = train.valid_log_odds(config, *map(np.float32, (output, x_k)), k)
    np.testing.assert_allclose(made, expected, rtol=1e-4, atol=1e-3)


@pytest.mark.parametrize("hole_loss", HOLE_LOSSES)
def test_the_loss_weighs_errors_of_the_clean_map(hole_loss):
    config = dataclasses.replace(
        TINY,
        training=dataclasses.replace(TINY.training, hole_loss=hole_loss, snr_limits=(0.5, 3.0)),
    )
    rng = np.random.default_rng(0)
    x_0 = np.stack([rng.choice([-1.0, 1.0], (4, 16, 24)), rng.normal(0, 0.2, (4, 16, 24))], -1)
    x_0, eps, c = (np.float32(v) for v in (x_0, rng.normal(size=x_0.shape), rng.normal(size=(4, 16, 24))))
    k, made = np.array([3, 40, 70, 95]), train.config_schedule(config)
    params = train.init_params(config, jax.random.key(0))
    x_k = schedule.q_sample(made, x_0, k, eps)
    clean = np.asarray(train.predict_clean(config, params, x_k, c, k), np.float64)
    error = (clean - x_0) ** 2
    if hole_loss == CROSS_ENTROPY:
        right = np.clip((1 + clean * x_0)[..., 0] / 2, 1e-12, 1)  # probability of what is there
        error[..., 0] = -2 * np.log(right)
    weight = np.clip(np.asarray(schedule.signal_to_noise(made, k)), 0.5, 3.0)
    expected = np.mean(weight * error.mean((1, 2, 3)))
    np.testing.assert_allclose(train.noise_loss(config, params, x_0, c, k, eps), expected, rtol=2e-3)


def test_uniform_weights_are_equation_4_as_the_paper_has_it():
    training = dataclasses.replace(TINY.training, loss_weight="uniform", hole_loss="squared")
    config = dataclasses.replace(TINY, training=training)
    rng = np.random.default_rng(0)
    x_0, eps, c = (np.float32(rng.normal(size=(4, 16, 24, 2)[:n])) for n in (4, 4, 3))
    k, params = np.array([3, 40, 70, 95]), train.init_params(config, jax.random.key(0))
    x_k = schedule.q_sample(train.config_schedule(config), x_0, k, eps)
    off = eps - np.asarray(train.predict_noise(config, params, x_k, c, k), np.float64)
    np.testing.assert_allclose(train.noise_loss(config, params, x_0, c, k, eps), np.mean(off**2), rtol=2e-3)


@pytest.mark.parametrize(
    ("section", "change", "message"),
    [
        (SamplingConfig, {"sampler": "progresive"}, "ddg.sampling.sampler.*Did you mean 'progressive'"),
        (SamplingConfig, {"spacing": "quadratc"}, "ddg.sampling.spacing.*Did you mean 'quadratic'"),
        (DDGTrainingConfig, {"loss_weight": "trunc"}, "ddg.training.loss_weight.*truncated"),
        (SamplingConfig, {"eta": 5.0}, "ddg.sampling.eta is 5.0; expected 0"),
    ],
)
def test_wrong_options_are_refused_before_anything_is_fitted(section, change, message):
    with pytest.raises(UserError, match=message):
        section(**change)


def test_cross_entropy_needs_holes_of_their_own_channel():
    with pytest.raises(UserError, match="hole_loss cross_entropy needs holes in a channel"):
        DDGConfig(
            training=DDGTrainingConfig(hole_loss=CROSS_ENTROPY),
            depth=DDGDepthConfig(representation="depth"),
            graft=GraftConfig(noise_threshold=-0.2),
        )
    with pytest.raises(UserError, match="crossentropy"):
        DDGConfig(training=DDGTrainingConfig(hole_loss="crossentropy"))


def test_a_step_puts_the_configured_noise_on_the_prior(monkeypatch):
    """Not compiled; in the loss's place what the network would be given."""
    given = []

    def loss(config, params, x_0, c, step, eps):
        given.append(c)
        return params["w"]

    monkeypatch.setattr(train, "noise_loss", loss)
    monkeypatch.setattr(train, "updated", lambda state, *_: state)
    config = dataclasses.replace(TINY, prior=dataclasses.replace(TINY.prior, noise=0.2))
    params = {"w": np.float32(1.0)}
    state = first_state(params, optax.identity(), jax.random.key_data(jax.random.key(0)))
    x_0, c = np.zeros((8, 16, 24, 2), np.float32), np.full((8, 16, 24), 0.7, np.float32)
    train.train_step.__wrapped__(config, state, x_0, c)
    off = np.asarray(given[0]) - c
    assert off.std() == pytest.approx(0.2, rel=0.05) and abs(off.mean()) < 0.02


def test_a_step_s_average_has_the_configured_decay(monkeypatch):
    """Not compiled; decay min(0.9, (1 + n) / (10 + n)) is 0.9 from step 80 on. The first step has rate 0."""
    monkeypatch.setattr(train, "noise_loss", lambda config, params, *_: params["w"])
    config = dataclasses.replace(TINY, training=dataclasses.replace(TINY.training, steps=500, ema_decay=0.9))
    key = jax.random.key_data(jax.random.key(0))
    state = first_state({"w": np.float32(0.5)}, train.make_optimizer(config, 500), key)
    state = state.replace(step=jnp.asarray(200))
    for _ in range(2):
        state, _ = train.train_step.__wrapped__(
            config, state, np.zeros((8, 16, 24, 2)), np.zeros((8, 16, 24))
        )
    moved, averaged = (float(tree["w"]) - 0.5 for tree in (state.params, state.ema))
    assert abs(moved) > 1e-6 and averaged == pytest.approx(0.1 * moved, rel=1e-2)


def test_resume_equals_an_uninterrupted_run(tmp_path):
    frames, quiet = pictures(), Progress(quiet=True)
    straight = train.fit(TINY, frames, tmp_path / "straight", 0, quiet)

    class Stop(Exception):
        pass

    class Interrupted(Progress):
        left = 5  # the task's start and four steps

        def _tick(self):
            self.left -= 1
            if self.left == 0:
                raise Stop

    with pytest.raises(Stop):
        train.fit(TINY, frames, tmp_path / "resumed", 0, Interrupted(quiet=True))
    assert [p.name for p in (tmp_path / "resumed/checkpoints").iterdir()] == ["4"]
    resumed = train.fit(TINY, frames, tmp_path / "resumed", 0, quiet)
    jax.tree.map(np.testing.assert_array_equal, resumed, straight)
    fresh = train.init_state(TINY, jax.random.key_data(jax.random.key(0))).params
    assert any(
        not np.array_equal(a, b)
        for a, b in zip(jax.tree.leaves(fresh), jax.tree.leaves(straight), strict=True)
    )


@pytest.fixture(scope="module")
def fit_by(tmp_path_factory):
    """hole_loss -> generator fitted with it, once."""

    @cache
    def fitted_generator(hole_loss: str) -> sample.Generator:
        config = dataclasses.replace(
            TINY,
            training=dataclasses.replace(
                TINY.training, steps=300, batch_size=16, checkpoint_every=1000, hole_loss=hole_loss
            ),
        )
        train.init_state(config, jax.random.key_data(jax.random.key(0)))  # optimised it takes 30 s to compile
        with optimized():
            params = train.fit(config, pictures(64), tmp_path_factory.mktemp("ddg"), 0, Progress(quiet=True))
        return sample.Generator(config, params, make_prior(config))

    return fitted_generator


@pytest.fixture(scope="module")
def fitted(fit_by):
    return fit_by(SQUARED)


@pytest.fixture(scope="module")
def scene():
    """Clean depth never seen in training."""
    depth = np.full((6, TINY.depth.height_px, TINY.depth.width_px), 2.0, np.float32)
    depth[:, 5:11, 11:17] = 0.8
    return depth


@pytest.mark.parametrize("hole_loss", HOLE_LOSSES)
def test_generator_learns_where_the_sensor_loses_pixels(fit_by, scene, hole_loss):
    fitted = fit_by(hole_loss)
    made = sample.generate(jax.random.key(0), fitted, scene)
    holes = made.depth_m == 0
    shadow = np.zeros_like(holes)
    shadow[:, 5:11, 7:11] = True
    assert holes[shadow].mean() > 0.8, holes[shadow].mean()
    assert holes[~shadow].mean() < 0.05, holes[~shadow].mean()
    assert made.depth_m[~made.mask].tobytes() == scene[~made.mask].tobytes()
    np.testing.assert_array_equal(holes, made.predicted_m == 0)
    # this sensor loses pixels and errs nowhere else
    assert np.median(np.abs(1 / made.predicted_m[~holes] - 1 / scene[~holes])) < 0.002


def test_generation_does_not_depend_on_batching(fitted, scene):
    key = jax.random.key(3)
    all_at_once = sample.predict(key, fitted, fitted.prior.from_sim(scene, None), episode=2)
    other = dataclasses.replace(
        fitted,
        config=dataclasses.replace(
            fitted.config, sampling=dataclasses.replace(fitted.config.sampling, batch_size=3)
        ),
    )
    np.testing.assert_allclose(
        sample.predict(key, other, fitted.prior.from_sim(scene, None), episode=2), all_at_once, atol=2e-4
    )


def test_frame_noise_is_standard_normal_with_the_stated_correlation():
    key, frame = jax.random.key(0), np.array([0, 1])
    one, other = (sample.frame_noise(key, e, frame, (200, 200), 0.9) for e in (0, 1))
    noise = np.concatenate([one, other])
    np.testing.assert_allclose(noise.std(axis=(1, 2)), 1, atol=0.02)
    correlation = np.corrcoef(noise.reshape(4, -1))
    assert abs(correlation[0, 1] - 0.9) < 0.01 and abs(correlation[0, 2]) < 0.02
    mixed = sample.frame_noise(key, np.array([1, 0]), frame, (200, 200), 0.9)
    np.testing.assert_allclose(mixed, [other[0], one[1]], atol=1e-6)


def test_every_channel_has_its_own_correlation(fitted):
    config = dataclasses.replace(
        fitted.config,
        sampling=dataclasses.replace(
            fitted.config.sampling, frame_correlation=0.9, deviation_correlation=0.2
        ),
    )
    assert correlations(config) == (0.9, 0.2)
    assert correlations(
        dataclasses.replace(
            config,
            depth=dataclasses.replace(config.depth, representation="depth"),
            graft=dataclasses.replace(config.graft, noise_threshold=-0.2),
        )
    ) == (0.9,)
    shape = (200, 200, 2)
    noise = sample.frame_noise(jax.random.key(0), 3, np.array([0, 1]), shape, correlations(config))
    for channel, expected in enumerate(correlations(config)):
        one, other = np.asarray(noise[..., channel]).reshape(2, -1)
        assert abs(np.corrcoef(one, other)[0, 1] - expected) < 0.02


def test_surfaces_change_in_time_with_the_noise_of_deviations(fitted, scene):
    """A still scene sensed again: less in common, more change."""

    def change(correlation: float) -> float:
        config = dataclasses.replace(
            fitted.config,
            sampling=dataclasses.replace(fitted.config.sampling, deviation_correlation=correlation),
        )
        generator = dataclasses.replace(fitted, config=config)
        x = sample.predict(jax.random.key(1), generator, fitted.prior.from_sim(scene, None), episode=0)
        deviation = np.asarray(x)[..., 1]
        return float(np.mean(np.abs(deviation[1:] - deviation[:-1])))

    assert change(0.0) > 1.2 * change(0.95)


def test_batch_of_environments_equals_their_episodes(fitted, scene):
    key = jax.random.key(5)
    batch = sample.generate(key, fitted, scene[:2], episode=np.array([4, 7]), frame=np.array([0, 0]))
    alone = sample.generate(key, fitted, scene[:1], episode=7)
    np.testing.assert_array_equal(batch.depth_m[1], alone.depth_m[0])


def test_ancestral_sampler_and_bad_input(fitted, scene):
    ddpm = dataclasses.replace(
        fitted,
        config=dataclasses.replace(
            fitted.config, sampling=dataclasses.replace(fitted.config.sampling, sampler="ddpm")
        ),
    )
    holes = sample.generate(jax.random.key(1), ddpm, scene[:2], steps=20).depth_m == 0
    assert holes[:, 5:11, 7:11].mean() > 0.6
    with pytest.raises(UserError, match="uint16"):
        sample.generate(jax.random.key(0), fitted, (scene * 1000).astype(np.uint16))
    with pytest.raises(UserError, match="aspect"):
        sample.generate(jax.random.key(0), fitted, scene[:, :, :16])
    with pytest.raises(UserError, match="millimetres"):
        sample.generate(jax.random.key(0), fitted, scene * 1000)


def test_a_shape_that_is_nearly_the_generator_s_is_refused():
    sample.check_aspect((160, 243), TINY)
    with pytest.raises(UserError, match="render with that aspect ratio"):
        sample.check_aspect((160, 250), TINY)
