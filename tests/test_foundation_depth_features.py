"""The frozen depth features, and the command that trains such an extractor, at a size that takes seconds."""

import shutil
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ddgrasp.config import DepthFeatureConfig
from ddgrasp.depth import to_metres
from ddgrasp.errors import UserError
from ddgrasp.progress import Progress
from foundation import depth_feature_data as data
from foundation import depth_feature_training as training
from foundation import depth_features
from learning.params import save_params

TINY = DepthFeatureConfig(devices=2, pictures=2, width_px=64, steps=4, batch_size=2, checkpoint_every=2)


@pytest.fixture(scope="module")
def frozen():
    return depth_features.load()


@pytest.fixture(scope="module")
def pool(tmp_path_factory):
    return training.load_pools(TINY, tmp_path_factory.mktemp("pool"), Progress(quiet=True))[0]


def scene() -> np.ndarray:
    """(1, 180, 320): a slope with a box on it."""
    depth = np.broadcast_to(np.linspace(1.4, 0.6, 180)[:, None], (180, 320)).astype(np.float32).copy()
    depth[70:120, 130:190] = 0.7
    return depth[None]


def test_the_frozen_extractor_is_the_one_its_manifest_names(frozen, tmp_path):
    assert frozen.name == "depthfeat-v1"
    assert frozen.source["sha256"] == depth_features.read_manifest()["sha256"]
    shutil.copytree(depth_features.DIRECTORY, tmp_path / "copy")
    other = jax.tree.map(lambda leaf: leaf + 1, frozen.params)
    save_params(tmp_path / "copy" / depth_features.PARAMS_FILE, other)
    with pytest.raises(UserError, match="SHA-256"):
        depth_features.load(tmp_path / "copy")
    with pytest.raises(UserError, match="ddgrasp ddg features"):
        depth_features.load(tmp_path / "absent")


def test_features_see_geometry_holes_and_noise_on_surfaces(frozen):
    clean = scene()
    rng = np.random.default_rng(0)
    moved = np.roll(clean, 60, axis=2)
    holes = np.where(rng.random(clean.shape) < 0.02, 0, clean)
    noisy = (1 / (1 / clean + rng.normal(0, 0.003, clean.shape))).astype(np.float32)  # a tenth of a pixel
    base = frozen(clean)
    change = {n: float(np.abs(frozen(d) - base).mean()) for n, d in
              {"moved": moved, "holes": holes, "noisy": noisy}.items()}  # fmt: skip
    assert base.shape == (1, depth_features.FEATURES) and np.isfinite(base).all()
    assert min(change.values()) > 0.02, change
    assert frozen(clean + np.float32(1e-5)) == pytest.approx(base, abs=0.02)


def test_features_do_not_depend_on_the_batch(frozen):
    rng = np.random.default_rng(1)
    maps = (scene() * rng.uniform(0.8, 1.2, (18, 1, 1))).astype(np.float32)
    np.testing.assert_allclose(frozen(maps)[[0, 17]], frozen(maps[[0, 17]]), atol=2e-3)


def test_pictures_show_validity_and_local_deviation():
    depth = np.full((1, 5, 5), 1.0, np.float32)
    depth[0, 2, 2] = 0
    depth[0, 0, 0] = 0.5
    seen = np.asarray(depth_features.picture(jnp.asarray(depth)))[0]
    assert seen[2, 2].tolist() == [0, 0, 0] and seen[4, 4, 1] == 1
    assert seen[4, 4, 0] == pytest.approx((1 - 0.1) / (5 - 0.1))
    # 1/d = 2 among three neighbours of 1: mean 1.25, deviation 0.75 1/m
    assert seen[0, 0, 2] == pytest.approx(np.tanh(0.75 / depth_features.RESIDUAL_SCALE))


def test_maps_of_another_size_are_brought_to_the_networks_width_without_new_depths():
    maps = np.random.default_rng(0).choice(np.array([0, 0.5, 2], np.float32), (2, 48, 64))
    sized = depth_features.at_width(maps, 320)
    assert sized.shape == (2, 240, 320) and set(np.unique(sized)) == {0, 0.5, 2}
    np.testing.assert_array_equal(sized[:, 2::5, 2::5], maps)


def test_treatments_do_what_they_say(pool):
    rng = np.random.default_rng(0)
    clean, stereo = to_metres(pool.clean_mm[0]), to_metres(pool.stereo_mm[0])
    made = {name: treat(pool, 0, rng) for name, treat in data.TREATMENTS.items()}
    np.testing.assert_allclose(made["clean"], clean)
    np.testing.assert_allclose(made["stereo"], stereo)
    np.testing.assert_allclose(made["holes_alone"], np.where(stereo > 0, clean, 0))
    assert ((made["filled"] == 0) == ((stereo == 0) & (clean == 0))).all()
    measured = dict(zip(data.MEASURED, data.measure(pool, 0, made["holes_alone"]), strict=True))
    assert measured["invalid"] == pytest.approx(np.sqrt((made["holes_alone"] == 0).mean()))
    assert measured["noise"] == pytest.approx(-4)
    assert measured["objects"] == pool.objects[0]


def test_training_freezes_an_extractor_that_loads(tmp_path):
    manifest = training.train(TINY, tmp_path / "made", quiet=True)
    assert not (tmp_path / "made" / training.WORK).exists()
    assert 0 <= manifest["tested_on_new_cameras"]["treatment_accuracy"] <= 1
    extractor = depth_features.load(tmp_path / "made")
    assert extractor.name == manifest["name"] == f"depthfeat-{manifest['sha256'][:8]}"
    assert extractor(scene()).shape == (1, depth_features.FEATURES)
    with pytest.raises(UserError, match="finished extractor"):
        training.train(TINY, tmp_path / "made", quiet=True)


def test_training_begun_with_other_settings_is_refused(tmp_path):
    training._check_begun(TINY, tmp_path / training.WORK)
    training._check_begun(TINY, tmp_path / training.WORK)
    with pytest.raises(UserError, match="begun with other settings: use those, another --out, or delete it"):
        training.train(replace(TINY, width_px=48), tmp_path, quiet=True)


class Interrupting(Progress):
    """Ctrl-C after a number of units."""

    def __init__(self, after: int):
        super().__init__(quiet=True)
        self.left = after

    def _tick(self) -> None:
        self.left -= 1
        if self.left < 0:
            raise KeyboardInterrupt


def test_resumed_training_equals_an_uninterrupted_one(pool, tmp_path):
    scale = training._target_scale(pool, 0)
    whole = training._optimise(TINY, pool, scale, tmp_path / "whole", Progress(quiet=True))
    with pytest.raises(KeyboardInterrupt):
        training._optimise(TINY, pool, scale, tmp_path / "halves", Interrupting(4))
    assert any((tmp_path / "halves" / training.CHECKPOINTS).iterdir())
    again = training._optimise(TINY, pool, scale, tmp_path / "halves", Progress(quiet=True))
    jax.tree.map(np.testing.assert_array_equal, whole, again)
