"""Trials that are kept: a deployment's folder each, and the same trials as without."""

import errno
import json
import os
import signal
import socket
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest

from app.lerobot.source import open_source
from ddgrasp import policy_metadata as metadata
from ddgrasp.config import Config, PictureConfig, StudentConfig, WorldConfig
from ddgrasp.contract import D455
from ddgrasp.errors import Trouble, UserError
from ddgrasp.progress import Progress
from deploy.record import DeploymentRecord
from deploy.recorded import RecordedBench
from deploy.trial_log import TrialLog
from deploy.trials import Rig, Trial, TrialResult, run_trials
from deploy_support import write_policy
from evaluation import causes, rig_trials
from evaluation.report import deployments
from evaluation.rig_trials import Series
from sensors.recordings.recording import Recording
from sensors.recordings.writer import RecordingWriter

CONFIG = Config(
    preset="test",
    world=WorldConfig(objects=("cube", "apple"), camera_scale=0.125, episode_steps=4),
    student=StudentConfig(picture=PictureConfig(height_px=56, width_px=72)),
)


@pytest.fixture
def policy(tmp_path):
    """Lowers the arm by what the first pixel shows, so that what it sees is in what it does."""
    info = metadata.describe_run(CONFIG, project_version="0", student_manifest_hash="0")
    gain, bias = np.zeros((3, info.chunk, 8)), np.zeros((info.chunk, 8))
    gain[2, :, 1], bias[:, 7] = 1e-4, -1.0
    return write_policy(tmp_path / "policy.onnx", info, depth_gain=gain, bias=bias)


def test_a_recorded_trial_is_an_episode(tmp_path, policy):
    out, series = tmp_path / "out", Series("development", ("apple",), 1, seconds=0.4)
    rig_trials.run(CONFIG, policy, series, out, 0, Progress(quiet=True), record=True)
    (folder,) = (out / rig_trials.EPISODES).iterdir()
    report = json.loads((folder / "report.json").read_text())
    assert (report["steps"], report["frames"], report["object"]) == (4, 4, "apple")
    assert report["success"] is False and report["robot"] == "rig development"
    (read,) = open_source(out / rig_trials.EPISODES, ["apple"]).episodes
    episode = read()
    assert episode.task == "grasp the apple and lift it" and not episode.success
    corner_mm = [float(depth_mm[0, 0]) for depth_mm, _ in episode.pictures()]
    np.testing.assert_allclose(episode.action[:, 1], np.clip(np.multiply(corner_mm, 1e-4), -1, 1), rtol=1e-5)
    assert all(rgb.any() for _, rgb in episode.pictures())
    assert len(open_source(out).episodes) == 1  # the folder of the trials will do
    assert deployments.verdict(deployments.find(out / rig_trials.EPISODES)).startswith("Success 0.0 % of 1")


@pytest.mark.parametrize(
    ("how", "said"),
    [({"depth": "inpaint"}, "treated: inpaint"), ({"camera": "ideal"}, "clean, without a camera's errors")],
)
def test_depth_that_is_not_the_cameras_is_not_handed_on_as_raw(tmp_path, policy, how, said):
    series = Series("development", ("apple",), 1, seconds=0.4, **how)
    rig_trials.run(CONFIG, policy, series, tmp_path, 0, Progress(quiet=True), record=True)
    about = open_source(tmp_path / rig_trials.EPISODES).about["Camera"]
    assert said in about and "raw" not in about
    (folder,) = (tmp_path / rig_trials.EPISODES).iterdir()
    assert ("inpaint" in Recording.open(folder).meta["sensor"]) == ("depth" in how)


def test_recording_changes_nothing_in_a_trial(tmp_path, policy):
    trial = Trial(3, "cube")
    plain, _ = Rig(CONFIG, policy).run(trial)
    bench = RecordedBench(Rig, tmp_path / "kept", {"robot": "rig", "camera": "stereo"})(CONFIG, policy)
    states: dict[str, list] = {"first": [], "again": []}
    for name in states:
        kept, _ = bench.run(trial, lambda step, camera, name=name: states[name].append(step.state.vector()))
        assert (kept.steps, kept.success, kept.safety, kept.events) == (
            plain.steps, plain.success, plain.safety, plain.events,
        )  # fmt: skip
    bench.close()
    np.testing.assert_array_equal(states["first"], states["again"])
    recording = Recording.open(tmp_path / "kept" / "0003-cube")
    assert len(recording) == 4 and recording.consecutive and not recording.skipped


def test_a_recorded_trial_ends_when_its_watcher_says_so(tmp_path, policy):
    bench = RecordedBench(Rig, tmp_path / "kept", {"robot": "rig", "camera": "stereo"})(CONFIG, policy)
    result, _ = bench.run(Trial(3, "cube"), lambda step, camera: step.index == 1)
    bench.close()
    assert result.steps == len(Recording.open(tmp_path / "kept" / "0003-cube")) == 2


def test_what_a_trial_leaves_has_the_policy_s_focal_length_whatever_the_configuration_s_scale(
    tmp_path, policy
):
    other = replace(CONFIG, world=replace(CONFIG.world, camera_scale=0.5))
    bench = RecordedBench(lambda config, path: Rig(CONFIG, path), tmp_path / "kept", {"camera": "stereo"})
    bench(other, policy).run(Trial(3, "cube"), lambda step, camera: step.index == 1)
    kept = Recording.open(tmp_path / "kept" / "0003-cube")
    assert (kept.width_px, kept.fx_px) == (160, CONFIG.world.profile.fx_px)


def test_trials_that_were_not_recorded_are_not_passed_over(tmp_path, policy):
    out, quiet = tmp_path / "out", Progress(quiet=True)
    series = Series("development", ("apple",), 1, seconds=0.4)
    rig_trials.run(CONFIG, policy, series, out, 0, quiet)
    with pytest.raises(UserError, match="has trials that were not recorded"):
        rig_trials.run(CONFIG, policy, series, out, 0, quiet, record=True)
    rig_trials.run(CONFIG, policy, series, tmp_path / "new", 0, quiet, record=True)
    rig_trials.run(CONFIG, policy, series, tmp_path / "new", 0, quiet, record=True)
    page = deployments.write(tmp_path / "new", deployments.find(tmp_path / "new" / rig_trials.EPISODES))
    assert "0000-apple" in page.read_text()


@pytest.mark.parametrize("content", ["no onnx", None])
def test_what_is_no_policy_leaves_the_folder_to_the_right_one(tmp_path, policy, content):
    (wrong := tmp_path / "wrong.onnx").write_text(content or "")
    if content is None:
        wrong = write_policy(wrong, properties={"author": "someone"})
    out, quiet = tmp_path / "out", Progress(quiet=True)
    series = Series("development", ("apple",), 1, seconds=0.4)
    for run in (
        lambda: rig_trials.run(CONFIG, wrong, series, out, 0, quiet),
        lambda: causes.run(CONFIG, wrong, ("development",), series, out, 0),
    ):
        with pytest.raises(UserError, match=r"wrong\.onnx"):
            run()
    assert not out.exists()
    assert rig_trials.run(CONFIG, policy, series, out, 0, quiet)["all"]["n"] == 1


def test_a_log_belongs_to_whose_trial_ended_first(tmp_path):
    path = tmp_path / "trials.jsonl"
    path.write_text('{"rig": "of a version that began a log before any trial"}\n')
    fr3, development = TrialLog(path, {"rig": "fr3"}), TrialLog(path, {"rig": "development"})
    result = TrialResult(0, "cube", False, True, 1, 0, 0, {}, [], [], [], [], [], [])
    fr3.append(result)
    with pytest.raises(UserError, match="begun otherwise: rig is 'fr3' there"):
        development.append(result)
    assert TrialLog(path, {"rig": "fr3"}).results == {(0, False): result}


@pytest.mark.parametrize(
    ("series", "message"),
    [
        (Series("development", trials=1001), "--trials is 1001: an object has 1000 places"),
        (Series("development", contact=7.0), "--contact is rig fr3's"),
        (Series("development", camera="coarse"), "are rig fr3's"),
    ],
)
def test_what_a_rig_does_not_have_is_one_line(series, message):
    with pytest.raises(UserError, match=message):
        series.names()


def killed(config, policy_path):
    """A bench that the kernel ends."""
    os.kill(os.getpid(), signal.SIGKILL)


def test_a_worker_that_is_killed_is_one_line():
    with pytest.raises(UserError, match="a worker was killed"):
        list(run_trials(CONFIG, Path("policy.onnx"), [Trial(0, "apple")], 1, killed))


STAYS = """
import os, socket, time
from pathlib import Path
from ddgrasp.config import Config
from deploy.trials import Trial, run_trials

def stays(config, policy_path):
    with socket.create_connection(("127.0.0.1", int(policy_path.name))) as told:
        told.sendall(f"{os.getpid()} {os.getppid()}".encode())
        time.sleep(60)

if __name__ == "__main__":
    list(run_trials(Config("test"), Path("PORT"), [Trial(0, "apple")], 1, stays))
"""


def test_a_worker_goes_when_its_parent_was_killed(tmp_path):
    """A connection that it keeps open ends with it."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.settimeout(60)
        script = tmp_path / "stays.py"
        script.write_text(STAYS.replace("PORT", str(server.getsockname()[1])))
        env = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[1])}
        parent = subprocess.Popen([sys.executable, script], env=env)
        try:
            worker, _ = server.accept()
            pid, of = map(int, worker.recv(100).split())
            assert of == parent.pid
        finally:
            parent.kill()
            parent.wait()
    with worker:
        worker.settimeout(20)
        try:
            assert worker.recv(1) == b""
        except TimeoutError:
            os.kill(pid, signal.SIGKILL)
            raise


def test_a_trial_whose_pictures_do_not_fit_is_not_logged_and_runs_again(tmp_path, policy, monkeypatch):
    out, series = tmp_path / "out", Series("development", ("apple",), 1, seconds=0.4)
    with monkeypatch.context() as full:
        full.setattr(
            RecordingWriter, "add", Mock(side_effect=OSError(errno.ENOSPC, os.strerror(errno.ENOSPC)))
        )
        with pytest.raises(Trouble, match="pictures are not kept .*No space left.*: give the command again"):
            rig_trials.run(CONFIG, policy, series, out, 0, Progress(quiet=True), record=True)
    rig_trials.run(CONFIG, policy, series, out, 0, Progress(quiet=True), record=True)
    (folder,) = (out / rig_trials.EPISODES).iterdir()
    assert json.loads((folder / "report.json").read_text())["frames"] == 4


def test_the_report_of_an_attempt_before_goes_with_the_first_step(tmp_path):
    folder = tmp_path / "0001-apple"
    folder.mkdir()
    (folder / "report.json").write_text("{}")
    record = DeploymentRecord(Mock(), D455, "rig", 1)
    with record.into(folder):
        pass
    assert not (folder / "report.json").exists()
