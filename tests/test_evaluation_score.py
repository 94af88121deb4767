"""`ddgrasp ddg score` and `ddg curve` end to end at their smallest, on a small generator and the rig."""

import json
import shutil
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from app import cli
from ddg_jax import stage as ddg_stage
from ddg_jax.prior import make_prior
from ddg_jax.representation import LIMIT_PER_M
from ddg_jax.sample import Generator
from ddgrasp import artifacts
from ddgrasp.config import (
    Config,
    DDGConfig,
    DDGDepthConfig,
    DDGDiffusionConfig,
    DDGTrainingConfig,
    GraftConfig,
    PriorConfig,
    RecordConfig,
    SamplingConfig,
    ScoreConfig,
    UNetConfig,
)
from ddgrasp.errors import UserError
from ddgrasp.progress import Progress
from evaluation.depth_score import data as score_data
from evaluation.depth_score import features as score_features
from evaluation.depth_score import holes
from evaluation.depth_score import table as score_table
from evaluation.depth_score.domains import (
    COLUMNS,
    DOMAINS,
    FLOOR,
    LIMIT,
    REFERENCES,
    Methods,
    sense,
    wanted_domains,
)
from evaluation.depth_score.episodes import Scored, collect, score_episodes
from evaluation.depth_score.figures import draw_efficiency
from evaluation.report.stage import write_report
from job_support import make_job
from recording_support import flat, set_meta, write_depth
from sensors.inpainting import inpainted
from sensors.recordings.writer import RecordingWriter
from weights_support import depth_anything_v2_small

ROOT = Path(__file__).parents[1]
CONFIG = Config(
    preset="test",
    record=RecordConfig(trajectories=1, frames=6),
    ddg=DDGConfig(
        depth=DDGDepthConfig(height_px=36, width_px=64),
        unet=UNetConfig(widths=(8, 8), blocks=(0, 1), attention_heads=1),
        diffusion=DDGDiffusionConfig(steps=50),
        training=DDGTrainingConfig(steps=4, batch_size=2, checkpoint_every=2),
        sampling=SamplingConfig(steps=2, batch_size=4),
        prior=PriorConfig(input_px=28),
        graft=GraftConfig(noise_threshold=0.0),
    ),
)
SIZES = [
    "--preset",
    "debug",
    "--kid-subset-size",
    "2",
    "--bootstrap",
    "3",
    "--trajectories",
    "2",
    "--frames",
    "2",
]
OF_REAL = SIZES[: SIZES.index("--trajectories")]


def write_recording(path: Path, frames: int, size: tuple[int, int]) -> None:
    """A slope, a box that moves, and its shadow."""
    rng = np.random.default_rng(0)
    with RecordingWriter(path, {"fx_px": 0.6 * size[1], "sensor": "RealSense D435"}) as writer:
        for t in range(frames):
            depth = np.broadcast_to(np.linspace(1500, 700, size[0])[:, None], size).copy()
            left = size[1] // 3 + t % 10
            depth[size[0] // 3 : size[0] // 2, left : left + size[1] // 5] = 650
            depth[size[0] // 3 : size[0] // 2, left - 4 : left] = 0
            depth[rng.random(size) < 0.02] = 0
            writer.add(rng.integers(0, 255, (*size, 3)).astype(np.uint8), depth.astype(np.uint16))


@pytest.fixture(scope="module")
def run_dir(tmp_path_factory):
    """A run with the pretrained teacher, one recording and a generator fitted on it."""
    root = tmp_path_factory.mktemp("run")
    shutil.copytree(ROOT / "pretrained" / "teacher", root / "teacher")
    write_recording(root / "record" / "rig_0000", 6, (180, 320))
    artifacts.finish(root / "record", "record", CONFIG, seconds=1, metrics={})
    progress = Progress(root / "ddg", "ddg", quiet=True)
    ddg_stage.run(make_job("ddg", CONFIG, root / "ddg", progress, data=root / "record"))
    progress.close()
    return root


@pytest.fixture(scope="module")
def scored(run_dir, tmp_path_factory):
    out = tmp_path_factory.mktemp("out")
    assert cli.main(["ddg", "score", *SIZES, "--out", str(out), "--run-dir", str(run_dir)]) == 0
    return out


def test_the_score_has_every_column_the_floor_and_the_targets(scored):
    result = json.loads((scored / "score" / "score.json").read_text())
    table = result["tables"]["depthfeat-v1"]
    assert set(table) == {*COLUMNS, *REFERENCES}
    assert table["monocular"] == {"title": "Monocular", "absent": "no weights"}
    for name, figures in table.items():
        if name != "monocular":
            assert figures["fid"]["low"] <= figures["fid"]["high"] and np.isfinite(figures["fid"]["value"])
    assert set(table["sim_gt"]["fid_ratio"].values()) == {1}  # the interval too: a draw over itself
    ratio = table["ddg"]["fid"]["value"] / table["sim_gt"]["fid"]["value"]
    assert table["ddg"]["fid_ratio"]["value"] == pytest.approx(ratio)
    assert [t["met"] in ("met", "not met") for t in result["targets"]] == [True] * 4
    assert result["maps"] == {name: 4 for name in wanted_domains(COLUMNS) if "monocular" not in name}
    assert result["features"]["depthfeat-v1"]["sha256"]


def test_a_generator_of_another_shape_than_the_camera_is_refused_before_recording(run_dir, tmp_path):
    depth = replace(CONFIG.ddg.depth, height_px=48)
    square = replace(CONFIG, ddg=replace(CONFIG.ddg, depth=depth))
    with pytest.raises(UserError, match="depth is 320x180, the generator's 64x48: .*height-px 36"):
        score_data.record_rig(square, run_dir / "teacher", tmp_path / "data", False, Progress(quiet=True))
    assert not (tmp_path / "data").exists()


def test_hole_figures_say_what_must_be_so(scored):
    result = json.loads((scored / "score" / "score.json").read_text())["holes"]
    value = {name: {k: v["value"] for k, v in item["figures"].items()} for name, item in result.items()}
    assert value["sim_gt"]["rmse_mm"] == value[LIMIT]["rmse_mm"] == 0  # exact where valid
    # grafting takes small deviations back and adds none; the rest is rounding to millimetres
    assert value["sim_ddg"]["rmse_mm"] <= value["sim_ddg_no_graft"]["rmse_mm"] + 0.5
    assert value["real_inpaint"]["invalid_share"] == 0
    assert value["real_raw"]["invalid_share"] > 0.05 and value["real_raw"]["gap_depth_m"] == 0
    assert 0 < value["sim_sensed"]["repeat_iou"] < 1
    assert value["sim_sensed"]["gap_edge_distance_px"] < value["sim_gt"]["gap_edge_distance_px"]


def test_pages_and_pictures_are_there_and_the_report_shows_them(scored):
    pictures = {path.name for path in (scored / "score" / "pictures").iterdir()}
    assert pictures == {"table_1_depthfeat_v1.png", "holes.png", "tsne.png", "examples.png"}
    page = (scored / "score" / "score.html").read_text()
    assert "no weights" in page and page.count("data:image/png") == 3
    report = write_report(scored)
    assert report["score"]["targets"][0]["target"].startswith("FID of DDG <= 0.15")
    html = (scored / "report.html").read_text()
    assert "Real vs real" in html and "table 1 depthfeat v1" in html


def test_a_stopped_score_goes_on_to_the_same_figures(scored, run_dir, tmp_path, capsys):
    scored = shutil.copytree(scored, tmp_path / "out")  # of which others read on
    command = ["ddg", "score", *SIZES, "--out", str(scored), "--run-dir", str(run_dir)]
    before = (scored / "score" / "score.json").read_bytes()
    assert cli.main(command) == 2 and "--resume" in capsys.readouterr().err
    for name in ("manifest.json", "score.json", "episodes/0003.npz", "data/sim_0001.npz"):
        (scored / "score" / name).unlink()
    kept = (scored / "score" / "episodes" / "0000.npz").stat().st_mtime_ns
    assert cli.main([*command, "--resume"]) == 0
    assert (scored / "score" / "episodes" / "0000.npz").stat().st_mtime_ns == kept
    assert (scored / "score" / "score.json").read_bytes() == before


def test_a_real_cameras_recordings_are_fitted_and_scored(tmp_path, capsys):
    write_recording(tmp_path / "room", 26, (48, 64))
    command = ["ddg", "score", *OF_REAL, "--out", str(tmp_path / "out"), "--real", str(tmp_path / "room")]
    assert cli.main([*command, "--fit-frames", "20", "--score-frames", "16"]) == 2
    assert "must not overlap" in capsys.readouterr().err
    assert cli.main([*command, "--run-dir", str(tmp_path)]) == 2
    assert "leave one of them out" in capsys.readouterr().err
    assert cli.main([*command, "--ddg.init-from", "pretrained/ddg"]) == 2
    assert "--ddg.init-from pretrained/ddg with --real: what is scored is fitted" in capsys.readouterr().err
    command += ["--fit-frames", "10", "--score-frames", "16", "--ddg.training.steps", "3"]
    assert cli.main([*command, "--resume"]) == 0
    fitted = artifacts.read_manifest(tmp_path / "out" / "score_real" / "ddg").config["ddg"]
    assert (fitted["depth"]["height_px"], fitted["training"]["steps"]) == (60, 3)
    result = json.loads((tmp_path / "out" / "score_real" / "score.json").read_text())
    table = result["tables"]["depthfeat-v1"]
    assert "Nobody modelled that room" in result["setting"]
    assert table["sim_gt"]["fid"]["value"] > table["floor"]["fid"]["value"] >= 0
    told, said = "room: meta.json does not say that frames follow each other", capsys.readouterr()
    assert "score.html" in said.out and told in said.err and told in result["setting"]
    assert cli.main([*command, "--resume"]) == 0
    assert "finished before" in capsys.readouterr().err


def test_disparity_is_the_recorded_cameras_own(tmp_path):
    write_recording(tmp_path / "room", 2, (48, 64))
    real = score_data.load_real(tmp_path / "room", 32, 2)
    assert (real.focal_px, real.baseline_m) == (pytest.approx(0.6 * 32), 0.050)
    meta = tmp_path / "room" / "meta.json"
    meta.write_text(meta.read_text().replace("D435", "of another make"))
    with pytest.raises(UserError, match="add fx_px and baseline_m to meta.json"):
        score_data.load_real(tmp_path / "room", 32, 2)


def test_recordings_of_frames_that_may_not_follow_each_other_are_known(tmp_path):
    for name, follow in (("a", False), ("b", True), ("c", False)):
        write_recording(tmp_path / name, 8, (48, 64))
        set_meta(tmp_path / name, consecutive_frames=follow)
    assert score_data.load_real(tmp_path, 32, 16).apart == {2: tmp_path / "c"}
    assert score_data.load_real(tmp_path / "b", 32, 8).apart == {}
    (tmp_path / "b" / "color" / "000003.jpg").unlink()  # between others
    assert score_data.load_real(tmp_path / "b", 32, 7).apart == {0: tmp_path / "b"}


def test_a_picture_that_came_again_stands_on_one_side_alone(tmp_path):
    seen = [flat((48, 64), 800 + (n - n % 2 if n < 8 else n)) for n in range(20)]
    write_depth(tmp_path / "a", seen, fx_px=40.0, baseline_m=0.05, repeated_frames=4)
    real = score_data.load_real(tmp_path / "a", 32, 18)
    assert real.total == 20 and (real.depth_mm[:, 0, 0] - 800).tolist() == [2, 4, 6, *range(8, 20)]


def test_blocks_are_of_one_recording_each(tmp_path):
    for name, frames in (("a", 11), ("b", 13), ("c", 16), ("d", 7)):
        write_recording(tmp_path / name, frames, (48, 64))
    real = score_data.load_real(tmp_path, 32, 40)  # the last four of a
    assert real.recording.tolist() == [0] * 4 + [1] * 13 + [2] * 16 + [3] * 7
    assert real.blocks == [4, 17, 25]
    episodes = score_data.real_episodes(real, with_rgb=True)
    assert [(e.side, e.number, e.group) for e in episodes] == [
        (side, number, number % 3) for number, side in enumerate(["real"] * 3 + ["sim"] * 3)
    ]
    for episode, rows in ((episodes[0], np.s_[4:12:2]), (episodes[4], np.s_[18:25:2])):
        np.testing.assert_array_equal(episode.sensed_mm, real.depth_mm[rows])
        np.testing.assert_array_equal(episode.rgb, real.rgb[rows])
    assert score_data.load_real(tmp_path / "c", 32, 15).blocks == [0]  # from the first frame, as ever


def test_scored_recordings_are_of_one_camera_and_long_enough(tmp_path, capsys):
    for name in ("a", "b", "c"):
        write_recording(tmp_path / "rooms" / name, 9, (48, 64))
    meta = tmp_path / "rooms" / "a" / "meta.json"
    meta.write_text(meta.read_text().replace("D435", "D455"))
    command = ["ddg", "score", *OF_REAL, "--out", str(tmp_path / "out"), "--real", str(tmp_path / "rooms")]
    assert cli.main([*command, "--fit-frames", "2", "--score-frames", "19"]) == 2
    said = capsys.readouterr().err
    assert "b has focal length and baseline (38.4, 0.05), " in said and "a (38.4, 0.095)" in said
    assert score_data.load_real(tmp_path / "rooms", 32, 18).baseline_m == 0.05  # a is not among them
    assert cli.main([*command, "--fit-frames", "2", "--score-frames", "16", "--resume"]) == 2
    assert "16 hold 1 run(s) of 8 frames of one recording; expected 2" in capsys.readouterr().err
    assert not (tmp_path / "out" / "score_real" / "ddg").exists()


def test_colour_of_another_view_is_no_monocular_network_s(tmp_path):
    write_recording(tmp_path / "room", 8, (48, 64))
    set_meta(tmp_path / "room", color_aligned_to_depth=False)
    frames = score_data.load_real(tmp_path / "room", 32, 8)
    assert len(score_data.real_episodes(frames, with_rgb=False)) == 2
    with pytest.raises(UserError, match="room: colour is not aligned to depth"):
        score_data.real_episodes(frames, with_rgb=True)


@pytest.mark.parametrize(
    "option", [("--ddg.training.steps", "3"), ("--fit-frames", "9"), ("--score-frames", "17")]
)
def test_options_of_real_without_it_are_refused(option, run_dir, tmp_path, capsys):
    command = [
        "ddg",
        "score",
        "--preset",
        "debug",
        "--out",
        str(tmp_path),
        "--run-dir",
        str(run_dir),
        *option,
    ]
    assert cli.main(command) == 2
    assert "without --real" in capsys.readouterr().err


def test_sides_that_show_the_same_scenes_are_resampled_together():
    rng, clean = np.random.default_rng(0), np.ones((1, 36, 64), np.float32)
    depths = [np.where(rng.random(clean.shape) < share, 0, clean) for share in (0.1, 0.2, 0.3)]
    scenes = [holes.episode_sums(depth, clean, [holes.geometry(clean[0], 40.0)]) for depth in depths]
    both = Scored(sums={"real_raw": scenes, FLOOR: scenes}, groups={"real_raw": [0, 1, 2], FLOOR: [0, 1, 2]})
    apart = Scored(sums=both.sums, groups={"real_raw": [0, 1, 2], FLOOR: [3, 4, 5]})
    together, alone = (
        score_table.hole_figures(s, 20, 0)[FLOOR]["figures"]["gap_depth_m"] for s in (both, apart)
    )
    assert together["low"] == together["high"] == 0 < alone["high"] - alone["low"]
    two = {"sim_gt": scenes, "sim_ddg": scenes}
    alike = dict.fromkeys(two, [3, 4, 5])
    twice = Scored(sums={**both.sums, **two}, groups={**both.groups, **alike})
    made = score_table.hole_figures(twice, 20, 0)
    np.testing.assert_equal(made["sim_gt"]["figures"], made["sim_ddg"]["figures"])  # drawn alike


def test_the_curve_fits_and_scores_every_size_and_keeps_finished_points(run_dir, tmp_path, capsys):
    command = ["ddg", "curve", *SIZES, "--curve-trajectories", "2", "1", "--out", str(tmp_path)]
    command += ["--run-dir", str(run_dir)]
    assert cli.main(command) == 0
    left = [str(tmp_path / "curve" / name) for name in ("curve.json", "pictures")]
    assert capsys.readouterr().out.splitlines()[-2:] == left
    result = json.loads((tmp_path / "curve" / "curve.json").read_text())
    assert [(p["trajectories"], p["frames"], p["steps"]) for p in result["points"]] == [(1, 6, 4), (2, 12, 4)]
    assert (tmp_path / "curve" / "record" / "rig_0001" / "meta.json").exists()
    assert (tmp_path / "curve" / "pictures" / "curve.png").exists()
    point = tmp_path / "curve" / "n001" / "point.json"
    kept = point.stat().st_mtime_ns
    (tmp_path / "curve" / "manifest.json").unlink()
    (tmp_path / "curve" / "n002" / "point.json").unlink()
    assert cli.main([*command, "--resume"]) == 0
    assert point.stat().st_mtime_ns == kept
    assert json.loads((tmp_path / "curve" / "curve.json").read_text()) == result
    png = draw_efficiency(result["points"], result["points"][0]["floor"], 1.0)
    assert png.startswith(b"\x89PNG")


def test_samplers_are_scored_on_the_same_episodes(run_dir, tmp_path, capsys):
    command = ["ddg", "samplers", *SIZES, "--out", str(tmp_path), "--run-dir", str(run_dir)]
    assert cli.main(command) == 0
    result = json.loads((tmp_path / "samplers" / "samplers.json").read_text())
    rows = result["samplers"]
    others = ["ddim 50", "ddim 10", "ddim 4", "dpm_solver 8", "dpm_solver 4"]
    assert list(rows) == [*others, "dpm_solver 2"]  # its own is the last one
    assert rows["ddim 50"]["over_reference"] == 1.0 and rows["ddim 4"]["over_reference"] != 1.0
    assert all(row["frames_per_s"] > 0 and 0 < row["holes"]["invalid_share"] < 1 for row in rows.values())
    assert 0 <= result["floor"]["fid"]["value"] < rows["ddim 50"]["fid"]["value"]
    printed = capsys.readouterr().out
    assert "at most 4 evaluations" in printed and "Real vs real" in printed
    assert printed.splitlines()[-1] == str(tmp_path / "samplers" / "samplers.json")  # there are no pictures


def test_unknown_columns_and_extractors_are_refused_at_once(capsys, tmp_path):
    for option, value, near in (("--columns", "sim", "sim_gt"), ("--features", "depthfeat", "depthfeat-v1")):
        assert cli.main(["ddg", "score", option, value, "--out", str(tmp_path)]) == 2
        assert f"Did you mean {near!r}" in capsys.readouterr().err
    with pytest.raises(UserError, match="holds no converted weights"):
        score_features.load("fid_inception", tmp_path)


# --- methods by themselves -------------------------------------------------------------------------


def episode(side: str) -> score_data.Episode:
    rng = np.random.default_rng(3)
    clean = np.broadcast_to(np.linspace(1500, 700, 36)[:, None], (3, 36, 64)).astype(np.uint16).copy()
    sensed = np.where(rng.random(clean.shape) < 0.1, 0, clean).astype(np.uint16)
    rgb = rng.integers(0, 255, (3, 36, 64, 3)).astype(np.uint8)
    return score_data.Episode(side, 5, 5, sensed, clean, sensed[:0], rgb, 40.0, 0.095)


def test_inpainting_fills_holes_and_touches_nothing_else():
    real = episode("real")
    filled = inpainted(real.sensed_mm, 3.0)
    valid = real.sensed_mm > 0
    np.testing.assert_array_equal(filled[valid], real.sensed_mm[valid])
    assert (filled > 0).all()
    assert np.abs(filled.astype(int) - real.clean_mm)[:, 2:-2].max() < 40  # a row of the slope is 23 mm


def test_holes_are_filled_from_as_far_as_is_configured():
    real, filled = episode("real"), {}
    for radius_px in (3.0, 9.0):
        config = ScoreConfig(inpaint_radius_px=radius_px)
        methods = Methods(config, 0, Generator(DDGConfig(), {}, make_prior(DDGConfig())))
        filled[radius_px] = sense(methods, real, ["real_inpaint"])["real_inpaint"]
        np.testing.assert_array_equal(filled[radius_px], inpainted(real.sensed_mm, radius_px))
    assert (filled[3.0] != filled[9.0]).any()


def test_domains_belong_to_one_side_and_depend_on_seed_and_episode_alone(run_dir):
    methods = Methods(ScoreConfig(), 0, Generator.load(run_dir / "ddg"))
    names = [name for name in DOMAINS if "monocular" not in name]
    real, sim = (sense(methods, episode(side), names) for side in score_data.SIDES)
    assert set(real) == {"real_raw", "real_inpaint"}
    assert set(sim) == {FLOOR, LIMIT, "sim_gt", "sim_rand_noise", "sim_ddg", "sim_ddg_no_graft"}
    again = sense(methods, episode("sim"), ["sim_ddg"])["sim_ddg"]
    np.testing.assert_array_equal(again, sim["sim_ddg"])
    kept = sim["sim_ddg"] > 0
    off_per_m = np.abs(1000 / sim["sim_ddg"][kept] - 1000 / sim["sim_gt"][kept])
    assert off_per_m.max() <= LIMIT_PER_M + 0.002  # and half a millimetre of rounding
    other = sense(replace(methods, seed=1), episode("sim"), ["sim_ddg", "sim_rand_noise"])
    assert all((other[name] != sim[name]).any() for name in other)


def test_episodes_scored_for_other_columns_are_scored_again(run_dir, tmp_path):
    methods = Methods(ScoreConfig(), 0, Generator.load(run_dir / "ddg"))
    extractors, loads = [score_features.load("depthfeat-v1")], [partial(episode, s) for s in score_data.SIDES]

    def score(*names: str) -> dict[str, int]:
        files = score_episodes(methods, extractors, loads, names, tmp_path, Progress(quiet=True))
        return {name: len(s.features) for name, s in collect(files).features["depthfeat-v1"].items()}

    assert score("real_raw", FLOOR) == {"real_raw": 3, FLOOR: 3}
    times = [file.stat().st_mtime_ns for file in sorted(tmp_path.iterdir())]
    assert score("real_raw", FLOOR, "real_inpaint") == {"real_raw": 3, FLOOR: 3, "real_inpaint": 3}
    again = [file.stat().st_mtime_ns for file in sorted(tmp_path.iterdir())]
    assert again[0] > times[0] and again[1] == times[1]  # nothing new of the simulated side
    assert score("real_raw", FLOOR) == {"real_raw": 3, FLOOR: 3}


def test_the_monocular_column_uses_the_users_weights(run_dir, tmp_path, tmp_path_factory):
    weights = depth_anything_v2_small(tmp_path_factory.getbasetemp())
    generator = Generator.load(run_dir / "ddg")
    methods = Methods(ScoreConfig(monocular_weights=str(weights)), 0, generator)
    assert methods.needs_rgb
    for side in score_data.SIDES:
        made = sense(methods, episode(side), ["real_monocular", "sim_monocular"])[f"{side}_monocular"]
        reference = episode(side).clean_mm
        assert made.shape == reference.shape and (made > 0).all() and len(np.unique(made)) > 100
        assert abs(np.median(made.astype(float)) / np.median(reference) - 1) < 0.25
    with pytest.raises(UserError, match="holds no converted weights"):
        _ = Methods(ScoreConfig(monocular_weights=str(tmp_path / "absent")), 0, generator).monocular
    assert not Methods(ScoreConfig(), 0, generator).needs_rgb
