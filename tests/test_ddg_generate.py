"""The batch job over a demo store: equal to episode by episode, after a kill, and on eight devices."""

import dataclasses
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import jax
import numpy as np
import pytest

from app import cli
from app.commands import parse
from ddg_jax import generate, sample, train
from ddg_jax.prior import make_prior
from ddgrasp import artifacts, contract
from ddgrasp.config import (
    Config,
    DDGConfig,
    DDGDepthConfig,
    DDGDiffusionConfig,
    DemosConfig,
    GraftConfig,
    SamplingConfig,
    UNetConfig,
    WorldConfig,
)
from ddgrasp.errors import UserError
from demos.store import EpisodeStore
from learning.params import save_params

ROOT = Path(__file__).parents[1]
CONFIG = Config(
    preset="test",
    ddg=DDGConfig(
        depth=DDGDepthConfig(height_px=16, width_px=24),
        unet=UNetConfig(widths=(8, 8), blocks=(0, 1), attention_heads=1),
        diffusion=DDGDiffusionConfig(steps=50),
        sampling=SamplingConfig(steps=2, batch_size=4),
        graft=GraftConfig(noise_threshold=-0.02),
    ),
)
DEMOS_CONFIG = Config(preset="test", world=WorldConfig(objects=("cube",)), demos=DemosConfig(episodes=32))
LENGTHS = 4 * (5, 3, 9, 1, 7, 6, 2, 8)
"""Frames per episode: none fills the batch of four."""


def made_up_params(config: DDGConfig):
    """Parameters whose output is noise around the threshold, so that holes depend on every input."""
    params = train.init_params(config, jax.random.key(0))
    leaves, tree = jax.tree.flatten(params)
    keys = jax.random.split(jax.random.key(1), len(leaves))
    noisy = [leaf + 0.1 * jax.random.normal(key, leaf.shape) for leaf, key in zip(leaves, keys, strict=True)]
    return jax.tree.unflatten(tree, noisy)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run directory with a generator and demos, finished."""
    directory = tmp_path_factory.mktemp("run")
    save_params(directory / "ddg" / sample.PARAMS_FILE, made_up_params(CONFIG.ddg))
    artifacts.finish(directory / "ddg", "ddg", CONFIG, seconds=1, metrics={})
    rng = np.random.default_rng(0)
    store = EpisodeStore(directory / "demos" / "episodes.zarr", create=True)
    for length in LENGTHS:
        depth = rng.integers(700, 1500, (length, 32, 48)).astype(np.uint16)
        store.append({"depth_mm": depth}, {"object": np.int64(0)})
    artifacts.finish(directory / "demos", "demos", DEMOS_CONFIG, seconds=1, metrics={})
    return directory


def test_a_generator_of_another_shape_is_refused_before_anything_is_made(run, tmp_path):
    depth = DDGDepthConfig(height_px=24, width_px=24)
    square = dataclasses.replace(CONFIG, ddg=dataclasses.replace(CONFIG.ddg, depth=depth))
    save_params(tmp_path / "ddg" / sample.PARAMS_FILE, made_up_params(square.ddg))
    artifacts.finish(tmp_path / "ddg", "ddg", square, seconds=1, metrics={})
    words = ["--out", str(tmp_path / "out"), "--model", str(tmp_path), "--demos", str(run)]
    with pytest.raises(
        UserError, match=r"depth is 48x32, the generator's 24x24: .* --ddg.depth.height-px 16"
    ):
        parse("ddg generate", words).run()
    assert not (tmp_path / "out").exists()


def clean_episodes(run) -> list[np.ndarray]:
    store = EpisodeStore(run / "demos" / "episodes.zarr")
    return np.split(store.steps("depth_mm"), store.ends[:-1])


def noisy_store(directory: Path) -> EpisodeStore:
    return EpisodeStore(directory / "noisy" / generate.STORE)


def command(run: Path, out: Path, *extra: str) -> list[str]:
    told = ["ddg", "generate", "--out", str(out), "--seed", "3"]
    return [*told, "--model", str(run / "ddg"), "--demos", str(run / "demos"), *extra]


def job(run: Path, out: Path, *extra: str, devices: int = 1) -> subprocess.Popen:
    return subprocess.Popen(
        [sys.executable, "-m", "app.cli", *command(run, out, *extra)],
        cwd=ROOT,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "JAX_NUM_CPU_DEVICES": str(devices), "JAX_PLATFORMS": "cpu"},
    )


def finish(process: subprocess.Popen) -> str:
    output, errors = process.communicate(timeout=300)
    assert process.returncode == 0, errors
    return output


@pytest.fixture(scope="module")
def straight(run, tmp_path_factory):
    """(directory of an uninterrupted job, what it printed)."""
    out = tmp_path_factory.mktemp("straight")
    return out, finish(job(run, out))


def test_the_stream_equals_one_episode_at_a_time(run, straight):
    out, printed = straight
    store, generator = noisy_store(out), sample.Generator.load(run / "ddg")
    assert np.diff(store.ends, prepend=0).tolist() == list(LENGTHS)
    made = np.split(store.steps("depth_mm"), store.ends[:-1])
    differing = 0
    for number, (noisy, clean) in enumerate(zip(made, clean_episodes(run), strict=True)):
        alone = sample.generate(
            jax.random.key(3), generator, clean.astype(np.float32) * np.float32(0.001), episode=number
        )
        differing += np.sum(np.round(alone.depth_m * 1000).astype(np.uint16) != noisy)
        assert np.array_equal(noisy[~alone.mask], clean[~alone.mask])
        assert (noisy > 0).any() and alone.mask.any()
    everything = store.steps("depth_mm")
    assert 0.1 < np.mean(everything == 0) < 0.9
    assert differing < 1e-3 * everything.size
    manifest = artifacts.read_manifest(out / "noisy")
    assert artifacts.config_from_json(manifest.config) == dataclasses.replace(
        DEMOS_CONFIG, ddg=CONFIG.ddg, seed=3
    )
    metrics = manifest.metrics
    assert (metrics["episodes"], metrics["frames"]) == (32, 164)
    assert metrics["invalid_fraction"] == pytest.approx(np.mean(everything == 0))
    assert printed.startswith("32 episodes, 164 frames, ")


def test_a_killed_job_resumes_to_the_same_bits(run, straight, tmp_path):
    process = job(run, tmp_path)
    deadline = time.monotonic() + 300
    while process.poll() is None and not _episodes(tmp_path):
        assert time.monotonic() < deadline
        time.sleep(0.01)
    process.send_signal(signal.SIGKILL)
    process.communicate()
    assert 0 < _episodes(tmp_path) < len(LENGTHS)
    finish(job(run, tmp_path, "--resume"))
    np.testing.assert_array_equal(noisy_store(tmp_path).ends, noisy_store(straight[0]).ends)
    np.testing.assert_array_equal(
        noisy_store(tmp_path).steps("depth_mm"), noisy_store(straight[0]).steps("depth_mm")
    )


def _episodes(out: Path) -> int:
    path = out / "noisy" / generate.STORE
    return len(EpisodeStore(path)) if (path / "meta" / "zarr.json").exists() else 0


def test_resuming_anywhere_computes_the_same_batches(run, straight):
    generator, clean = sample.Generator.load(run / "ddg"), clean_episodes(run)
    opened = []

    def read(i: int) -> generate.Clip:
        opened.append(i)
        return generate.Clip(i, clean[i])

    store = noisy_store(straight[0])
    expected = np.split(store.steps("depth_mm"), store.ends[:-1])
    for first in range(0, len(LENGTHS), 3):
        opened.clear()
        made = list(generate.noisy_episodes(jax.random.key(3), generator, LENGTHS, read, first))
        assert len(made) == len(LENGTHS) - first
        for got, wanted in zip(made, expected[first:], strict=True):
            np.testing.assert_array_equal(got, wanted)
        # only the episodes that share a batch with the first one are computed again
        assert min(opened) >= max(0, first - generator.config.sampling.batch_size)


def test_only_the_episodes_of_one_batch_are_open(run):
    generator, clean = sample.Generator.load(run / "ddg"), clean_episodes(run)
    opened = 0

    def read(i: int) -> generate.Clip:
        nonlocal opened
        opened += 1
        return generate.Clip(i, clean[i])

    stream = generate.noisy_episodes(jax.random.key(3), generator, LENGTHS, read)
    for done in range(len(LENGTHS)):
        next(stream)
        assert opened - done <= 1 + generator.config.sampling.batch_size


def test_eight_devices_make_what_one_makes(run, straight, tmp_path):
    finish(job(run, tmp_path, devices=8))
    one, eight = (noisy_store(d).steps("depth_mm") for d in (straight[0], tmp_path))
    assert np.mean(one != eight) < 1e-3
    code = f"""
import numpy as np, jax
from ddg_jax import sample
assert jax.local_device_count() == 8
generator = sample.Generator.load({str(run / "ddg")!r})
assert sample.batch_size(generator.config) == 32
c = np.random.default_rng(0).normal(size=(37, 16, 24)).astype(np.float32)
x = sample.predict(jax.random.key(0), generator, c, episode=np.arange(37) // 4)
np.save({str(tmp_path / "x.npy")!r}, x)
"""
    environment = {**os.environ, "JAX_NUM_CPU_DEVICES": "8"}
    subprocess.run([sys.executable, "-c", code], cwd=ROOT, env=environment, check=True)
    c = np.random.default_rng(0).normal(size=(37, 16, 24)).astype(np.float32)
    x = sample.predict(jax.random.key(0), sample.Generator.load(run / "ddg"), c, episode=np.arange(37) // 4)
    np.testing.assert_allclose(np.load(tmp_path / "x.npy"), x, atol=2e-4)


class Colours:
    """A prior that needs colour in simulation: c is its red."""

    name, needs_rgb, needs_sim_rgb, source = "colours", True, True, "test"

    def from_recording(self, depth_m, rgb, rng, consecutive=True):
        raise AssertionError("not a recording")

    def from_sim(self, depth_m, rgb):
        return rgb[..., 0].astype(np.float32) / 255


def test_the_stream_hands_colour_to_a_prior_that_needs_it(run):
    generator = sample.Generator(CONFIG.ddg, made_up_params(CONFIG.ddg), Colours())
    rng = np.random.default_rng(1)
    depth = rng.integers(700, 1500, (2, 5, 16, 24)).astype(np.uint16)
    rgb = rng.integers(0, 256, (2, 5, 16, 24, 3)).astype(np.uint8)
    key, lengths = jax.random.key(0), (5, 5)

    def holes(colour):
        clips = [generate.Clip(i, depth[i], colour[i]) for i in range(2)]
        return np.concatenate(list(generate.noisy_episodes(key, generator, lengths, clips.__getitem__))) == 0

    assert np.mean(holes(rgb) != holes(255 - rgb)) > 0.01
    np.testing.assert_array_equal(holes(rgb), holes(rgb))


def test_wrong_input_is_refused(run, tmp_path, straight, capsys):
    config = dataclasses.replace(
        CONFIG, ddg=dataclasses.replace(CONFIG.ddg, prior=dataclasses.replace(CONFIG.ddg.prior, in_sim="rgb"))
    )
    assert make_prior(config.ddg).needs_sim_rgb is False  # the built-in prior needs none
    with pytest.raises(UserError, match="holds no finished artifact"):
        artifacts.read_artifact(tmp_path)
    old = tmp_path / "demos"
    artifacts.finish(old, "demos", CONFIG, seconds=1, metrics={})
    text = (old / artifacts.MANIFEST).read_text()
    changed = text.replace(f'"contract_version": {contract.CONTRACT_VERSION}', '"contract_version": 99')
    (old / artifacts.MANIFEST).write_text(changed)
    assert cli.main(command(run, tmp_path / "out", "--demos", str(old))) == 2
    errors = capsys.readouterr().err
    assert "contract version 99" in errors and errors.count("\n") == 1
    assert cli.main(command(run, straight[0])) == 2
    assert "continue with --resume" in capsys.readouterr().err
