"""Artefact masks over thresholds: the analysis counts what it says."""

import json
from dataclasses import replace

import cv2
import jax
import numpy as np
import pytest

from ddg_jax import thresholds
from ddg_jax.data import Frames
from ddg_jax.representation import decode, encode
from ddg_jax.sample import PARAMS_FILE
from ddg_jax.train import init_params
from ddgrasp import artifacts
from ddgrasp.config import Config, DDGConfig, DDGDepthConfig, SamplingConfig, UNetConfig
from ddgrasp.progress import Progress
from learning.params import save_params
from recording_support import flat, write_depth

CONFIG = DDGConfig(
    depth=DDGDepthConfig(height_px=16, width_px=24),
    unet=UNetConfig(widths=(8, 8), blocks=(0, 1), attention_heads=1),
    sampling=SamplingConfig(steps=2),
)
DEPTH = replace(
    CONFIG,
    depth=replace(CONFIG.depth, representation="depth"),
    graft=replace(CONFIG.graft, noise_threshold=-0.2),
)


def test_a_hole_is_the_same_at_every_threshold_of_the_empty_band():
    depth = np.array([[0.0, 0.26, 1.0, 5.0, 9.9]], np.float32)
    x = encode(DEPTH, depth, depth)
    for threshold in thresholds.THRESHOLDS:
        mask = decode(replace(DEPTH, graft=replace(DEPTH.graft, noise_threshold=threshold)), x, depth).mask
        np.testing.assert_array_equal(mask, depth == 0)


def test_the_analysis_by_hand():
    recorded = np.full((2, 4, 5), 1.0, np.float32)
    recorded[:, 0, :2] = 0
    clean = np.full_like(recorded, 1.0)
    x = np.array(encode(DEPTH, clean, clean))
    x[:, 0, 0] = -0.95  # a hole at every threshold
    x[0, 3, 4] = -0.45  # one above -0.45, in the first frame only
    x[:, 2, 2] = np.asarray(encode(DEPTH, np.float32(0.8), np.float32(0.8)))
    frames = Frames(recorded, clean, clean, np.zeros(2, int))
    low, high = (thresholds.masked(DEPTH, x, frames, t) for t in (-0.5, -0.4))
    assert low.invalid_fraction == pytest.approx(2 / 40) and high.invalid_fraction == pytest.approx(3 / 40)
    assert (low.hole_components, high.hole_components) == (1.0, 1.5)
    assert (low.flicker_fraction, high.flicker_fraction) == pytest.approx((0.0, 1 / 20))
    assert (low.hole_iou, high.hole_iou) == pytest.approx((2 / 4, 2 / 5))
    # 200 mm at two pixels; at -0.5 the pixel with x = -0.45 counts as far away, 9 m off
    assert high.valid_error_mm == pytest.approx(2 * 200 / 37, rel=1e-3)
    assert low.valid_error_mm == pytest.approx((2 * 200 + 9000) / 38, rel=1e-3)
    assert low.grafted_error_mm == high.grafted_error_mm == 0.0


def make(tmp_path, **frames: int) -> None:
    """A model whose manifest says `frames` of its fit, and a recording whose frame t of four has
    12 + 24 t of 384 pixels invalid at the model's size."""
    params = init_params(CONFIG, jax.random.key(0))
    save_params(tmp_path / "ddg" / PARAMS_FILE, params)
    metrics = {"frames": frames} if frames else {}
    artifacts.finish(tmp_path / "ddg", "ddg", Config(preset="test", ddg=CONFIG), seconds=1, metrics=metrics)
    recorded = [flat((32, 48), 900) for _ in range(4)]
    for t, depth in enumerate(recorded):
        depth[8:20, 16 + t : 20 + t] = 0
        depth[: 2 * t] = 0
    write_depth(tmp_path / "recording", recorded)


@pytest.mark.parametrize(
    ("frames", "count", "used", "said"),
    [
        ({"training": 3, "held_out": 1}, None, 1, None),
        ({"training": 3, "held_out": 1}, 2, 2, "--count 2 of 1 frame(s) held out: "),
        ({"training": 2}, None, 2, None),  # `ddg score --real` fits on the first ones
        ({"training": 500, "held_out": 300}, None, 4, None),  # of other recordings
        ({"training": 9}, None, 4, "the model does not say which frames it was fitted on"),
        ({}, None, 4, "the model does not say which frames it was fitted on"),
    ],
)
def test_frames_that_were_fitted_on_are_not_judged_unasked(tmp_path, capsys, frames, count, used, said):
    make(tmp_path, **frames)
    given = {} if count is None else {"count": count}
    thresholds.analyse(tmp_path / "ddg", tmp_path / "recording", tmp_path, Progress(), **given)
    recorded = json.loads((tmp_path / "thresholds.json").read_text())["recorded"]["invalid_fraction"]
    assert recorded == pytest.approx(np.mean((12 + 24 * np.arange(4)[-used:]) / 384))
    notes = capsys.readouterr().err
    assert said in notes if said else "held out" not in notes and "does not say" not in notes


def test_the_command_leaves_a_table_and_a_plot(tmp_path):
    make(tmp_path)
    out = tmp_path / "out"
    rows = thresholds.analyse(
        tmp_path / "ddg", tmp_path / "recording", out, Progress(quiet=True), count=3, seed=0
    )
    value = json.loads((out / "thresholds.json").read_text())
    assert [row["threshold"] for row in value["thresholds"]] == [row.threshold for row in rows]
    assert [row.threshold for row in rows] == [-0.8, -0.6, -0.4, -0.2, 0.0, 0.2, 0.4, 0.6, 0.8]
    fractions = [row.invalid_fraction for row in rows]
    assert fractions == sorted(fractions)
    assert value["recorded"]["invalid_fraction"] == pytest.approx((12 + 24 * 2) / 384)
    assert cv2.imread(str(out / "thresholds.png")).shape[1] > 1000
    assert len(thresholds.table(rows).splitlines()) == 10
