"""Trials in the development rig, their log on disk, and the deploy stage that resumes from it."""

import dataclasses
import gc
import json
import os
import signal
import threading
import time
import weakref
from pathlib import Path

import numpy as np
import pytest

from app import pipeline
from app.commands.student import config_of
from ddgrasp import artifacts, contract
from ddgrasp import policy_metadata as metadata
from ddgrasp.config import (
    Config,
    DeployConfig,
    EvalConfig,
    PictureConfig,
    RandomConfig,
    StudentConfig,
    WorldConfig,
)
from ddgrasp.errors import UserError
from ddgrasp.layout import QPOS
from ddgrasp.progress import Progress
from ddgrasp.shipped import PRETRAINED
from ddgrasp.signals import held_back
from deploy import stage, trial_log
from deploy import trials as rig_eval
from deploy.clock import SimClock
from deploy.devices.rig_robot import SimRobot
from deploy.stage import TrialLog, metrics
from deploy.trials import Trial, TrialResult, keep_results, plan, run_trials, tried
from deploy_support import write_policy
from evaluation.rig_trials import Series
from job_support import make_job
from mjx_envs.camera import nominal_camera
from rig.camera import camera_pose

CONFIG = Config(
    preset="test",
    world=WorldConfig(objects=("cube", "apple"), camera_scale=0.125, episode_steps=4),
    student=StudentConfig(picture=PictureConfig(height_px=56, width_px=72)),
    deploy=DeployConfig(realtime_trials=1, film_every=2, workers=2),
    evaluation=EvalConfig(rig_trials=3),
)


def result(
    index: int = 0, object_name: str = "cube", realtime: bool = False, success: bool = True, **changes
):
    """A finished trial of two steps."""
    values = TrialResult(
        index, object_name, realtime, success, steps=2, holds=0, missed_deadlines=0,
        safety={"commands": 2, "workspace": 1}, events=[], sense_s=[0.03, 0.03], infer_s=[0.01, 0.01],
        act_s=[0.001, 0.001], latency_s=[0.011, 0.011], period_s=[0.1],
    )  # fmt: skip
    return dataclasses.replace(values, **changes)


@pytest.fixture
def policy(tmp_path) -> Path:
    """Lowers the arm slowly; says nothing about success."""
    info = metadata.describe_run(CONFIG, project_version="0", student_manifest_hash="0")
    bias = np.zeros((info.chunk, 8))
    bias[:, 1], bias[:, 7] = 0.2, -1.0
    return write_policy(tmp_path / "policy.onnx", info, bias=bias)


@pytest.fixture
def run_dir(tmp_path, policy) -> Path:
    """A run whose export stage is finished."""
    run = tmp_path / "run"
    export = run / "export"
    export.mkdir(parents=True)
    (export / stage.POLICY_FILE).write_bytes(policy.read_bytes())
    artifacts.finish(export, "export", CONFIG, seconds=0.0, metrics={})
    return run


def run_stage(run_dir: Path, resume: bool = False) -> artifacts.Artifact:
    progress = Progress(run_dir / "deploy", "deploy", quiet=True)
    try:
        return stage.run(make_job("deploy", CONFIG, run_dir / "deploy", progress))
    finally:
        progress.close()


# --- the log -------------------------------------------------------------------------------------


def test_log_returns_what_was_appended(tmp_path):
    path, header = tmp_path / "trials.jsonl", {"policy_sha256": "a", "config_hash": "b"}
    log = TrialLog(path, header)
    log.append(result(0))
    log.append(result(0, realtime=True))
    again = TrialLog(path, header)
    assert again.results == {(0, False): result(0), (0, True): result(0, realtime=True)}


def test_torn_last_line_is_dropped_and_the_next_one_is_whole(tmp_path):
    path, header = tmp_path / "trials.jsonl", {"policy_sha256": "a"}
    log = TrialLog(path, header)
    log.append(result(0))
    log.append(result(1))
    path.write_bytes(path.read_bytes()[:-20])
    torn = TrialLog(path, header)
    assert list(torn.results) == [(0, False)]
    torn.append(result(2))
    assert list(TrialLog(path, header).results) == [(0, False), (2, False)]
    assert all(json.loads(line) for line in path.read_text().splitlines())


def test_a_line_damaged_before_the_last_is_named_and_costs_none_behind_it(tmp_path):
    path, header = tmp_path / "trials.jsonl", {"policy_sha256": "a"}
    log = TrialLog(path, header)
    for index in range(3):
        log.append(result(index))
    lines = path.read_text().splitlines()
    lines[2] = lines[2][:-20]
    path.write_text("\n".join(lines) + "\n")
    before = path.read_bytes()
    with pytest.raises(UserError, match="line 3 of 4 is damaged"):
        TrialLog(path, header)
    assert path.read_bytes() == before


def test_trials_of_another_policy_are_refused_and_kept(tmp_path):
    path = tmp_path / "trials.jsonl"
    TrialLog(path, {"policy_sha256": "a"}).append(result(0))
    before = path.read_bytes()
    said = "begun otherwise: policy_sha256 is 'a' there, 'b' here. Choose another --out, or .* and its 1 tr"
    with pytest.raises(UserError, match=said):
        TrialLog(path, {"policy_sha256": "b"})
    assert path.read_bytes() == before


def test_metrics_count_success_by_object_and_time_on_the_real_clock_alone():
    results = [
        result(0, "cube", success=True),
        result(1, "apple", success=False, infer_s=[9.0, 9.0], latency_s=[9.0, 9.0]),
        result(2, "cube", success=False),
        result(0, "cube", realtime=True, success=True, period_s=[0.1, 0.102], missed_deadlines=3),
    ]
    values = metrics(results, ["cube"])
    assert values["student_rig"]["success"] == {"successes": 1, "n": 3}
    assert values["student_rig"]["seen"] == {"successes": 1, "n": 2}
    assert values["student_rig"]["unseen"] == {"successes": 0, "n": 1}
    assert values["student_rig"]["per_object"] == {
        "apple": {"successes": 0, "n": 1},
        "cube": {"successes": 1, "n": 2},
    }
    assert values["latency_ms"] == {"p50": 11.0, "p99": 11.0}
    assert values["missed_deadlines"] == 3
    assert values["jitter_ms"]["max"] == pytest.approx(2.0)
    assert values["safety"] == {"commands": 6, "workspace": 3}


def test_plan_mixes_objects_and_keeps_real_time_apart():
    assert tried(CONFIG).world.objects == (*CONFIG.world.objects, *contract.UNSEEN_OBJECTS)
    trials = plan(CONFIG)
    assert [(t.index, t.object_name, t.realtime) for t in trials] == [
        (0, "cube", False), (1, "apple", False), (2, "cube", False), (0, "cube", True),
    ]  # fmt: skip


# --- the rig -------------------------------------------------------------------------------------


def test_camera_stands_within_the_calibration_error():
    nominal = nominal_camera(CONFIG.world.profile).T_world_cam
    spread = CONFIG.world.random
    for seed in range(20):
        pose = camera_pose(CONFIG, np.random.default_rng(seed))
        assert np.abs(pose[:3, 3] - nominal[:3, 3]).max() <= spread.camera_position_m
        turn = pose[:3, :3] @ nominal[:3, :3].T
        angle = np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1))
        assert 0 < angle <= np.sqrt(3) * spread.camera_angle_rad + 1e-9
        np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-12)


def test_sim_robot_moves_one_period_per_period_and_holds_where_it_is():
    from rig.world import RigWorld

    quiet = RandomConfig(friction_nm=0.0, joint_rad=0.0)
    world, clock = RigWorld(objects=("cube",), random=quiet), SimClock()
    world.reset(0, "cube")
    robot = SimRobot(world, clock)
    robot.start()
    start_s, q0 = world.data.time, robot.read_state().q_rad
    assert world.data.time == start_s, "no time has passed on the clock"
    robot.command(q0 + [0.1, 0, 0, 0, 0, 0, 0], False)
    clock.sleep_until(0.1)
    state = robot.read_state()
    assert world.data.time - start_s == pytest.approx(0.1) and state.timestamp_s == pytest.approx(0.1)
    assert 0.01 < state.q_rad[0] - q0[0] < 0.11
    clock.sleep_until(0.35)  # a step that missed two deadlines
    assert robot.read_state().timestamp_s == pytest.approx(0.3)
    assert world.data.time - start_s == pytest.approx(0.3)
    robot.hold()
    held = robot.read_state().q_rad
    clock.sleep_until(1.0)
    robot.hold()
    assert np.abs(robot.read_state().q_rad - held).max() < 0.02
    assert state.width_m == pytest.approx(contract.GRIPPER_MAX_WIDTH_M, abs=2e-3)


def test_trial_is_repeatable_and_fits_the_loop(policy):
    trial = Trial(1, "apple")
    (first, film), (again, _) = (next(run_trials(CONFIG, policy, [trial], 0)) for _ in range(2))
    outcome = ("success", "steps", "holds", "safety", "events", "object_pos_m")
    assert [getattr(first, n) for n in outcome] == [getattr(again, n) for n in outcome]
    assert first.steps == first.safety["commands"] == 4 and first.holds == 0
    assert film.steps == (0, 2)
    assert film.rgb.shape == (2, 90, 160, 3) and film.depth_mm.shape == (2, 90, 160)
    seen = film.depth_mm[film.depth_mm > 0]
    assert 0.5 < np.median(seen) / 1000 < 1.5 and len(seen) > 0.5 * film.depth_mm.size


def test_a_trial_ends_with_success():
    """The student under pretrained/: the apple is up long before the time is over."""
    student = PRETRAINED / "student" / "policy.onnx"
    series = Series("development", ("apple",), trials=1)
    rig = series.make(CONFIG)(series.configured(config_of(student, None), student), student)
    ended, _ = rig.run(series.trial("apple", 0))
    assert ended.success and 20 < ended.steps < 0.75 * contract.TRIAL_S * contract.CONTROL_HZ
    height_m = np.array(ended.object_pos_m)[:, 2]
    assert len(height_m) == ended.steps and height_m[0] < 0.05
    assert height_m[-1] == pytest.approx(contract.LIFT_TARGET_M[2], abs=contract.LIFT_TOLERANCE_M)


def test_a_file_says_before_which_camera_a_policy_is_tried(tmp_path):
    student, file = PRETRAINED / "student" / "policy.onnx", tmp_path / "bright.yaml"
    file.write_text("preset: demo\nrecord:\n  other_tables: true\n  stereo: {exposure_target: 0.7}\n")
    config = config_of(student, None, file)
    assert config.record.other_tables and config.record.stereo.exposure_target == 0.7
    assert not config_of(student, None).record.other_tables


def test_what_ends_a_trial_with_success_has_one_whatever_the_last_command_does(policy):
    config = dataclasses.replace(CONFIG, world=dataclasses.replace(CONFIG.world, episode_steps=20))

    def lifted(step, camera) -> None:
        """The object is near where it is to be lifted to as long as it takes, then gone."""
        _, data = camera.scene()
        off_m = (0.0, 0.0, 0.03) if step.index < contract.HOLD_STEPS else (0.0, 0.3, 0.0)
        data.qpos[QPOS.object_pos] = np.array(contract.LIFT_TARGET_M) + off_m
        data.qvel[:] = 0.0

    bench = rig_eval.Rig(config, policy)
    made, _ = bench.run(Trial(0, "cube"), lifted)
    assert made.success and made.steps == contract.HOLD_STEPS + 1
    bench.run(Trial(0, "cube"), lambda step, camera: lifted(step, camera) or step.index == 3)
    assert not bench.run(Trial(0, "cube"))[0].success  # the one before says nothing about this one


class LosesFirst:
    """The bench on which trial 0 cannot be tried while others run."""

    def __init__(self, config: Config, policy: Path):
        pass

    def run(self, trial: Trial) -> tuple[TrialResult, None]:
        time.sleep(0.5 if trial.index == 0 else 1.0)
        if trial.index == 0:
            raise UserError("the rig has gone")
        return result(trial.index), None

    def close(self) -> None:
        """Nothing to close."""


def test_a_trial_that_cannot_be_tried_costs_none_that_ran_beside_it(tmp_path):
    trials, made = [Trial(index, "apple") for index in range(4)], []
    with pytest.raises(UserError, match="the rig has gone"):
        for tried_one, _ in run_trials(CONFIG, tmp_path, trials, 2, LosesFirst):
            made.append(tried_one.index)
    assert 1 in made and 0 not in made


class SaysWhenItRuns:
    """A bench whose trials take a second and leave a file as they begin."""

    def __init__(self, config: Config, folder: Path):
        self._folder = folder

    def run(self, trial: Trial) -> tuple[TrialResult, np.ndarray]:
        (self._folder / f"begun-{trial.index}").touch()
        time.sleep(1.0)
        return result(trial.index), np.zeros(1000)

    def close(self) -> None:
        """Nothing to close."""


def test_ctrl_c_costs_no_trial_that_runs(tmp_path, ctrl_c):
    """In a stage, whose interrupt comes again and again until it has surfaced."""

    def interrupt() -> None:
        while len(list(tmp_path.glob("begun-*"))) < 2:
            time.sleep(0.01)
        os.kill(os.getpid(), signal.SIGINT)

    trials, made = [Trial(i, "apple") for i in range(6)], []
    threading.Thread(target=interrupt).start()
    with pytest.raises(KeyboardInterrupt), pipeline._interruptible("deploy"):
        for tried_one, _ in run_trials(CONFIG, tmp_path, trials, 2, SaysWhenItRuns):
            made.append(tried_one.index)
            time.sleep(1.0)  # as long as a log and a film take
    assert {0, 1} <= {*made} and len(made) < 6  # one more may wait in the workers' queue


class LosesItsTerminal(SaysWhenItRuns):
    """A bench whose worker is told, as its parent is, that the terminal has closed."""

    def run(self, trial: Trial) -> tuple[TrialResult, np.ndarray]:
        os.kill(os.getpid(), signal.SIGHUP)
        return super().run(trial)


def test_a_terminal_that_closes_costs_no_trial_that_runs(tmp_path):
    ((tried_one, _),) = run_trials(CONFIG, tmp_path, [Trial(3, "apple")], 1, LosesItsTerminal)
    assert tried_one.index == 3


class SaysWhatItIsSpared:
    """A bench that leaves the signals that its process was spared before anything was imported there."""

    def __init__(self, config: Config, folder: Path):
        (folder / "spared").write_text(str(signal.pthread_sigmask(signal.SIG_BLOCK, ())))

    def run(self, trial: Trial) -> tuple[TrialResult, None]:
        return result(trial.index), None

    def close(self) -> None:
        """Nothing to close."""


def test_ctrl_c_is_not_for_workers_even_while_they_start(tmp_path):
    """Their modules take seconds to import, and would end in a traceback each."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, ())
    assert list(run_trials(CONFIG, tmp_path, [Trial(0, "apple")], 1, SaysWhatItIsSpared))
    spared = (tmp_path / "spared").read_text()
    assert "SIGINT" in spared and "SIGHUP" in spared and "SIGTERM" not in spared
    assert signal.pthread_sigmask(signal.SIG_BLOCK, ()) == before


def test_ctrl_c_while_workers_start_is_not_lost(ctrl_c):
    with pytest.raises(KeyboardInterrupt), held_back(signal.SIGINT):
        os.kill(os.getpid(), signal.SIGINT)


def test_ctrl_c_while_one_is_kept_costs_no_trial_that_runs(tmp_path, ctrl_c):
    trials, kept = [Trial(i, "apple") for i in range(12)], []

    def keep(tried_one: TrialResult, film: object) -> None:
        kept.append(tried_one.index)
        if len(kept) == 1:
            os.kill(os.getpid(), signal.SIGINT)

    with pytest.raises(KeyboardInterrupt), pipeline._interruptible("deploy"):
        keep_results(run_trials(CONFIG, tmp_path, trials, 2, SaysWhenItRuns), keep)
    assert sorted(kept) == [int(path.name.split("-")[1]) for path in sorted(tmp_path.glob("begun-*"))]
    assert len(kept) < 12


def test_a_film_lives_no_longer_than_who_takes_it_wants(tmp_path):
    films = []
    for _, film in run_trials(CONFIG, tmp_path, [Trial(i, "apple") for i in range(3)], 1, SaysWhenItRuns):
        films.append(weakref.ref(film))
        del film
        gc.collect()
        assert all(kept() is None for kept in films[:-1])
    assert len(films) == 3


def test_stage_resumes_without_redoing_trials(run_dir, monkeypatch):
    ran, how = [], []
    real = stage.run_trials

    def counted(config, policy_path, trials, workers):
        ran.append([(t.index, t.realtime) for t in trials])
        how.append((config.world.episode_steps, workers))
        for count, outcome in enumerate(real(config, policy_path, trials, workers)):
            yield outcome
            if len(ran) == 1 and count == 1:
                raise KeyboardInterrupt

    monkeypatch.setattr(stage, "run_trials", counted)
    with pytest.raises(KeyboardInterrupt):
        run_stage(run_dir)
    done = set(
        TrialLog(
            run_dir / "deploy" / stage.TRIALS_FILE,
            stage._header(CONFIG, run_dir / "export" / stage.POLICY_FILE),
        ).results
    )
    assert len(done) == 2 and not artifacts.is_finished(run_dir / "deploy")
    artifact = run_stage(run_dir, resume=True)
    assert {*ran[1], *ran[2]} == {(0, False), (1, False), (2, False), (0, True)} - done
    # 12 s on the simulated clock; on the real one as long as an episode, with the machine to itself.
    assert how[1:] == [(120, CONFIG.deploy.workers), (CONFIG.world.episode_steps, 1)]
    values = artifact.manifest.metrics
    assert values["student_rig"]["success"]["n"] == 3
    assert values["latency_ms"]["p50"] > 0 and values["jitter_ms"]["p50"] is not None
    outcome = "rig_success" if values["student_rig"]["success"]["successes"] else "rig_failure"
    assert (run_dir / "deploy" / f"{outcome}.png").read_bytes()[:4] == b"\x89PNG"
    assert artifact.manifest.parents.keys() == {"export"}


def test_loop_moves_the_arm_as_the_training_environment_does(policy):
    from rig.stage import act
    from rig.world import RigWorld

    world = RigWorld(objects=("apple",))
    trial = Trial(1, "apple")
    rng = np.random.default_rng([CONFIG.seed, rig_eval._STREAM, trial.index])
    world.reset(int(rng.integers(2**31)), trial.object_name)
    for _ in range(CONFIG.world.episode_steps):
        act(world, np.array([0, 0.2, 0, 0, 0, 0, 0, -1.0], np.float32))
    rig = rig_eval.Rig(CONFIG, policy)
    rig.run(trial)
    np.testing.assert_allclose(rig._world.data.qpos, world.data.qpos, atol=1e-6)


@pytest.mark.parametrize("close", [True, False])
def test_a_sim_robot_that_holds_keeps_what_its_gripper_does(close):
    from rig.world import RigWorld

    world, clock = RigWorld(objects=("cube",)), SimClock()
    world.reset(0, "cube")
    robot = SimRobot(world, clock)
    robot.start()
    robot.command(robot.read_state().q_rad, close)
    robot.hold()
    clock.sleep_until(1.0)
    assert (robot.read_state().width_m < 0.01) == close


def test_a_log_whose_first_write_is_interrupted_begins_with_its_header_all_the_same(tmp_path, monkeypatch):
    path, header = tmp_path / "trials.jsonl", {"policy_sha256": "a"}
    log, write = TrialLog(path, header), trial_log.atomic_write_text

    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(trial_log, "atomic_write_text", interrupted)
    with pytest.raises(KeyboardInterrupt):
        log.append(result(0))
    monkeypatch.setattr(trial_log, "atomic_write_text", write)
    for index in (1, 2):
        log.append(result(index))
    assert {key[0] for key in TrialLog(path, header).results} == {1, 2}
