"""The stage from recordings on disk to a generator that loads again, at a size that takes seconds."""

import dataclasses

import cv2
import jax
import numpy as np
import pytest

from ddg_jax import stage
from ddg_jax.sample import Generator, generate
from ddgrasp import artifacts
from ddgrasp.config import Config, DDGConfig
from ddgrasp.errors import UserError
from ddgrasp.progress import Progress, read_curves
from sensors.recordings import RecordingWriter

CONFIG = Config(
    preset="test",
    ddg=DDGConfig(
        height_px=16,
        width_px=24,
        widths=(8, 8),
        blocks=(0, 1),
        attention_heads=1,
        diffusion_steps=50,
        train_steps=10,
        batch_size=4,
        sample_steps=2,
        sample_batch=4,
        holdout_fraction=0.25,
    ),
)


@pytest.fixture(scope="module")
def recordings(tmp_path_factory):
    root = tmp_path_factory.mktemp("recordings")
    for name in ("a", "b"):
        with RecordingWriter(root / name, {}) as writer:
            for t in range(4):
                depth = np.full((32, 48), 900, np.uint16)
                depth[8:20, 20 + t : 30 + t] = 600
                depth[8:20, 16 + t : 20 + t] = 0
                writer.add(np.zeros((32, 48, 3), np.uint8), depth)
    return root


@pytest.fixture(scope="module")
def fitted(recordings, tmp_path_factory):
    directory = tmp_path_factory.mktemp("run") / "ddg"
    progress = Progress(directory, "ddg", quiet=True)
    artifact = stage.fit_folder(CONFIG, recordings, directory, progress=progress)
    progress.close()
    return artifact


def test_manifest_says_what_was_made(fitted):
    metrics = fitted.manifest.metrics
    assert fitted.manifest.origin == "trained" and metrics["prior"] == "inverse_depth"
    assert metrics["frames"] == {"training": 6, "held_out": 2, "skipped": 0}
    # a quarter of the pixels: rows 4 to 9 and columns 8 to 9 (or 9 to 10) of 16 x 24
    assert metrics["recorded"]["invalid_fraction"] == pytest.approx(12 / 384, abs=1e-6)
    assert metrics["grafted_error_m"] == 0.0
    assert [step for step, _ in read_curves(fitted.directory)["loss"]] == [10]
    picture = cv2.imread(str(fitted.directory / "samples.png"))
    assert picture.shape == (4 * 16, 2 * 24, 3)


def test_generator_loads_and_generates_at_another_size(fitted):
    generator = Generator.load(fitted.directory)
    depth = np.full((3, 32, 48), 0.9, np.float32)
    made = generate(jax.random.key(0), generator, depth)
    assert made.depth_m.shape == depth.shape
    valid = made.depth_m > 0
    assert np.array_equal(made.depth_m[valid], depth[valid])


def test_sample_folder_draws_a_picture(fitted, recordings, tmp_path):
    path = stage.sample_folder(fitted.directory, recordings, tmp_path, seed=0, count=3)
    assert cv2.imread(str(path)).shape == (4 * 16, 3 * 24, 3)


def test_starting_from_a_fitted_generator(fitted, recordings, tmp_path):
    config = dataclasses.replace(
        CONFIG, ddg=dataclasses.replace(CONFIG.ddg, init_from=str(fitted.directory), sample_steps=3)
    )
    loaded = stage.fit_folder(
        config, recordings, tmp_path / "ddg", progress=Progress(tmp_path / "ddg", quiet=True)
    )
    assert loaded.manifest.origin == "loaded"
    before, after = (artifacts.load_params(a.directory / "params.msgpack") for a in (fitted, loaded))
    jax.tree.map(np.testing.assert_array_equal, before, after)
    other = dataclasses.replace(config, ddg=dataclasses.replace(config.ddg, far_m=5.0))
    with pytest.raises(UserError, match="ddg.far_m 10.0.*5.0"):
        stage.fit_folder(other, recordings, tmp_path / "other", progress=Progress(quiet=True))
