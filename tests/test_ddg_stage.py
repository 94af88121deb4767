"""The stage from recordings on disk to a generator that loads again, at a size that takes seconds."""

import contextlib
import dataclasses
import re
from pathlib import Path

import cv2
import jax
import numpy as np
import pytest

from app.commands import parse
from ddg_jax import stage, start
from ddg_jax.representation import LIMIT_PER_M
from ddg_jax.sample import Generator, generate, predict
from ddgrasp import artifacts
from ddgrasp.config import (
    Config,
    DDGConfig,
    DDGDepthConfig,
    DDGDiffusionConfig,
    DDGTrainingConfig,
    GraftConfig,
    SamplingConfig,
    UNetConfig,
)
from ddgrasp.errors import UserError
from ddgrasp.presets import get_preset
from ddgrasp.progress import Progress, read_curves
from ddgrasp.shipped import PRETRAINED
from job_support import make_job
from learning.params import load_params
from recording_support import flat, write_depth

CONFIG = Config(
    preset="test",
    ddg=DDGConfig(
        depth=DDGDepthConfig(height_px=16, width_px=24),
        unet=UNetConfig(widths=(8, 8), blocks=(0, 1), attention_heads=1),
        diffusion=DDGDiffusionConfig(steps=100),
        training=DDGTrainingConfig(steps=10, batch_size=4, holdout_fraction=0.25),
        sampling=SamplingConfig(steps=2, batch_size=4),
        graft=GraftConfig(noise_threshold=0.0),
    ),
)


@pytest.fixture(scope="module")
def recordings(tmp_path_factory):
    root = tmp_path_factory.mktemp("recordings")
    frames = [flat((32, 48), 900) for _ in range(4)]
    for t, depth in enumerate(frames):
        depth[8:20, 20 + 2 * t : 30 + 2 * t] = 600
        depth[8:20, 16 + 2 * t : 20 + 2 * t] = 0
    for name in ("a", "b"):
        write_depth(root / name, frames, consecutive_frames=True)
    return root


@pytest.fixture(scope="module")
def fitted(recordings, tmp_path_factory):
    directory = tmp_path_factory.mktemp("run") / "ddg"
    progress = Progress(directory, "ddg", quiet=True)
    artifact = stage.run(make_job("ddg", CONFIG, directory, progress, data=recordings))
    progress.close()
    return artifact


def test_manifest_says_what_was_made(fitted):
    metrics = fitted.manifest.metrics
    assert fitted.manifest.origin == "trained" and metrics["prior"] == "inverse_depth"
    assert metrics["frames"] == {
        "training": 6,
        "held_out": 2,
        "skipped": 0,
        "refused_recordings": 0,
    }
    # a quarter of the pixels: rows 4 to 9 and two columns of 16 x 24; frames 2 and 3 of the second recording
    # are held out, and the hole moves by one of these columns
    assert metrics["recorded"]["flicker_fraction"] == pytest.approx(12 / 384, abs=1e-6)
    assert metrics["recorded"]["invalid_fraction"] == pytest.approx(12 / 384, abs=1e-6)
    assert metrics["recorded"]["deviation_median_per_m"] < 1e-5
    assert metrics["generated"]["deviation_p99_per_m"] <= LIMIT_PER_M * 1.001
    assert [step for step, _ in read_curves(fitted.directory)["loss"]] == [10]
    picture = cv2.imread(str(fitted.directory / "samples.png"))
    assert picture.shape == (4 * 16, 2 * 24, 3)


def test_deviation_is_that_of_inverse_depth_where_both_are_known():
    depth_m = np.array([[[1.0, 0.0, 2.0, 1.0]]], np.float32)
    surface_m = np.array([[[1.25, 1.0, 2.0, 0.0]]], np.float32)  # 0.2 1/m, a hole, 0, none
    assert stage.deviation_statistics(depth_m, surface_m) == pytest.approx(
        {"deviation_median_per_m": 0.1, "deviation_p99_per_m": 0.198}
    )


def test_a_generator_is_not_fitted_on_the_frames_that_it_is_judged_on(recordings, tmp_path, monkeypatch):
    """In the fit's and the score's place what they are given."""
    given = {}

    def fitted(config, prior, frames, directory, seed, progress):
        given["fit"] = frames

    def scored(generator, frames, progress):
        given["score"] = frames
        return {}

    monkeypatch.setattr(stage, "fitted_generator", fitted)
    monkeypatch.setattr(stage, "_score", scored)
    stage.run(make_job("ddg", CONFIG, tmp_path / "ddg", data=recordings))
    assert given["fit"].recording.tolist() == [0, 0, 0, 0, 1, 1]
    assert given["score"].recording.tolist() == [1, 1]


def test_generator_loads_and_generates_at_another_size(fitted):
    generator = Generator.load(fitted.directory)
    depth = np.full((3, 32, 48), 0.9, np.float32)
    made = generate(jax.random.key(0), generator, depth)
    assert made.depth_m.shape == depth.shape
    assert made.mask.shape == depth.shape
    assert made.depth_m[~made.mask].tobytes() == depth[~made.mask].tobytes()


def test_sampling_sees_the_prior_that_training_saw_however_large(fitted):
    generator = Generator.load(fitted.directory)
    near, nearer = (predict(jax.random.key(0), generator, np.full((2, 16, 24), c)) for c in (3.0, 5.0))
    assert np.abs(near - nearer).max() > 1e-3


def test_sample_folder_draws_a_picture(fitted, recordings, tmp_path):
    path = stage.sample_folder(
        fitted.directory, recordings, tmp_path, seed=0, progress=Progress(quiet=True), count=3
    )
    assert cv2.imread(str(path)).shape == (4 * 16, 3 * 24, 3)


def test_the_camera_presets_generator_fits_and_samples_with_fresh_noise(recordings, tmp_path):
    camera, change = get_preset("camera").ddg, dataclasses.replace
    small = change(
        camera,
        depth=change(camera.depth, height_px=CONFIG.ddg.depth.height_px, width_px=CONFIG.ddg.depth.width_px),
        unet=change(camera.unet, widths=CONFIG.ddg.unet.widths, attention_heads=1, blocks=(1, 1)),
        diffusion=change(camera.diffusion, steps=CONFIG.ddg.diffusion.steps),
        training=change(camera.training, steps=10),
        sampling=change(camera.sampling, batch_size=4),
    )
    config = change(CONFIG, ddg=small)
    progress = Progress(tmp_path / "ddg", "ddg", quiet=True)
    fitted = stage.run(make_job("ddg", config, tmp_path / "ddg", progress, data=recordings))
    progress.close()
    assert fitted.manifest.metrics["prior"] == "metric_inverse_depth"
    generator = Generator.load(fitted.directory)
    assert (
        generator.config.sampling.sampler,
        generator.config.sampling.eta,
        generator.config.sampling.steps,
    ) == ("ddim", 1.0, 2)
    c = np.zeros((3, 16, 24), np.float32)
    made = predict(jax.random.key(0), generator, c)
    np.testing.assert_array_equal(predict(jax.random.key(0), generator, c), made)
    # fresh noise is each frame's own, however they are batched
    last = predict(jax.random.key(0), generator, c[2:], frame=np.array([2]))
    np.testing.assert_allclose(last[0], made[2], atol=1e-5)
    calm = dataclasses.replace(
        generator,
        config=dataclasses.replace(
            generator.config, sampling=dataclasses.replace(generator.config.sampling, eta=0.0)
        ),
    )
    assert np.abs(predict(jax.random.key(0), calm, c) - made).max() > 1e-2


def test_starting_from_a_fitted_generator(fitted, recordings, tmp_path, capsys):
    config = dataclasses.replace(
        CONFIG,
        ddg=dataclasses.replace(
            CONFIG.ddg,
            init_from=str(fitted.directory),
            sampling=dataclasses.replace(CONFIG.ddg.sampling, steps=3),
        ),
    )
    loaded = stage.run(make_job("ddg", config, tmp_path / "ddg", Progress(tmp_path / "ddg"), data=recordings))
    there = CONFIG.ddg.sampling.steps
    said = f"{fitted.directory} was made to draw otherwise: ddg.sampling.steps 3 (there {there})"
    assert said in capsys.readouterr().err
    assert loaded.manifest.origin == "loaded" and loaded.manifest.metrics["frames"]["training"] == 0
    before, after = (load_params(a.directory / "params.msgpack") for a in (fitted, loaded))
    jax.tree.map(np.testing.assert_array_equal, before, after)
    for change, message in (
        ({"depth": dataclasses.replace(CONFIG.ddg.depth, far_m=5.0)}, "ddg.depth.far_m 10.0.*5.0"),
        (
            {"training": dataclasses.replace(CONFIG.ddg.training, hole_loss="cross_entropy")},
            "ddg.training.hole_loss 'squared'.*'cross_entropy'",
        ),
        ({"unet": dataclasses.replace(CONFIG.ddg.unet, position=True)}, "ddg.unet.position False.*True"),
    ):
        other = dataclasses.replace(config, ddg=dataclasses.replace(config.ddg, **change))
        with pytest.raises(UserError, match=message):
            stage.run(make_job("ddg", other, tmp_path / "other", Progress(quiet=True), data=recordings))


@pytest.mark.parametrize(
    ("prior", "message"),
    [
        ({"blur_px": 2.0}, "ddg.prior.blur_px 1.0, this configuration 2.0"),
        ({"noise": 0.1}, "ddg.prior.noise 0.03, this configuration 0.1"),
        ({"source": "metric_inverse_depth"}, "ddg.prior.source 'inverse_depth'"),
        ({"noise": 0.1, "blur_px": 2.0}, r"blur_px 1.0.*2.0 \(others: prior.noise\): .* with \(test\)"),
        ({"jitter": 0.0, "decoy_holes": 0.0, "in_sim": "rgb", "input_px": 28, "weights": "x"}, ""),
    ],
)
def test_a_generator_starts_with_the_prior_it_was_fitted_on(fitted, prior, message):
    prior = dataclasses.replace(CONFIG.ddg.prior, **prior)
    ddg = dataclasses.replace(CONFIG.ddg, init_from=str(fitted.directory), prior=prior)
    with pytest.raises(UserError, match=message) if message else contextlib.nullcontext():
        start.check(ddg)


def test_the_stage_distils_and_its_folder_holds_every_sampler(fitted, recordings, tmp_path):
    config = dataclasses.replace(
        CONFIG,
        ddg=dataclasses.replace(
            CONFIG.ddg,
            init_from=str(fitted.directory),
            sampling=dataclasses.replace(CONFIG.ddg.sampling, sampler="progressive", steps=1),
            training=dataclasses.replace(CONFIG.ddg.training, distil_from=4, distil_steps=4),
        ),
    )
    directory = tmp_path / "ddg"
    stage.run(make_job("ddg", config, directory, Progress(directory, quiet=True), data=recordings))
    before = load_params(fitted.directory / "params.msgpack")
    plain = Generator.load(directory, "ddim", 50)
    jax.tree.map(np.testing.assert_array_equal, plain.params, before)
    assert (plain.config.sampling.sampler, plain.config.sampling.steps) == ("ddim", 50)
    one, two = Generator.load(directory), Generator.load(directory, steps=2)
    assert (one.config.sampling.steps, two.config.sampling.steps) == (1, 2)
    weights = [jax.tree.leaves(generator.params) for generator in (plain, one, two)]
    assert not any(np.array_equal(weights[a][0], weights[b][0]) for a, b in ((0, 1), (1, 2), (0, 2)))
    depth = np.full((2, 16, 24), 0.9, np.float32)
    assert generate(jax.random.key(0), one, depth).depth_m.shape == depth.shape
    with pytest.raises(UserError, match="distilled_4.msgpack.*ddg distil --model") as refused:
        Generator.load(directory, steps=4)
    remedy = re.findall("`ddgrasp ddg distil ([^`]*)`", str(refused.value))[0]
    assert parse("ddg distil", remedy.split()).evaluations == 4  # a command that can be given
    with pytest.raises(UserError, match="Did you mean 'progressive'"):
        Generator.load(directory, "progresive")
    # the fitted network, not the distilled one, is where another stage starts
    again = dataclasses.replace(CONFIG, ddg=dataclasses.replace(CONFIG.ddg, init_from=str(directory)))
    loaded = stage.run(
        make_job("ddg", again, tmp_path / "x", Progress(tmp_path / "x", quiet=True), data=recordings)
    )
    jax.tree.map(np.testing.assert_array_equal, load_params(loaded.directory / "params.msgpack"), before)


def test_a_model_whose_steps_cannot_be_halved_is_distilled_to_quadratic_ones(
    fitted, recordings, tmp_path, capsys
):
    ddg = dataclasses.replace(
        CONFIG.ddg,
        init_from=str(fitted.directory),
        sampling=dataclasses.replace(CONFIG.ddg.sampling, sampler="ddim", spacing="linspace"),
    )
    model = tmp_path / "model" / "ddg"
    progress = Progress(model, quiet=True)
    stage.run(make_job("ddg", dataclasses.replace(CONFIG, ddg=ddg), model, progress, data=recordings))
    folders = ["--model", str(model), "--data", str(recordings), "--out", str(tmp_path)]
    parse("ddg distil", [*folders, "--evaluations", "8", "--steps", "2"]).run()
    made = Generator.load(tmp_path / "ddg").config.sampling
    assert (made.sampler, made.steps, made.spacing) == ("progressive", 8, "quadratic")
    assert "steps are linspace, which cannot be halved" in capsys.readouterr().err


def test_the_page_s_fit_of_log_odds_is_the_one_that_its_table_scores():
    """That preset `laptop` has planes, positions and linspace steps since then does not change it."""
    page = (Path(__file__).parents[1] / "docs" / "generator_log.md").read_text()
    command = re.findall("`ddgrasp ddg fit ([^`]*--ddg.training.hole-loss[^`]*)`", page)[0]
    scored = DDGConfig(training=DDGTrainingConfig(steps=1200, hole_loss="cross_entropy"))
    assert parse("ddg fit", command.split()).config.ddg == scored
    assert (scored.sampling.sampler, scored.sampling.steps) == ("dpm_solver", 4)  # the table's first row


def shown_settings(ddg: DDGConfig) -> list[str]:
    """A column of docs/generator.md's table, below its head."""
    least, most = ddg.training.snr_limits
    sampling, graft = ddg.sampling, ddg.graft
    window = f"{graft.window_px:g}" + (f", `{graft.window_shape}`" if graft.window_px else "")
    holes = ddg.training.hole_loss.replace("_", "-")
    return [
        f"`{ddg.depth.surface}`",
        f"`{ddg.prior.source}`",
        "yes" if ddg.unet.position else "no",
        f"{holes}, {least:g} to {most:g}",
        f"{ddg.training.steps:,} x {ddg.training.batch_size}",
        f"`{sampling.sampler}`, `{sampling.spacing}`, {sampling.steps}, {sampling.eta:g}",
        f"{sampling.frame_correlation:g}, {sampling.deviation_correlation:g}",
        f"{graft.noise_threshold:g}",
        f"{graft.deviation_threshold:g}",
        window,
    ]


def test_the_page_s_table_has_the_presets_settings_and_the_shipped_generator_s():
    page = (Path(__file__).parents[1] / "docs" / "generator.md").read_text()
    table = [line.split("|")[2:5] for line in page.splitlines() if line.startswith("| `ddg.")]
    laptop, shipped, camera = ([cell.strip() for cell in column] for column in zip(*table, strict=True))
    demo = shown_settings(get_preset("demo").ddg)
    assert laptop == [
        was if was == now else f"{was.split(' ')[0]} (`demo`), {now}"
        for was, now in zip(demo, shown_settings(get_preset("laptop").ddg), strict=True)
    ]
    assert shipped == shown_settings(Generator.load(PRETRAINED / "ddg").config)
    as_shown = [cell.removesuffix(" for 80 frames") for cell in camera]
    assert as_shown == shown_settings(get_preset("camera").ddg)


def test_flicker_is_counted_within_recordings_only():
    valid = np.array([0, 1, 1, 0, 0], bool)[:, None, None] * np.ones((1, 2, 2), bool)
    assert stage.flicker_fraction(valid, np.array([0, 0, 0, 1, 1])) == pytest.approx(1 / 3)
    assert np.isnan(stage.flicker_fraction(valid, np.arange(5)))


OTHERWISE = {
    "depth": {"near_m": 0.3, "far_m": 5.0, "surface": "planes", "representation": "depth"},
    "diffusion": {"steps": 90, "schedule": "linear", "log_snr_shift": -1.0},
    "unet": {"space_to_depth": 2, "widths": (8, 16), "blocks": (1, 1), "attention_heads": 2},
}


@pytest.mark.parametrize(("section", "name"), [(s, name) for s, names in OTHERWISE.items() for name in names])
def test_a_generator_with_other_numbers_than_its_start_is_refused(tmp_path, section, name):
    diffusion = dataclasses.replace(CONFIG.ddg.diffusion, steps=600)  # enough for a linear one too
    ddg = dataclasses.replace(CONFIG.ddg, diffusion=diffusion)
    artifacts.finish(tmp_path / "ddg", "ddg", dataclasses.replace(CONFIG, ddg=ddg), seconds=1.0, metrics={})
    own = dataclasses.replace(getattr(ddg, section), **{name: OTHERWISE[section][name]})
    graft = dataclasses.replace(ddg.graft, noise_threshold=-0.2)
    other = dataclasses.replace(ddg, init_from=str(tmp_path), graft=graft, **{section: own})
    with pytest.raises(UserError, match=rf"has ddg\.{section}\.{name} .*, this configuration"):
        start.check(other)
