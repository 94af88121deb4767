"""The frozen depth features, and the command that trains such an extractor, at a size that takes seconds."""

import shutil
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ddgrasp.alone import alone_in
from ddgrasp.config import DepthFeatureConfig
from ddgrasp.contract import D455
from ddgrasp.depth import to_metres
from ddgrasp.errors import UserError
from ddgrasp.progress import Progress, Task
from foundation import depth_feature_data as data
from foundation import depth_feature_training as training
from foundation import depth_features
from foundation.depth_feature_noise import ProceduralConfig, corrupt
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


def test_features_are_float32_where_products_are_by_default_in_tf32():
    shapes = jax.eval_shape(depth_features.empty_params), jax.ShapeDtypeStruct((1, 32, 32), jnp.float32)
    text = depth_features.standardised.trace(*shapes).lower(lowering_platforms=("cuda",)).as_text()
    products = [line for line in text.splitlines() if "stablehlo.convolution" in line]
    assert len(products) == 7 and all("HIGHEST" in line and "DEFAULT" not in line for line in products)


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
    other = int(np.random.default_rng(5).integers(len(pool)))
    assert other != 0 and ((pool.stereo_mm[other] > 0) != (stereo > 0)).any()
    foreign = data.TREATMENTS["foreign_holes"](pool, 0, np.random.default_rng(5))
    np.testing.assert_allclose(foreign, np.where(pool.stereo_mm[other] > 0, clean, 0))


def test_independent_noise_grows_with_the_square_of_depth():
    clean = np.full((180, 320), 500, np.uint16)
    clean[:, 160:] = 2000
    clean[:4] = 0
    made = data.TREATMENTS["independent"](hand_made(clean, clean), 0, np.random.default_rng(1))
    assert (made[:4] == 0).all()
    near, far = made[4:, :160], made[4:, 160:]
    deviation = [np.std(part[part > 0]) for part in (near, far)]
    assert deviation[1] == pytest.approx(16 * deviation[0], rel=0.03) and 4e-4 < deviation[1] < 0.04
    assert 0.003 < np.mean(near == 0) == pytest.approx(np.mean(far == 0), rel=0.1)


def test_a_smoothed_picture_has_its_large_holes_and_no_new_depth_beside_them():
    stereo = np.full((90, 160), 1000, np.uint16)
    stereo[40, 100] = 0
    stereo[20:70, 20:70] = 0
    made = data.TREATMENTS["smoothed"](hand_made(stereo, stereo), 0, np.random.default_rng(0))
    np.testing.assert_allclose(made[made > 0], 1, rtol=1e-5)
    assert made[40, 100] > 0 and (made[30:60, 30:60] == 0).all()
    step = np.where(np.arange(160) < 80, 1000, 2000).astype(np.uint16) * np.ones((90, 1), np.uint16)
    made = data.TREATMENTS["smoothed"](hand_made(step, step), 0, np.random.default_rng(0))
    np.testing.assert_allclose(made[45, [10, 150]], [1, 2], rtol=1e-5)
    assert 1.1 < made[45, 79] < 1.5 < made[45, 80] < 1.9


def hand_made(clean_mm: np.ndarray, stereo_mm: np.ndarray) -> data.Pool:
    """One picture."""
    return data.Pool(clean_mm[None], stereo_mm[None], np.array([1]), np.array([1.0]), np.array([0.5]))


QUIET = ProceduralConfig(shift_px=0, disparity_px=0, dropout=0, random_value=0, sticks=0)


@pytest.mark.parametrize(
    ("changed", "low", "high", "share"),
    [
        ({}, 1.0, 1.0, 0.0),
        ({"dropout": 1.0}, 0.0, 0.0, 1.0),
        ({"random_value": 1.0}, 0.3, 2.0, 1.0),
        ({"random_value": 1.0, "random_range_m": (0.5, 0.6)}, 0.5, 0.6, 1.0),
        ({"dropout": 0.25}, 0.0, 1.0, 0.25),
        ({"sticks": 9, "random_range_m": (0.4, 0.5)}, 0.4, 1.0, 0.05),
    ],
)
def test_every_strength_of_procedural_noise_does_its_own(changed, low, high, share):
    wall = np.ones((45, 80), np.float32)
    made = corrupt(wall, np.random.default_rng(0), D455.scaled(1 / 16), replace(QUIET, **changed))
    assert made.dtype == np.float32 and made.min() >= low - 1e-6 and made.max() <= high + 1e-6
    assert np.mean(np.abs(made - wall) > 1e-5) == pytest.approx(share, abs=0.03)


def test_procedural_noise_is_what_the_frozen_extractor_was_trained_on():
    """Of every sort at its usual strength: pixels recorded on 2026-11-28, from code of 2026-11-22."""
    depth = np.broadcast_to(np.linspace(1.4, 0.6, 45, dtype=np.float32)[:, None], (45, 80)).copy()
    depth[17:30, 32:47] = 0.7
    made = corrupt(depth, np.random.default_rng(0), D455.scaled(1 / 16))
    recorded = [
        [1.4185, 1.4394, 1.4329, 1.3527],
        [1.1188, 1.1009, 1.1342, 1.1360],
        [0.8279, 0.8685, 0.8484, 0.8640],
    ]
    np.testing.assert_allclose(made[::15, ::20], recorded, atol=1e-3)
    assert abs(int((made == 0).sum()) - 9) <= 1 and made.mean() == pytest.approx(0.98508, abs=1e-3)
    pool = hand_made((1000 * depth).astype(np.uint16), (1000 * depth).astype(np.uint16))
    treated = data.TREATMENTS["procedural"](pool, 0, np.random.default_rng(0))
    assert treated.shape == depth.shape and 1e-3 < np.median(np.abs(treated - depth)) < 0.1


def test_training_freezes_an_extractor_that_loads(tmp_path):
    manifest = training.train(TINY, tmp_path / "made", quiet=True)
    assert not (tmp_path / "made" / training.WORK).exists()
    assert manifest["tested_on_new_cameras"]["r_squared"].keys() == set(data.MEASURED)
    extractor = depth_features.load(tmp_path / "made")
    assert extractor.name == manifest["name"] == f"depthfeat-{manifest['sha256'][:8]}"
    assert extractor(scene()).shape == (1, depth_features.FEATURES)
    with pytest.raises(UserError, match="finished extractor"):
        training.train(TINY, tmp_path / "made", quiet=True)


def test_frozen_statistics_standardise_the_features_of_training_pictures(pool, monkeypatch):
    monkeypatch.setattr(training, "_TEST_MAPS", 96)
    params = training.init_state(TINY).params
    frozen = training._frozen(params, pool, 0)
    depth_m = training._draw(pool, training._TEST_MAPS, 0, 3).depth_m
    parts = np.split(depth_m, len(depth_m) // 16)
    made = np.concatenate([np.asarray(depth_features.standardised(frozen, part)) for part in parts])
    np.testing.assert_allclose(made.mean(0), 0, atol=1e-2)
    alive = frozen["std"] > 0.01  # 1e-4 is added, so that a feature that never changes divides by no zero
    assert alive.mean() > 0.5
    np.testing.assert_allclose(made.std(0)[alive], 1, atol=0.011)


def test_the_test_counts_treatments_named_rightly_and_variance_explained(pool, monkeypatch):
    monkeypatch.setattr(training, "_TEST_MAPS", 96)
    params = jax.tree.map(jnp.zeros_like, training.init_state(TINY).params)
    batch = training._draw(pool, training._TEST_MAPS, 0, 4)
    named = list(data.TREATMENTS).index("filled")
    params["heads"]["Dense_1"]["bias"] = jnp.zeros(len(data.TREATMENTS)).at[named].set(1.0)
    scale = batch.measured.mean(0), batch.measured.std(0) + 1e-3
    tested = training._test(params, pool, scale, 0)
    assert 0.05 < tested["treatment_accuracy"] == np.mean(batch.family == named) < 0.2
    assert tested["r_squared"] == {name: pytest.approx(0, abs=2e-3) for name in data.MEASURED}  # the mean
    shifted = training._test(params, pool, (scale[0] - scale[1], scale[1]), 0)  # a deviation off
    assert shifted["r_squared"]["invalid"] == pytest.approx(-1, abs=0.05)


def test_one_process_trains_in_a_folder(tmp_path):
    with alone_in(tmp_path), pytest.raises(UserError, match="another process is at work in"):
        training.train(TINY, tmp_path, quiet=True)
    assert not list(tmp_path.iterdir())


def test_a_damaged_file_of_a_camera_is_named(tmp_path):
    for number in range(TINY.devices):
        (tmp_path / f"device_{number:03d}.npz").write_bytes(b"PK\x03\x04 cut off")
    with pytest.raises(UserError, match=r"device_000.npz is damaged .*delete it and run the same command"):
        training.load_pools(TINY, tmp_path, Progress(quiet=True))


def test_cameras_taken_before_are_not_in_the_estimate(pool, tmp_path, monkeypatch):
    for number in range(TINY.devices):
        np.savez(tmp_path / f"device_{number:03d}.npz", **vars(pool))
    began: list[tuple[str, int]] = []
    monkeypatch.setattr(Task, "start_at", lambda task, done: began.append((task.label, done)))
    monkeypatch.setattr(Task, "advance", lambda task, n=1: began.append(("advanced", n)))
    training.load_pools(TINY, tmp_path, Progress(quiet=True))
    assert began == [("random cameras", 2)]


def test_training_begun_with_other_settings_is_refused(tmp_path):
    training._check_begun(TINY, tmp_path / training.WORK)
    training._check_begun(TINY, tmp_path / training.WORK)
    with pytest.raises(UserError, match=r"other settings \(width_px is \d+ there, 48 here\): use those"):
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
