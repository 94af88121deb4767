"""The prior from a depth network: its weights, its two readings in simulation, its geometry."""

from dataclasses import replace

import jax
import numpy as np
import pytest

from ddg_jax import network_prior, sample, start
from ddg_jax.generate import Clip
from ddg_jax.inverse_depth import NORMALISED_LIMIT, normalise
from ddg_jax.monocular import MonocularDepth
from ddg_jax.prior import InverseDepthPrior, make_prior
from ddgrasp import artifacts
from ddgrasp.config import (
    Config,
    DDGConfig,
    DDGDepthConfig,
    PriorConfig,
    PriorInSim,
    ScoreConfig,
    StudentConfig,
)
from ddgrasp.depth import inverse_depth
from ddgrasp.errors import UserError
from demos.rollout import Scene
from evaluation.depth_score.data import REAL, SIM, Episode
from evaluation.depth_score.domains import Methods, sense
from evaluation.treatments import Monocular, make_treatment
from foundation import store
from student_jax.act import SourceCamera
from student_jax.depth_source import GeneratorSource, MonocularSource
from student_jax.source_check import check_source
from weights_support import depth_anything_v2_small


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    """The small image network's folder, random weights."""
    return depth_anything_v2_small(tmp_path_factory.getbasetemp())


def config(weights, in_sim: PriorInSim = "depth", depth=DDGDepthConfig()) -> DDGConfig:  # noqa: B008
    prior = PriorConfig(source="depth_anything_v2", weights=str(weights), input_px=28, in_sim=in_sim)
    return DDGConfig(prior=prior, depth=depth)


def test_recordings_and_simulation_on_rgb_see_the_network(weights):
    prior = make_prior(config(weights, in_sim="rgb"))
    rgb = np.random.default_rng(1).integers(0, 256, (3, 40, 56, 3)).astype(np.uint8)
    depth = np.ones((3, 20, 28), np.float32)
    c = prior.from_recording(depth, rgb, np.random.default_rng(0))
    assert c.shape == (3, 20, 28) and c.std() > 0.1 and abs(np.median(c)) < 0.1
    np.testing.assert_array_equal(prior.from_sim(depth, rgb), c)
    np.testing.assert_array_equal(prior.from_recording(2 * depth, rgb, np.random.default_rng(1)), c)
    np.testing.assert_array_equal(prior.from_recording(depth, list(rgb), np.random.default_rng(0)), c)
    apart = prior.from_recording(depth, rgb, np.random.default_rng(0), consecutive=False)
    for one, picture in zip(apart, rgb, strict=True):
        np.testing.assert_array_equal(one, prior.from_sim(depth[:1], picture[None])[0])
    assert np.abs(apart - c).max() > 1e-3
    assert isinstance(prior.source, dict)
    assert (prior.source["network"], prior.source["source_sha256"]) == ("depth_anything_v2_small", "ab12")
    with pytest.raises(UserError, match="no RGB"):
        prior.from_sim(depth, None)


def test_the_students_camera_shows_the_prior_each_environment_by_itself(weights, monkeypatch):
    # c itself in place of samples: holes where it is low, no deviations
    monkeypatch.setattr(sample, "predict", lambda key, generator, c, **_: np.stack([c, 0 * c], axis=-1))
    settings = config(weights, in_sim="rgb", depth=DDGDepthConfig(height_px=24, width_px=32))
    prior = make_prior(settings)
    assert prior.needs_sim_rgb and not make_prior(config(weights)).needs_sim_rgb
    rng = np.random.default_rng(2)
    scene = Scene(
        depth_mm=rng.integers(500, 900, (3, 24, 32)).astype(np.uint16),
        step=4,
        rgb=rng.integers(0, 256, (3, 24, 32, 3)).astype(np.uint8),
        **{name: np.zeros(3) for name in ("state", "expert", "observation", "held")},
    )
    camera = SourceCamera(GeneratorSource(sample.Generator(settings, {}, prior), jax.random.key(1)))
    seen = camera(scene)
    for environment in range(3):
        assert scene.rgb is not None
        c = prior.from_sim(np.ones((1, 24, 32), np.float32), scene.rgb[environment : environment + 1])[0]
        clear = np.abs(c - settings.graft.noise_threshold) > 1e-4
        assert 0.05 < np.mean(c < settings.graft.noise_threshold) < 0.95
        np.testing.assert_array_equal(
            (seen[environment] == 0)[clear], (c < settings.graft.noise_threshold)[clear]
        )
    with pytest.raises(UserError, match="no RGB"):
        camera(replace(scene, rgb=None))


def test_simulated_depth_is_normalised_as_the_networks_output(weights):
    depth = np.random.default_rng(0).uniform(0.5, 2, (2, 12, 16)).astype(np.float32)
    prior = make_prior(config(weights))
    assert prior.needs_rgb
    np.testing.assert_array_equal(prior.from_sim(depth, None), normalise(inverse_depth(depth)))


def test_what_was_used_is_said(weights):
    assert make_prior(DDGConfig()).source == "built-in"
    assert isinstance(make_prior(DDGConfig()), InverseDepthPrior)
    with pytest.raises(UserError, match="weights convert"):
        make_prior(config(weights.parent / "nothing"))
    with pytest.raises(
        UserError, match="holds depth_anything_v2_small; ddg.prior.source is video_depth_anything"
    ):
        make_prior(
            DDGConfig(
                prior=PriorConfig(source="video_depth_anything", weights=str(weights)),
            )
        )
    with pytest.raises(UserError, match="Did you mean 'video_depth_anything'"):
        make_prior(DDGConfig(prior=PriorConfig(source="video_depth_anythin")))
    with pytest.raises(UserError, match="Did you mean 'depth'"):
        make_prior(config(weights, in_sim="deph"))


def test_a_generator_starts_with_the_weights_it_was_fitted_on_wherever_they_lie(weights, tmp_path):
    fitted = config(weights)
    metrics = {"prior_source": make_prior(fitted).source}
    artifacts.finish(tmp_path / "ddg", "ddg", Config("test", ddg=fitted), seconds=1.0, metrics=metrics)
    for name, digest in (("moved", "ab12"), ("other", "cd34")):
        (tmp_path / name).mkdir()
        said = (weights / store.MANIFEST).read_text().replace("ab12", digest)
        (tmp_path / name / store.MANIFEST).write_text(said)

    def starting(folder: str, **prior) -> DDGConfig:
        given = config(tmp_path / folder)
        return replace(given, init_from=str(tmp_path / "ddg"), prior=replace(given.prior, **prior))

    start.check(starting("moved", blur_px=3.0, in_sim="rgb"))
    with pytest.raises(UserError, match="by weights of SHA-256 ab12, those in .*other are of cd34: give"):
        start.check(starting("other"))
    with pytest.raises(UserError, match="ddg.prior.input_px 28, this configuration 42"):
        start.check(starting("moved", input_px=42))


def test_prior_and_depth_of_other_aspect_ratios_show_the_same_part():
    ramp = np.tile(np.arange(64, dtype=np.float32), (36, 1))
    np.testing.assert_allclose(network_prior.at_size(ramp, (18, 32))[0], np.arange(32) * 2 + 0.5, atol=1e-5)
    tall = np.tile(np.arange(64, dtype=np.float32), (64, 1)).T
    np.testing.assert_allclose(
        network_prior.at_size(tall, (16, 32))[:, 0], np.arange(16) * 2 + 16.5, atol=1e-5
    )


def test_monocular_depth_is_fitted_to_the_measured_one():
    rng = np.random.default_rng(0)
    relative = rng.uniform(1, 4, (6, 8)).astype(np.float32)
    truth = 1 / (0.5 * relative + 0.2)
    measured = np.where(rng.random((6, 8)) < 0.5, truth, 0)
    np.testing.assert_allclose(network_prior.metric_depth(relative, measured, 10.0), truth, rtol=1e-5)
    with pytest.raises(UserError, match="no two valid"):
        network_prior.metric_depth(relative, np.zeros((6, 8)), 10.0)
    nearer = network_prior.metric_depth(relative, measured, 1.0)
    np.testing.assert_allclose(nearer, np.minimum(truth, 1.0), rtol=1e-5)
    for blind in (np.full_like(relative, 3.0), -relative):  # tells nothing, or takes near for far
        alike = network_prior.metric_depth(blind, measured, 10.0)
        np.testing.assert_allclose(alike, 1 / np.mean(1 / measured[measured > 0]), rtol=1e-5)


def test_monocular_depth_has_the_scale_of_what_was_measured_and_no_holes(weights):
    settings = config(weights)
    network = MonocularDepth(settings, str(weights))
    rng = np.random.default_rng(5)
    rgb = rng.integers(0, 256, (2, 28, 42, 3)).astype(np.uint8)
    relative = network_prior.DepthNetworkPrior(config(weights)).relative(rgb, (28, 42))
    truth_m = 1 / (0.2 * (relative - relative.mean()) / relative.std() + 1.5)
    truth_m[:, :3] = 0.0  # a hole does not count, and is filled
    made_mm = network(np.round(1000 * truth_m).astype(np.uint16), rgb)
    np.testing.assert_allclose(made_mm[:, 3:], 1000 * truth_m[:, 3:], atol=3)
    assert made_mm.dtype == np.uint16 and (made_mm > 0).all()
    nothing = network(np.zeros((1, 28, 42), np.uint16), rgb[:1])
    assert not nothing.any()


def test_monocular_depth_of_a_perfect_network_is_the_measured_one_far_and_near(weights, monkeypatch):
    inverse = np.full((1, 24, 32), 0.5, np.float32)  # a wall at 2 m
    inverse[:, 12:] = 0.4
    inverse[:, 9:12, 14:17] = 2.0  # a thing at 0.5 m: many mean deviations from the wall
    assert np.abs(normalise(inverse)).max() == NORMALISED_LIMIT
    monkeypatch.setattr(
        network_prior.DepthNetworkPrior, "_infer", staticmethod(lambda rgb, size: 3 * inverse - 0.2)
    )
    truth_mm, rgb = np.rint(1000 / inverse).astype(np.uint16), np.zeros((1, 24, 32, 3), np.uint8)
    settings = config(weights)
    np.testing.assert_allclose(MonocularDepth(settings, str(weights))(truth_mm, rgb), truth_mm, atol=1)
    generator = sample.Generator(settings, {}, make_prior(settings))
    methods = Methods(ScoreConfig(monocular_weights=str(weights)), 0, generator)
    for side, sensed_mm in ((REAL, truth_mm), (SIM, 0 * truth_mm)):
        episode = Episode(side, 0, 0, sensed_mm, truth_mm, truth_mm[:0], rgb, 30.0, 0.05)
        name = f"{side}_monocular"
        np.testing.assert_allclose(sense(methods, episode, [name])[name], truth_mm, atol=1)


def test_student_and_rig_get_the_same_monocular_depth(weights):
    settings = config(weights)
    source = MonocularSource(MonocularDepth(settings, str(weights)))
    rng = np.random.default_rng(6)
    rgb = rng.integers(0, 256, (2, 28, 42, 3)).astype(np.uint8)
    depth_mm = rng.integers(500, 900, (2, 28, 42)).astype(np.uint16)
    number = np.zeros(2, int)
    frames = source.frames(depth_mm, rgb, number, number)
    (episode,) = source.episodes([2], lambda i: Clip(i, depth_mm, rgb))
    np.testing.assert_array_equal(episode, frames)
    treatment = Monocular(settings, str(weights))
    on_line = np.stack([treatment(d, c) for d, c in zip(depth_mm, rgb, strict=True)])
    assert np.abs(on_line.astype(int) - frames).max() <= 1  # alone or in a batch, up to rounding
    metres = treatment((depth_mm[0] / 1000).astype(np.float32), rgb[0])
    assert metres.dtype == np.float32 and np.abs(1000 * metres - on_line[0]).max() <= 1


def test_monocular_depth_without_weights_is_one_line(tmp_path, monkeypatch):
    monkeypatch.setattr(store, "WEIGHTS_DIR", tmp_path)
    settings = Config(preset="test", student=StudentConfig(depth_source="monocular"))
    for ask in (
        lambda: check_source(settings),
        lambda: make_treatment("monocular", settings),
    ):
        with pytest.raises(UserError, match="depth_anything_v2_small holds no converted weights: get a file"):
            ask()
    assert make_treatment("recorded", settings) is None
