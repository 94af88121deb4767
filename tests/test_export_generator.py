"""The generator's ONNX file computes what JAX computes, whatever its prior, sampler and representation."""

from dataclasses import replace
from typing import get_args

import cv2
import jax
import numpy as np
import pytest

from ddg_jax.prior import make_prior
from ddg_jax.sample import Generator, generate
from ddg_jax.train import init_params
from ddgrasp import artifacts, generator_metadata
from ddgrasp.artifacts import finish
from ddgrasp.config import (
    Config,
    DDGConfig,
    DDGDepthConfig,
    DDGTrainingConfig,
    GraftConfig,
    PriorConfig,
    Sampler,
    SamplingConfig,
    UNetConfig,
)
from ddgrasp.errors import UserError
from ddgrasp.onnx_runtime import ort
from export import generator as exported
from export import prior_graph
from export.builder import GraphBuilder, tensor
from export.generator_graph import build_model
from export.parity import open_session
from recording_support import flat, write_depth
from sensors.statistics import holes

SMALL = DDGConfig(
    depth=DDGDepthConfig(height_px=27, width_px=48),
    unet=UNetConfig(space_to_depth=2, widths=(8, 16), blocks=(1, 1), attention_heads=2),
    graft=GraftConfig(noise_threshold=0.1),
)
CAMERA = replace(
    SMALL,
    depth=replace(SMALL.depth, surface="piecewise"),
    prior=PriorConfig(source="metric_inverse_depth"),
    training=DDGTrainingConfig(hole_loss="cross_entropy"),
    sampling=SamplingConfig(sampler="ddim", steps=3, eta=1.0),
)
OPTIONS = {
    "the rig's: DPM-Solver, filtered, normalised": SMALL,
    "a camera's: DDIM with fresh noise, log odds, metric": CAMERA,
    "the paper's: depth itself, DDPM, no attention, no blur, a window": replace(
        SMALL,
        depth=replace(SMALL.depth, representation="depth"),
        graft=GraftConfig(noise_threshold=-0.2, window_px=1.25),
        prior=PriorConfig(blur_px=0.0),
        unet=replace(SMALL.unet, attention_heads=0),
        sampling=SamplingConfig(sampler="ddpm", steps=5, spacing="trailing"),
    ),
    "a network that knows where it is, large planes, a box": replace(
        SMALL,
        graft=replace(SMALL.graft, window_px=5, window_shape="box"),
        unet=replace(SMALL.unet, position=True),
        depth=replace(SMALL.depth, surface="planes"),
    ),
    "distilled": replace(SMALL, sampling=SamplingConfig(sampler="progressive", steps=2)),
}


def made(config: DDGConfig) -> Generator:
    """A generator whose parameters have no special values such as zero, which could hide a mistake."""
    rng = np.random.default_rng(0)
    params = jax.tree.map(
        lambda a: np.asarray(a + rng.normal(0, 0.05, a.shape), np.float32),
        init_params(config, jax.random.key(0)),
    )
    return Generator(config, params, make_prior(config))


def finished(generator: Generator, directory) -> None:
    """The generator as a stage's directory."""
    generator.save(directory)
    if generator.config.sampling.sampler == "progressive":
        (directory / "params.msgpack").rename(directory / "distilled_2.msgpack")
    finish(directory, "ddg", Config(preset="debug", ddg=generator.config), seconds=1, metrics={})


def test_every_sampler_is_compared():
    assert {config.sampling.sampler for config in OPTIONS.values()} == {*get_args(Sampler)}


@pytest.mark.parametrize("name", OPTIONS)
def test_the_file_draws_what_jax_draws(name, tmp_path):
    generator = made(OPTIONS[name])
    finished(generator, tmp_path)
    measured = exported.export_generator(tmp_path, tmp_path / "generator.onnx")
    assert measured.share <= exported.MOST_SHARE and measured.median_m < 1e-4
    session = open_session(tmp_path / "generator.onnx")
    info = generator_metadata.read(session.get_modelmeta().custom_metadata_map, "it")
    assert (info.height_px, info.width_px, info.steps) == (27, 48, generator.config.sampling.steps)
    assert info.knows_position == generator.config.unet.position
    inputs = {one.name for one in session.get_inputs()}
    assert inputs == {"depth", "noise"} | (set() if info.fixed_steps else {"steps"})


def test_any_size_of_that_shape_and_number_of_evaluations():
    generator, key = made(CAMERA), jax.random.key(4)
    metadata = generator_metadata.GeneratorMetadata(1, "", 27, 48, 2, "ddim", 3, 50, True, 0.8, 0.0, "m")
    session = open_session(build_model(generator.params, CAMERA, metadata).SerializeToString())
    depth_m = exported.scenes(np.random.default_rng(1), 2, (71, 126))
    noise = exported.jax_noise(CAMERA, key, 2, 5)
    assert noise.shape == (2, metadata.planes(5), 27, 48)
    reported, predicted, mask = exported.run(session, depth_m, noise, 5)
    wanted = generate(key, generator, depth_m, episode=np.arange(2), steps=5)
    assert np.mean(mask != wanted.mask) < 1e-3 and 0.02 < mask.mean() < 0.98
    drawn = (predicted > 0) & (wanted.predicted_m > 0)
    np.testing.assert_allclose(predicted[drawn], wanted.predicted_m[drawn], atol=1e-3)
    np.testing.assert_array_equal(reported[~mask], depth_m[~mask])


# --- filters ---------------------------------------------------------------------------------------


def filtered(write, picture: np.ndarray) -> np.ndarray:
    """What nodes make of (H, W)."""
    g = GraphBuilder()
    g.output("out", write(g, "picture"))
    shape = [1, 1, *picture.shape]
    model = g.model([tensor("picture", shape)], [tensor("out", shape)], {})
    session = ort.InferenceSession(model.SerializeToString(), providers=["CPUExecutionProvider"])
    return np.asarray(session.run(None, {"picture": picture[None, None]})[0])[0, 0]


def test_filters_are_opencvs():
    size = (31, 44)
    rng = np.random.default_rng(0)
    steps = np.where(np.arange(size[1]) < 20, 0.8, 1.3)
    picture = (steps + rng.normal(0, 0.01, size)).astype(np.float32)
    picture[5:8, 30:33] = 0
    median = filtered(lambda g, x: prior_graph.write_median(g, x, size), picture)
    np.testing.assert_array_equal(median, cv2.medianBlur(picture, holes.MEDIAN_PX))
    smooth = filtered(
        lambda g, x: prior_graph.write_bilateral(g, prior_graph.write_median(g, x, size), size), picture
    )
    np.testing.assert_allclose(smooth, holes.smooth_surface(picture), atol=3e-6)
    for sigma in (0.8, 1.0, 1.25):
        blurred = filtered(lambda g, x, sigma=sigma: prior_graph.write_blur(g, x, sigma), picture)
        np.testing.assert_allclose(blurred, cv2.GaussianBlur(picture, (0, 0), sigma), atol=1e-6)


@pytest.mark.parametrize("n", [3, 5, 7])
def test_the_median_of_any_window(n):
    """Numbers without ties, in every order that a window slides through."""
    picture = np.random.default_rng(n).permutation(20 * 23).reshape(20, 23).astype(np.float32)
    window = np.lib.stride_tricks.sliding_window_view(np.pad(picture, n // 2, mode="edge"), (n, n))
    before, holes.MEDIAN_PX = holes.MEDIAN_PX, n
    try:
        found = filtered(lambda g, x: prior_graph.write_median(g, x, (20, 23)), picture)
    finally:
        holes.MEDIAN_PX = before
    np.testing.assert_array_equal(found, np.median(window, axis=(-2, -1)))


# --- what is refused -------------------------------------------------------------------------------


def test_a_prior_by_colour_is_refused():
    by_colour = replace(SMALL, prior=PriorConfig(source="depth_anything_v2", in_sim="rgb"))
    with pytest.raises(UserError, match="on rgb, which the ONNX file cannot hold"):
        prior_graph.check_prior(by_colour)


@pytest.mark.parametrize("name", ["prior.blur_px", "graft.window_px"])
def test_a_gaussian_that_reaches_across_the_map_is_refused(name, tmp_path):
    """27 rows: 6.5 px reach 26 beyond the border, all that one reflection has."""
    section, field = name.split(".")
    wide, held = (
        replace(SMALL, **{section: replace(getattr(SMALL, section), **{field: sigma_px})})
        for sigma_px in (7.0, 6.5)
    )
    prior_graph.check_prior(held)
    finished(made(wide), tmp_path)
    with pytest.raises(UserError, match=f"ddg.{name} is 7: .* 27 pixels: .* 6.5 or less"):
        exported.export_generator(tmp_path, tmp_path / "generator.onnx")


def test_a_box_that_reaches_across_the_map_is_refused():
    depth = replace(SMALL.depth, height_px=8)
    held, wide = (GraftConfig(window_px=px, window_shape="box") for px in (15, 17))
    prior_graph.check_prior(replace(SMALL, depth=depth, graft=held, prior=PriorConfig(blur_px=1.0)))
    with pytest.raises(UserError, match="ddg.graft.window_px is 17: .* 8 pixels: .* less than 16"):
        prior_graph.check_prior(replace(SMALL, depth=depth, graft=wide, prior=PriorConfig(blur_px=1.0)))


@pytest.mark.parametrize("width_px", [3, 5, 15])
def test_a_box_is_opencvs(width_px):
    picture = np.random.default_rng(0).random((27, 48)).astype(np.float32)
    averaged = filtered(lambda g, x: prior_graph.write_box(g, x, width_px), picture)
    np.testing.assert_allclose(averaged, cv2.blur(picture, (width_px, width_px)), atol=1e-6)


def test_the_widest_gaussian_that_is_held_is_opencvs():
    picture = np.random.default_rng(0).random((27, 48)).astype(np.float32)
    blurred = filtered(lambda g, x: prior_graph.write_blur(g, x, 6.5), picture)
    np.testing.assert_allclose(blurred, cv2.GaussianBlur(picture, (0, 0), 6.5), atol=1e-5)


def test_a_file_that_differs_is_not_written(tmp_path, monkeypatch):
    finished(made(CAMERA), tmp_path)
    monkeypatch.setattr(exported, "MOST_SHARE", -1.0)
    with pytest.raises(UserError, match="differs from JAX.*nothing was written"):
        exported.export_generator(tmp_path, tmp_path / "generator.onnx")
    assert not (tmp_path / "generator.onnx").exists()


def test_more_evaluations_than_a_file_holds_are_refused(tmp_path):
    finished(made(CAMERA), tmp_path)
    with pytest.raises(
        UserError, match="takes 51 evaluations; a file holds tables for up to 50: give --steps"
    ):
        exported.export_generator(tmp_path, tmp_path / "generator.onnx", steps=51)


@pytest.mark.parametrize(("origin", "licence"), [("trained", "Apache-2.0"), ("loaded", "")])
def test_a_generator_from_elsewhere_is_not_the_rig_s(tmp_path, origin, licence):
    config = Config("test", ddg=CAMERA)
    record = artifacts.finish(tmp_path / "record", "record", config, seconds=1.0, metrics={})
    fitted = artifacts.finish(
        tmp_path / "ddg", "ddg", config, seconds=1.0, metrics={}, parents=[record], origin=origin
    )
    described = exported.describe(fitted, CAMERA)
    assert described.licence == licence and bool(described.camera) == (origin == "trained")


def test_a_generator_from_elsewhere_that_is_distilled_here_is_not_the_rig_s(tmp_path):
    ddg = replace(SMALL, init_from="pretrained/ddg", sampling=SamplingConfig(sampler="progressive"))
    config = Config("test", ddg=ddg)
    record = artifacts.finish(tmp_path / "record", "record", config, seconds=1.0, metrics={})
    made_here = {"seconds": 1.0, "metrics": {}, "parents": [record], "origin": "trained"}
    described = exported.describe(artifacts.finish(tmp_path / "ddg", "ddg", config, **made_here), ddg)
    assert (described.camera, described.licence, described.source) == ({}, "", "")


@pytest.mark.parametrize(
    ("sizes", "fx_px", "window"),
    [
        ([(48, 64)], [40.0], (48, 64, 40.0)),
        ([(48, 96)], [40.0], (48, 64, 40.0)),  # the generator is 4:3, and sees the middle
        ([(96, 64)], [40.0], (48, 64, 40.0)),
        ([(48, 64), (48, 64)], [40.0, 41.0], (48, 64, None)),
        ([(48, 96), (48, 64)], [40.0, 40.0], (48, 64, 40.0)),
    ],
)
def test_optics_in_the_file_are_those_of_what_the_generator_sees(tmp_path, sizes, fx_px, window):
    finished(made(CAMERA), tmp_path / "ddg")
    config = replace(CAMERA, depth=replace(CAMERA.depth, height_px=24, width_px=32))
    for number, (size, fx) in enumerate(zip(sizes, fx_px, strict=True)):
        depth_mm, rows, columns = flat(size, 9000), (size[0] - 48) // 2, (size[1] - 64) // 2
        depth_mm[rows : rows + 48, columns : columns + 64] = 1000
        write_depth(tmp_path / "all" / str(number), [depth_mm], fx_px=fx)
    camera = exported.describe(artifacts.read_artifact(tmp_path / "ddg"), config, tmp_path / "all").camera
    assert (camera["height_px"], camera["width_px"], camera["fx_px"]) == window
    assert camera["near_m"] == camera["far_m"] == 1.0


def test_recordings_that_a_fit_leaves_out_do_not_keep_a_generator_from_its_file(tmp_path):
    finished(made(CAMERA), tmp_path / "ddg")
    artifact, room = artifacts.read_artifact(tmp_path / "ddg"), tmp_path / "room"
    for name in ("good", "torn"):
        write_depth(room / name, [flat((36, 64), 1000)], sensor=name)
    next((room / "torn" / "depth").iterdir()).write_bytes(b"no picture")
    camera = exported.describe(artifact, CAMERA, room).camera
    assert (camera["name"], camera["near_m"]) == ("good", 1.0)
    for nothing, said in (("torn", "none of its 1 frames is readable"), ("none", "no such folder")):
        with pytest.raises(UserError, match=said):
            exported.describe(artifact, CAMERA, room / nothing)


def test_the_file_names_the_recordings_camera(tmp_path):
    generator = made(CAMERA)
    finished(generator, tmp_path / "ddg")
    depth_mm = np.linspace(700, 1500, 48 * 64).reshape(48, 64).astype(np.uint16)
    room = write_depth(tmp_path / "room", [depth_mm], sensor="D435", fx_px=40.0, licence="MIT")
    artifact = artifacts.read_artifact(tmp_path / "ddg")
    described = exported.describe(artifact, CAMERA, room)
    assert (described.licence, described.manifest_hash) == ("MIT", artifact.hash)
    camera = described.camera
    assert (camera["name"], camera["width_px"], camera["height_px"], camera["fx_px"]) == (
        "D435",
        64,
        36,  # of 48: the generator is 16:9
        40.0,
    )
    assert 0.8 <= camera["near_m"] < 0.85 and 1.25 < camera["far_m"] <= 1.4
    assert exported.describe(artifact, CAMERA, room, "CC0").licence == "CC0"
    assert exported.describe(artifact, CAMERA).camera == {}  # not a run's own recordings
    assert described.planes(3) == 1 + 2 * 3 and described.stochastic


def test_the_file_says_how_its_noise_hangs_together_over_time(tmp_path):
    finished(made(CAMERA), tmp_path)
    sampling = replace(CAMERA.sampling, frame_correlation=0.9, deviation_correlation=0.2)
    info = exported.describe(artifacts.read_artifact(tmp_path), replace(CAMERA, sampling=sampling))
    assert (info.frame_correlation, info.deviation_correlation) == (0.9, 0.2)
