"""Watching a policy: films that OpenCV reads back, Rerun's absence, the command at its shortest."""

import os
import socket
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import numpy as np
import pytest

from app.commands import parse, play
from ddgrasp import artifacts, contract
from ddgrasp.errors import UserError
from ddgrasp.policy_metadata import POLICY_FILE
from ddgrasp.shipped import PRETRAINED
from deploy import viewers
from deploy.devices.rig_camera import StereoCamera
from deploy.interfaces import Frame, RobotState
from deploy.loop_report import Step
from deploy.policy import OnnxPolicy
from deploy.video import ANIMATION_PANEL_PX, FAR_MM, NEAR_MM, PANEL_PX, VERDICT_S, Video, depth_picture
from deploy.viewers import MujocoWindow, Rerun
from rig.film import INVALID_RGB

STUDENT = PRETRAINED / "student"

HEIGHT, WIDTH = 90, 160


class _RedCamera:
    def picture(self) -> np.ndarray:
        return np.full((HEIGHT, WIDTH, 3), (200, 0, 0), np.uint8)


def _step(index: int, depth_mm: int) -> Step:
    frame = Frame(np.full((HEIGHT, WIDTH), depth_mm, np.uint16), 0.1 * index)
    return Step(index, frame, RobotState(np.zeros(7), 0.08, 0.1 * index), None, None)


def _frames(path) -> np.ndarray:
    import cv2

    film, frames = cv2.VideoCapture(str(path)), []
    while (read := film.read())[0]:
        frames.append(read[1][..., ::-1])
    assert film.get(cv2.CAP_PROP_FPS) == contract.CONTROL_HZ
    return np.stack(frames)


@pytest.mark.parametrize("name", ["film.mp4", "film.webm"])
def test_a_film_has_colour_beside_depth_and_stays_at_the_verdict(tmp_path, name):
    video = Video(tmp_path / name)
    video.begin("apple")
    for i in range(3):
        video.look(_step(i, 0), _RedCamera())
    assert not (tmp_path / name).exists()
    video.end("lifted and held")
    video.close()
    frames = _frames(tmp_path / name)
    assert len(frames) == 3 + round(VERDICT_S * contract.CONTROL_HZ)
    assert frames.shape[2] == 2 * PANEL_PX
    below = frames[0, 100:300]
    np.testing.assert_allclose(below[:, 50 : -PANEL_PX - 50].mean((0, 1)), (200, 0, 0), atol=12)
    np.testing.assert_allclose(below[:, PANEL_PX + 50 : -50].mean((0, 1)), INVALID_RGB, atol=12)


@pytest.mark.parametrize("name", ["film.mp4", "film.webp"])
def test_a_film_that_was_broken_off_leaves_the_one_before(tmp_path, name):
    (tmp_path / name).write_bytes(b"before")
    video = Video(tmp_path / name)
    video.begin("apple")
    video.look(_step(0, 700), _RedCamera())
    video.close(whole=False)
    assert (tmp_path / name).read_bytes() == b"before" and len(list(tmp_path.iterdir())) == 1


_ON_A_FULL_DISK = """
import resource, signal, sys
from pathlib import Path
import numpy as np
from deploy import video
Encoder = video._Animation if sys.argv[1].endswith(video.ANIMATION) else video._Codec
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, 100_000))
film, rng = Encoder(Path(sys.argv[1]), 640, 360), np.random.default_rng(0)
for _ in range(30):
    film.write(rng.integers(0, 255, (360, 640, 3)).astype(np.uint8))
try:
    film.close(whole=True)
except OSError as error:
    print(error)
"""


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("film.mp4", "of 30 pictures were written: is the disk full?"),
        ("film.webm", "of 30 pictures were written: is the disk full?"),
        ("film.webp", "File too large"),
    ],
)
def test_a_film_that_a_full_disk_cut_leaves_the_one_before(tmp_path, name, said):
    (tmp_path / name).write_bytes(b"before")
    run = subprocess.run(
        [sys.executable, "-c", _ON_A_FULL_DISK, str(tmp_path / name)], capture_output=True, text=True
    )
    assert run.returncode == 0 and said in run.stdout, run
    assert (tmp_path / name).read_bytes() == b"before" and len(list(tmp_path.iterdir())) == 1


class _Simulated(_RedCamera):
    def clean_mm(self) -> np.ndarray:
        return np.full((HEIGHT, WIDTH), 500, np.uint16)


@pytest.mark.parametrize(("camera", "panels"), [(_RedCamera(), 2), (_Simulated(), 3)])
def test_a_generator_s_depth_is_shown_where_clean_depth_is_known(tmp_path, camera, panels):
    video = Video(tmp_path / "film.mp4", lambda clean_mm: np.where(clean_mm == 500, 0, 1).astype("uint16"))
    video.begin("apple")
    video.look(_step(0, 700), camera)
    video.close()
    frame = _frames(tmp_path / "film.mp4")[0]
    assert frame.shape[1] == panels * PANEL_PX
    last = frame[100:300, -PANEL_PX + 200 : -50].mean((0, 1))
    assert (np.abs(last - INVALID_RGB).max() < 12) == (panels == 3)


def test_a_moving_picture_for_pages_keeps_every_step(tmp_path):
    import cv2

    video = Video(tmp_path / "film.webp")
    video.begin("apple")
    for i in range(3):
        video.look(_step(i, 400 + 300 * i), _RedCamera())
    video.close()
    ok, film = cv2.imreadanimation(str(tmp_path / "film.webp"))
    assert ok and len(film.frames) == 3 and film.loop_count == 0
    assert [int(duration) for duration in film.durations] == [100] * 3
    assert film.frames[0].shape[1] == 2 * ANIMATION_PANEL_PX
    centres = [frame[100, 3 * ANIMATION_PANEL_PX // 2, :3].astype(int) for frame in film.frames]
    assert np.abs(centres[0] - centres[2]).max() > 50


def test_a_step_without_a_frame_is_left_out(tmp_path):
    video = Video(tmp_path / "film.mp4")
    video.begin("apple")
    video.look(Step(0, None, RobotState(np.zeros(7), 0.08, 0.0), None, None), _RedCamera())
    video.end("failed")
    video.close()
    assert list(tmp_path.iterdir()) == []


def test_depth_has_one_colour_scale_for_all_frames():
    near, far = (depth_picture(np.full((4, 4), value, np.uint16)) for value in (int(NEAR_MM), int(FAR_MM)))
    assert near.mean() > far.mean() + 50
    metres = np.full((4, 4), NEAR_MM / 1000, np.float32)
    np.testing.assert_array_equal(depth_picture(metres), near)


def test_another_ending_is_refused_before_anything_runs(tmp_path):
    with pytest.raises(UserError, match="ends with .mp4 or .webm or .webp"):
        Video(tmp_path / "film.avi")


def test_a_recording_of_rerun_s_takes_its_name_once_it_shows_something(tmp_path, monkeypatch):
    file = tmp_path / "a.rrd"
    file.write_bytes(b"before")
    stand_in = Mock(save=lambda path: Path(path).write_bytes(b"new"))
    monkeypatch.setitem(sys.modules, "rerun", stand_in)
    monkeypatch.setitem(sys.modules, "rerun.blueprint", stand_in)
    Rerun(browser=False, file=file).close(whole=False)  # as where the policy turned out to be absent
    assert file.read_bytes() == b"before" and [path.name for path in tmp_path.iterdir()] == ["a.rrd"]
    shown = Rerun(browser=False, file=file)
    shown.look(_step(0, 700), _RedCamera())
    shown.close(whole=False)
    assert file.read_bytes() == b"new" and [path.name for path in tmp_path.iterdir()] == ["a.rrd"]


def test_without_rerun_the_remedy_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(UserError, match=r"pip install 'ddgrasp\[view\]'"):
        Rerun(browser=True)


def test_a_port_that_somebody_has_is_not_taken():
    with socket.socket() as taken:
        taken.bind(("", 0))
        port = taken.getsockname()[1]
        assert viewers._free_port(port) != port
    assert viewers._free_port(port) == port


def test_the_pretrained_onnx_file_is_its_students():
    policy = OnnxPolicy(STUDENT / POLICY_FILE)
    again = "pretrained/student was replaced: python -m export.pretrained"
    assert policy.info.student_manifest_hash == artifacts.read_artifact(STUDENT).hash, again


def test_the_command_plays_the_pretrained_student_into_a_film(tmp_path, capsys):
    film = tmp_path / "play.mp4"
    parse("play", ["--object", "cube", "--noise", "none", "--seconds", "1", "--out", str(film)]).run()
    assert "0 of 1 lifted and held" in capsys.readouterr().out
    assert len(_frames(film)) == 10 + round(VERDICT_S * contract.CONTROL_HZ)


def test_the_pretrained_generator_s_depth_stands_beside_the_camera_s(tmp_path):
    film, generator = tmp_path / "play.mp4", tmp_path / "run"
    generator.mkdir()
    (generator / "ddg").symlink_to(STUDENT.parent / "ddg")
    options = ["--objects", "cube", "--seconds", "0.5", "--generator", str(generator), "--out", str(film)]
    parse("play", options).run()
    learned = _frames(film)[0, 100:300, -PANEL_PX:].astype(int)
    lost = (np.abs(learned - INVALID_RGB).max(-1) < 60).mean()
    assert 0.01 < lost < 0.3


def test_a_generator_that_is_not_there_is_refused_before_anything_runs(tmp_path):
    for folder, trouble in ((tmp_path / "nothing", "does not exist"), (STUDENT, "is of stage 'student'")):
        with pytest.raises(UserError, match=f"--generator is {folder}, which {trouble}: give a run that has"):
            parse("play", ["--generator", str(folder), "--out", str(tmp_path / "a.mp4")]).run()
    assert list(tmp_path.iterdir()) == []


def test_an_unknown_object_is_refused_and_leaves_nothing(tmp_path):
    with pytest.raises(UserError, match="appel"):
        parse("play", ["--objects", "appel", "--out", str(tmp_path / "play.mp4")]).run()
    assert list(tmp_path.iterdir()) == []


@pytest.mark.skipif(not os.environ.get("DISPLAY"), reason="no display: MuJoCo's window needs one")
def test_mujoco_s_window_shows_the_rig_until_it_is_closed():
    from rig.world import RigWorld

    world = RigWorld(("cube",))
    world.reset(0, "cube")
    camera = StereoCamera(world, None, np.eye(4), np.random.default_rng(0), lambda: 0.0)
    window = MujocoWindow()
    started = time.monotonic()
    for i in range(4):
        window.look(_step(i, 500), camera)
    assert window.watched() and time.monotonic() - started > 0.25
    window.close()
    while window.watched():
        assert time.monotonic() - started < 30
    window.look(_step(5, 500), camera)


@pytest.mark.skipif(not os.environ.get("DISPLAY"), reason="no display: MuJoCo's window needs one")
def test_a_camera_without_a_scene_has_no_window():
    with pytest.raises(UserError, match="shows rigs alone"):
        MujocoWindow().look(_step(0, 500), _RedCamera())


@pytest.mark.skipif(sys.platform != "linux", reason="displays with a number are X11's")
def test_a_display_that_is_not_there_is_named_before_the_policy_is_loaded():
    command = [sys.executable, "-m", "app.cli", "play", "--viewer", "mujoco"]
    environment = os.environ | {"DISPLAY": ":9731"}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, cwd=STUDENT.parents[1])
    assert done.returncode == 2
    assert done.stderr.strip().splitlines()[-1].endswith("on this display: choose web, or film.")


def test_without_a_display_a_window_is_refused_before_anything_runs(monkeypatch, tmp_path):
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    monkeypatch.setattr(sys, "platform", "linux")
    with pytest.raises(UserError, match="--viewer mujoco: there is no display"):
        parse("play", ["--viewer", "mujoco"]).run()


@pytest.mark.parametrize(
    ("terminal", "display", "rerun", "options", "chosen"),
    [
        (True, True, True, [], "mujoco"),
        (True, False, True, [], "web"),
        (True, False, False, [], "film"),
        (False, True, True, [], "film"),
        (True, True, True, ["--out", "a.mp4"], "film"),
        (True, True, True, ["--generator", "pretrained/ddg"], "film"),
        (True, True, True, ["--generator", "pretrained/ddg", "--noise", "generator"], "mujoco"),
    ],
)
def test_the_viewer_is_what_the_place_has(monkeypatch, terminal, display, rerun, options, chosen):
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.setattr(sys, "stdin", SimpleNamespace(isatty=lambda: terminal))
    monkeypatch.setattr(play, "find_spec", lambda name: name if rerun else None)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    monkeypatch.setenv("DISPLAY", ":0" if display else "")
    assert play._chosen(parse("play", options)._wants_film) == chosen
