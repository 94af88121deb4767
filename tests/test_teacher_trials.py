"""Recorded episodes: the same number per object; moments and visible pixels by hand; files and report."""

import json
from dataclasses import replace
from pathlib import Path

import jax
import mujoco
import numpy as np
import pytest

from app import cli
from app.commands import parse
from ddgrasp import artifacts, contract
from ddgrasp.config import Config, PictureConfig, StudentConfig, WorldConfig
from ddgrasp.errors import UserError
from ddgrasp.progress import Progress
from evaluation import teacher_trials
from evaluation.report.run_page import render_html
from evaluation.report.summary import build_report
from mjx_envs import kinematics, scene
from mjx_envs.camera import nominal_camera
from mjx_envs.grasp_env import GraspEnv
from mjx_envs.objects import get_object
from mjx_envs.render import raycast_numpy
from ppo import policy as teacher_policy
from ppo import trials
from ppo.rollout import roll_out
from ppo.visible import MOMENTS, Watcher, moments

PRETRAINED = Path(__file__).parents[1] / "pretrained" / "teacher"
WORLD = WorldConfig(objects=("cube", "lemon"), episode_steps=24, camera_scale=0.125)


@pytest.fixture(scope="module")
def env() -> GraspEnv:
    return GraspEnv(WORLD)


@pytest.fixture(scope="module")
def measured(env):
    """As if physics had left contacts out, three with the cubes and four with the lemons."""
    policy, dropped = teacher_policy.load(PRETRAINED), iter([3, 4])
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(trials, "roll_out", lambda *given: replace(roll_out(*given), dropped=next(dropped)))
        return trials.measure(env, policy, trials=4, watched=2, seed=3, progress=Progress(quiet=True))


def test_keys_take_each_object_equally_often_and_reset_agrees(env):
    keys = trials.episode_keys(env, 5, seed=0)
    assert keys.shape == (2, 5, 2)
    assert len(np.unique(keys.reshape(-1, 2), axis=0)) == 10
    index = jax.jit(jax.vmap(lambda key: env.reset(key).info["episode"].object_index))(keys.reshape(-1, 2))
    assert index.tolist() == [0] * 5 + [1] * 5


def test_measure_counts_the_trials_of_every_object(measured):
    result, pictures = measured
    assert {name: counts["n"] for name, counts in result["objects"].items()} == {"cube": 4, "lemon": 4}
    assert result["success"]["n"] == 8
    assert [row["object"] for row in result["motion"]] == ["cube", "lemon", "all"]
    cube, lemon, both = result["motion"]
    name = "visible_object_pixels_min"
    assert both[name] == min(cube[name], lemon[name])
    # 4 to 7 cm objects, 0.85 m away, at 80 pixels per unit of tangent: some 4 to 7 pixels a side
    assert 4 < both["visible_object_pixels_mean"] < 80
    assert [row["contacts_dropped"] for row in result["motion"]] == [3, 4, 7]
    assert result["contacts_dropped"] == 7
    assert pictures["cube"].shape == (len(MOMENTS), 300, 300, 3)
    assert pictures["cube"].dtype == np.uint8
    assert np.abs(pictures["cube"][0].astype(int) - pictures["cube"][2]).max() > 50  # the arm came into view


@pytest.mark.skipif(any(d.platform == "gpu" for d in jax.devices()), reason="Warp's renderer runs here")
def test_a_renderer_that_cannot_run_is_refused_before_any_episode(monkeypatch):
    monkeypatch.setattr(trials, "record", lambda *_: pytest.fail("an episode began"))
    policy, env = teacher_policy.load(PRETRAINED), GraspEnv(replace(WORLD, renderer="warp"))
    with pytest.raises(UserError, match="renderer 'warp' needs "):
        trials.measure(env, policy, trials=4, watched=2, seed=3, progress=Progress(quiet=True))


def test_visible_pixels_are_those_of_the_numpy_ray_caster(env):
    spec, profile = get_object("cube"), WORLD.profile
    still = WorldConfig(objects=WORLD.objects, random=_no_camera_motion(), camera_scale=WORLD.camera_scale)
    watcher = Watcher(GraspEnv(still))
    model = scene.build_model(layout=env.table.layout)
    data = mujoco.MjData(model)
    data.qpos[:7] = contract.HOME_RAD
    data.qpos[9:12] = (*contract.WORKSPACE_CENTER_M, spec.rest_height_m)
    data.qpos[12:16] = kinematics.quat_about_z(np.asarray(0.4))
    hidden = data.qpos.copy()
    hidden[9] = -3.0  # far behind the camera's window
    mujoco.mj_forward(model, data)
    camera = nominal_camera(profile).cropped(
        *profile.crop_origin_px, profile.crop_height_px, profile.crop_width_px
    )
    expected = np.isin(raycast_numpy.render(model, data, camera).segmentation, scene.slot_ids(model)).sum()
    qpos = np.stack([data.qpos, hidden]).astype(np.float32)[:, None]
    params = jax.tree.map(lambda leaf: np.asarray(leaf)[None], _nominal_params(env))
    counted = np.ones((2, 1), bool)
    seen = watcher.visible_pixels(qpos, params, 0, counted, seed=0)
    assert expected > 15
    assert seen.tolist() == [pytest.approx(expected, abs=1), 0]
    counted[0] = False
    assert watcher.visible_pixels(qpos, params, 0, counted, seed=0).tolist() == [0]


def _no_camera_motion():
    from ddgrasp.config import RandomConfig

    return RandomConfig(camera_position_m=0.0, camera_angle_rad=0.0)


def _nominal_params(env: GraspEnv):
    """Of a cube of nominal size."""
    params = env.reset(jax.random.PRNGKey(0)).info["episode"].params
    table = env.table
    return replace(
        params,
        slot_size=table.model.slot_size[0],
        slot_pos=table.model.slot_pos[0],
        slot_quat=table.model.slot_quat[0],
    )


def test_moments_by_hand():
    qpos = np.zeros((9, 16))
    qpos[:, :7] = contract.HOME_RAD  # the grip point stands 0.26 m above the table
    height = [0.02, 0.22, 0.1, 0.2, 0.2, 0.2, 0.25, 0.32, 0.4]  # 0.22: 4 cm under the grip, not above
    qpos[:, 11] = height
    touched = np.arange(9) >= 4
    running = np.arange(9) < 8
    assert moments(qpos, touched, running).tolist() == [0, 2, 4, 4, 7]
    qpos[4:7, 11] = 0.02
    assert moments(qpos, touched, running).tolist() == [0, 2, 4, 7, 7]
    nothing = np.zeros(9, bool)
    assert moments(qpos, nothing, running).tolist() == [0, 6, 6, 7, 7]  # stands above it, and never closes
    assert moments(qpos[:2], nothing[:2], running[:2]).tolist() == [0, 0, 0, 1, 1]


def test_files_and_report_show_this_teachers_trials(measured, tmp_path):
    result, pictures = measured
    directory = tmp_path / "teacher"
    student = StudentConfig(picture=PictureConfig(height_px=56, width_px=72))
    config = Config(preset="mine", world=replace(WORLD, objects=("cube",)), student=student)
    artifact = artifacts.finish(directory, "teacher", config, seconds=1.0, metrics={})
    summary = teacher_trials.summarise(result, artifact, WORLD, seed=3)
    teacher_trials.save(directory, summary, pictures, MOMENTS)
    saved = json.loads((directory / teacher_trials.TRIALS_FILE).read_text())
    assert saved["seen"]["n"] == saved["unseen"]["n"] == 4
    assert saved["objects"][0]["success"] == {**result["objects"]["cube"], **saved["objects"][0]["success"]}
    assert saved["world"]["objects"] == ["cube", "lemon"]
    report = build_report(tmp_path)
    assert [row["object"] for row in report["teacher"]["trials"]] == ["cube", "lemon", "all"]
    page = render_html(report, tmp_path)
    assert 'alt="episodes" src="data:image/png' in page
    assert "visible_object_pixels_min" in page and "contacts_dropped" in page
    elsewhere = {**summary["world"], "episode_steps": 25}
    for change in ({"teacher": "another"}, {"world": elsewhere}):
        teacher_trials.save(directory, summary | change, pictures, MOMENTS)
        report = build_report(tmp_path)
        assert "trials" not in report["teacher"] and 'alt="episodes"' not in render_html(report, tmp_path)
    before = (directory / teacher_trials.TRIALS_FILE).read_bytes()
    with pytest.raises(UserError, match="trained in another world .*: give --out FOLDER"):
        parse("teacher eval", [str(tmp_path), "--world.episode-steps", "25"]).run()
    assert (directory / teacher_trials.TRIALS_FILE).read_bytes() == before


def test_trials_of_an_older_world_are_shown():
    """pretrained/: `teacher eval` measured it before the world had all of today's settings."""
    rows = teacher_trials.load(PRETRAINED)
    assert [row["object"] for row in rows][-1] == "all" and len(rows) == 13


def test_what_a_teacher_was_trained_on_is_seen_whatever_the_paper_trains_on(tmp_path):
    config = Config(preset="mine", world=WorldConfig(objects=("lemon", "tower")))
    artifact = artifacts.finish(tmp_path, "teacher", config, seconds=1.0, metrics={})
    counts = {"lemon": (1, 2), "tower": (2, 2), "cube": (0, 3)}
    objects = {name: {"successes": k, "n": n} for name, (k, n) in counts.items()}
    result = {"success": {"successes": 3, "n": 7}, "objects": objects, "motion": []}
    summary = teacher_trials.summarise(result, artifact, WORLD, seed=0)
    assert (summary["seen"]["successes"], summary["seen"]["n"]) == (3, 4)
    assert (summary["unseen"]["successes"], summary["unseen"]["n"]) == (0, 3)
    assert summary["teacher"] == artifact.hash


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--world.objects", "cuba"], "Did you mean 'cube'"),
        (["--trials", "0"], "--trials is 0; expected at least 1."),
        (["--watched", "0"], "--watched is 0; expected at least 1."),
    ],
)
def test_wrong_options_get_one_line(options, message, capsys):
    assert cli.main(["teacher", "eval", str(PRETRAINED.parent), *options]) == 2
    error = capsys.readouterr().err.strip()
    assert message in error
    assert "\n" not in error
