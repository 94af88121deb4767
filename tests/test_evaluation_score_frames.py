"""What is scored, and what is refused before hours of work: frames, their colour, weights, kept episodes."""

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from ddg_jax.prior import make_prior
from ddg_jax.sample import Generator
from ddgrasp import artifacts
from ddgrasp.config import Config, DDGConfig, PriorConfig, ScoreConfig
from ddgrasp.errors import UserError
from ddgrasp.files import atomic_write_json
from ddgrasp.job import Job
from ddgrasp.presets import PRESETS
from ddgrasp.progress import Progress
from ddgrasp.shipped import PRETRAINED
from ddgrasp.stages import get_stage
from evaluation.depth_score import curve, real, samplers, stage
from evaluation.depth_score import data as score_data
from evaluation.depth_score import episodes as score_episodes
from evaluation.depth_score import table as score_table
from evaluation.depth_score.domains import COLUMNS, FLOOR, RAW, Column, Methods
from evaluation.depth_score.figures import draw_embedding
from evaluation.depth_score.resampling import Sample
from foundation import store
from job_support import make_job
from recording_support import flat, set_meta, write_depth

QUIET = Progress(quiet=True)


def episode(side: str, colour: bool = True) -> score_data.Episode:
    depth = np.full((3, 36, 64), 700, np.uint16)
    rgb = np.zeros((3, 36, 64, 3), np.uint8) if colour else None
    return score_data.Episode(side, 0, 0, depth, depth, depth[:0], rgb, 40.0, 0.095)


def write_recording(path: Path, aligned: bool) -> None:
    write_depth(path, 8 * [flat((48, 64), 700)], fx_px=40.0, sensor="RealSense D435")
    set_meta(path, color_aligned_to_depth=aligned)


def test_colour_of_recordings_that_are_not_scored_counts_for_nothing(tmp_path):
    write_recording(tmp_path / "a", aligned=False)
    write_recording(tmp_path / "b", aligned=True)
    found = score_data.load_real(tmp_path, 32, 8)
    assert found.unaligned == () and found.focal_px == 20.0  # 40 px of a picture twice as wide
    assert score_data.load_real(tmp_path, 32, 9).unaligned == (tmp_path / "a",)


def test_frames_that_are_blind_at_the_score_s_size_are_left_out(tmp_path):
    blind = np.zeros((72, 128), np.uint16)
    blind[0, 0] = 700  # no pixel of the score's, which are every fourth
    frames = [flat((72, 128), 700 + n) for n in range(24)]
    about = {"fx_px": 80.0, "sensor": "RealSense D435", "consecutive_frames": True}
    write_depth(tmp_path / "a", [*frames[:12], blind, *frames[13:]], **about)
    found = score_data.load_real(tmp_path / "a", 32, 24)
    assert (found.blind, len(found.depth_mm), found.apart) == (1, 23, {0: tmp_path / "a"})
    assert found.depth_mm.min() == 700 and 712 not in found.depth_mm
    first = score_data.load_real(tmp_path / "a", 32, 12)  # no gap: nothing is before it
    assert (first.blind, len(first.depth_mm), first.apart) == (1, 11, {})
    behind = score_data.load_real(tmp_path / "a", 32, 11)
    assert (behind.blind, len(behind.depth_mm), behind.apart) == (0, 11, {})
    write_depth(tmp_path / "b", [blind], **about)
    with pytest.raises(UserError, match="its last 1 frames have no depth at 32x18"):
        score_data.load_real(tmp_path / "b", 32, 1)


@pytest.mark.parametrize("by", ["column monocular", "prior of simulated colour"])
def test_colour_of_another_view_is_refused_before_the_fit(tmp_path, by):
    """By whoever would ask for it once the generator is there; what it is fitted on is aligned."""
    folder, manifest = tmp_path / "depth_anything_v2_small", store.WeightsManifest
    made = manifest("depth_anything_v2_small", "x.pth", "ab12", "Apache-2.0", "here", 1, {}, "today")
    atomic_write_json(folder / store.MANIFEST, made)
    write_recording(tmp_path / "rooms" / "a", aligned=True)
    for name in ("b", "c"):
        write_recording(tmp_path / "rooms" / name, aligned=False)
    config = PRESETS["debug"]  # whose fit, if it came to that, takes seconds
    if by == "column monocular":
        config = replace(config, score=ScoreConfig(monocular_weights=str(folder)))
    else:
        prior = PriorConfig(source="depth_anything_v2", weights=str(folder), in_sim="rgb")
        config = replace(config, ddg=replace(config.ddg, prior=prior))
    inputs = {"data": tmp_path / "rooms", "fit_frames": 8, "score_frames": 16}
    with pytest.raises(UserError, match=rf"rooms/b: colour is not aligned to depth, as .*{by}"):
        real.run(make_job("score_real", config, tmp_path / "score_real", **inputs))
    assert not list((tmp_path / "score_real").iterdir())


@pytest.mark.parametrize("without", ["real_0000", "sim_0001"])
def test_a_trajectory_without_colour_is_refused_before_any_is_scored(tmp_path, without):
    for name in ("real_0000", "real_0001", "sim_0000", "sim_0001"):
        score_data._save(tmp_path / f"{name}.npz", episode(name[:-5], colour=name != without))
    config = Config(preset="test", score=ScoreConfig(trajectories=2))
    with pytest.raises(UserError, match=f"{without}.npz was recorded without colour"):
        score_data.record_rig(config, tmp_path / "teacher", tmp_path, True, QUIET)


@pytest.mark.parametrize("module", [stage, curve, samplers], ids=lambda module: module.__name__)
def test_absent_weights_are_said_before_anything_is_recorded(tmp_path, monkeypatch, module):
    """Nor is anything else read: the parents are empty."""
    monkeypatch.setattr(store, "WEIGHTS_DIR", tmp_path)
    config = Config(preset="test", score=ScoreConfig(features=("fid_inception",)))
    parents = {
        name: artifacts.finish(tmp_path / name, name, config, seconds=0, metrics={})
        for name in ("teacher", "ddg")
    }
    with pytest.raises(UserError, match=f"{tmp_path}/fid_inception holds no converted weights"):
        module.run(Job(get_stage("score"), config, tmp_path, QUIET, parents))


def test_the_same_episodes_are_examples_wherever_a_run_was_stopped(tmp_path, monkeypatch):
    monkeypatch.setattr(score_episodes, "EXAMPLES", 1)
    methods = Methods(ScoreConfig(), 0, Generator(DDGConfig(), {}, make_prior(DDGConfig())))
    loads = [partial(episode, "real")] * 2

    def examples() -> int:
        files = score_episodes.score_episodes(methods, [], loads, ["real_raw"], tmp_path, QUIET)
        return len(score_episodes.collect(files).examples["real_raw"])

    assert examples() == 1
    (tmp_path / "0001.npz").unlink()
    assert examples() == 1


def test_every_column_is_resampled_alike():
    """So that a ratio to Sim GT's distance has the interval of the method alone: none, of the same maps."""
    rng, groups = np.random.default_rng(0), np.repeat([0, 1, 2, 3], 2)
    real, floor, clean = (Sample(rng.normal(size=(8, 2)), of) for of in (groups, groups + 4, groups + 4))
    samples = {RAW: real, FLOOR: floor, "sim_gt": clean, "sim_ddg": clean}
    config = ScoreConfig(columns=("sim_gt", "ddg"), bootstrap=5, kid_subset_size=2)
    table = score_table.make_table(samples, config, 0, QUIET)
    assert table["ddg"]["fid"]["low"] < table["ddg"]["fid"]["high"]
    assert table["ddg"]["fid_ratio"] == {"value": 1, "low": 1, "high": 1}


def test_samplers_have_the_generators_own_and_steps_that_do_not_spoil_them():
    """Second order at a DDIM's steps leaves specks; the shipped generator has trailing ones."""
    sampling = {name: made.config.sampling for name, made in samplers._generators(PRETRAINED / "ddg")}
    steps = {name: f"{s.sampler} {s.steps} {s.spacing}" for name, s in sampling.items()}
    assert steps["ddim 8"] == "ddim 8 trailing" and steps["ddim 50"] == "ddim 50 trailing"
    assert steps["dpm_solver 4"] == "dpm_solver 4 quadratic"
    assert steps["dpm_solver 8"] == "dpm_solver 8 quadratic"


def test_a_column_more_than_the_paper_has_is_drawn(monkeypatch):
    for name in ("mine", "another"):
        monkeypatch.setitem(COLUMNS, name, Column(name, RAW, "sim_gt"))
    flat = {RAW: np.zeros((3, 2)), "sim_gt": np.ones((3, 2))}
    column = {"title": "mine", "real": RAW, "sim": "sim_gt", "fid": {"value": 1.0}, "mixing": {"value": 0.5}}
    assert draw_embedding(flat, {"sim_gt": column, "mine": column}, 1.0).startswith(b"\x89PNG")


def test_what_is_scored_is_no_trajectory_that_a_stage_records(monkeypatch, tmp_path):
    class World:
        def reset(self, seed, name):
            raise LookupError(seed)

    recorder = score_data._RigRecorder(PRESETS["debug"], PRETRAINED / "teacher", False)
    monkeypatch.setattr(recorder, "_world", World())

    def world_of(number: int) -> int:
        with pytest.raises(LookupError) as drawn:
            recorder.run((number, "real", tmp_path / "episode.npz"))
        return drawn.value.args[0]

    recorded = {int(np.random.default_rng([PRESETS["debug"].seed, i]).integers(2**31)) for i in range(100)}
    assert not recorded & {world_of(number) for number in range(20)}
