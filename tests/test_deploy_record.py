"""What a deployment leaves: a recording that the generator can be fitted to, steps, report, film, verdict."""

import hashlib
import json
import os
import signal
import threading
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from app.commands import parse
from ddgrasp import contract
from ddgrasp.errors import UserError
from ddgrasp.presets import get_preset
from deploy import interrupts, session
from deploy.devices.options import SessionOptions
from deploy.devices.replay_camera import ReplayCamera
from deploy.interfaces import CameraError, Frame, RobotError
from deploy_support import KinematicRobot, constant_bias, describe, write_policy
from evaluation.report import deployments
from recording_support import flat, write_depth
from sensors.recordings import writer as writing
from sensors.recordings.recording import Recording, find_recordings
from sensors.recordings.writer import RecordingWriter

DEPTH_MM = np.full((180, 320), 700, np.uint16)
DEPTH_MM[:20] = 0


class ColourCamera:
    """Depth and colour of an unchanging scene, as a RealSense gives both."""

    def __init__(self, clock, fails_at=None):
        self._clock, self._fails_at, self._reads = clock, fails_at, 0

    def start(self):
        pass

    def read(self):
        self._reads += 1
        if self._reads == self._fails_at:
            raise KeyboardInterrupt
        rgb = np.full((480, 848, 3), self._reads, np.uint8)
        return Frame(DEPTH_MM + np.uint16(self._reads), self._clock.now(), rgb)

    def stop(self):
        pass


CONFIG = get_preset("debug")


@pytest.fixture
def run(tmp_path, monkeypatch):
    """Deploys a policy that bends joint 1, before a camera; (report, the folder it left, None if none)."""
    policy = write_policy(
        tmp_path / "p.onnx", describe(profile=contract.D455.scaled(0.25)), bias=constant_bias(0.2)
    )

    def deployed(
        camera=ColourCamera,
        say=lambda text: None,
        config=CONFIG,
        camera_name="stereo",
        **changes,
    ):
        monkeypatch.setattr(
            session, "make_devices", lambda setup: (KinematicRobot(setup.clock), camera(setup.clock))
        )
        options = SessionOptions(camera=camera_name, seconds=0.5, out=tmp_path / "kept")
        options = replace(options, **changes)
        before = set(options.out.glob("*"))
        report = session.deploy(config, policy, options, say)
        (folder,) = set(options.out.glob("*")) - before or {None}
        return report, folder

    return deployed


def test_a_deployment_is_a_recording_with_its_steps_and_report(run):
    report, folder = run()
    recording = Recording.open(folder)
    assert len(recording) == report.steps == 5 and recording.consecutive and not recording.skipped
    assert not recording.color_aligned, "a camera's own colour is of another lens"
    np.testing.assert_array_equal(recording.depth_mm(2)[:, 0], (DEPTH_MM + np.uint16(3))[:, 0])
    assert recording.optics() == pytest.approx((168.6, 0.095), abs=0.1)
    rows = [json.loads(line) for line in (folder / "steps.jsonl").read_text().splitlines()]
    assert [row["frame"] for row in rows] == list(range(5)) and len(rows[0]["q_rad"]) == 7
    assert [(row["close"], row["by"]) for row in rows] == [(False, "policy")] * 5
    assert rows[1]["action"][0] == pytest.approx(0.2) and rows[1]["q_target_rad"][0] > rows[1]["q_rad"][0]
    kept = json.loads((folder / "report.json").read_text())
    assert kept["calibration"] is None, "the simulated robot has no camera to calibrate"
    assert kept["policy_sha256"] == hashlib.sha256(Path(kept["policy"]).read_bytes()).hexdigest()
    assert kept["object"] == get_preset("debug").world.objects[0]
    assert (kept["steps"], kept["frames"], kept["success"], kept["robot"]) == (5, 5, None, "sim")
    assert (folder / "film.png").stat().st_size > 1000


@pytest.mark.parametrize(("name", "baseline_m"), [("D455", 0.095), ("D435", 0.050)])
def test_a_bought_camera_s_recording_names_it_and_has_its_own_baseline(run, name, baseline_m):
    class Bought(ColourCamera):
        def device_name(self):
            return f"Intel RealSense {name}"

        def read(self):  # the colour stream comes later than depth's
            frame = super().read()
            return replace(frame, rgb=None) if self._reads < 3 else frame

    recording = Recording.open(run(Bought)[1])
    assert recording.meta["sensor"] == f"Intel RealSense {name}, brought to the policy's picture"
    assert recording.optics() == pytest.approx((168.6, baseline_m), abs=0.1)
    assert recording.optics()[1] == pytest.approx(baseline_m, abs=1e-3)


@pytest.mark.parametrize(
    ("meta", "hz", "consecutive"),
    [
        ({"hz": 2.0, "consecutive_frames": False, "baseline_m": 0.05, "fx_px": 100.0}, 2.0, False),
        ({"hz": 30.0, "consecutive_frames": True, "fx_px": 100.0}, 10.0, True),
        ({}, None, False),
    ],
)
def test_what_was_replayed_is_recorded_as_what_it_was(run, tmp_path, meta, hz, consecutive):
    """Another camera's frames say its baseline, and how far apart they are."""
    frames = [flat((180, 320), 700 + n) for n in range(20)]
    write_depth(tmp_path / "other", frames, sensor="a D435", color_aligned_to_depth=True, **meta)
    profile = contract.D455.scaled(0.25)

    def replay(clock):
        return ReplayCamera.open(tmp_path / "other", clock, profile)

    kept = Recording.open(run(replay, camera_name="replay", recording=tmp_path / "other")[1])
    original = Recording.open(tmp_path / "other")
    assert kept.meta["sensor"] == "a D435, replayed" and kept.color_aligned
    assert (kept.meta.get("hz"), kept.consecutive) == (hz, consecutive)
    assert kept.fx_px == original.fx_px
    if meta:
        assert kept.optics() == original.optics() == (100.0, 0.05)


def test_what_was_replayed_in_another_size_has_the_policy_s_focal_length(run, tmp_path):
    about = {"sensor": "a D435", "fx_px": 300.0, "color_aligned_to_depth": True}
    write_depth(tmp_path / "other", [flat((480, 640), 700)] * 8, **about)
    profile = contract.D455.scaled(0.25)
    folder = run(
        lambda clock: ReplayCamera.open(tmp_path / "other", clock, profile),
        camera_name="replay", recording=tmp_path / "other",
    )[1]  # fmt: skip
    kept = Recording.open(folder)
    assert kept.optics() == (profile.fx_px, 0.05) and not kept.color_aligned


def test_steps_are_on_the_disk_while_it_runs_so_that_a_kill_leaves_them(run, tmp_path):
    there = []

    class Looks(ColourCamera):
        def read(self):
            if self._reads == 4:  # four steps are done; the disk is a thread's
                waited = time.monotonic() + 20
                while len(there) < 4 and time.monotonic() < waited:
                    (file,) = (tmp_path / "kept").glob("*/steps.jsonl")
                    there[:] = file.read_text().splitlines()
            return super().read()

    _, folder = run(Looks)
    whole = (folder / "steps.jsonl").read_text().splitlines()
    assert len(there) == 4 and there == whole[:4] and len(whole) == 5


def test_a_step_before_which_the_arm_gave_way_says_to_what(run, monkeypatch):
    read, felt = KinematicRobot.read_state, iter([("", None), ("16 N", np.full(7, 1.23456))])

    def read_state(self):
        met, felt_nm = next(felt, ("", None))
        return replace(read(self), met=met, felt_nm=felt_nm)

    monkeypatch.setattr(KinematicRobot, "read_state", read_state)
    rows = [json.loads(line) for line in (run()[1] / "steps.jsonl").read_text().splitlines()]
    assert [row.get("met") for row in rows] == [None, "16 N", None, None, None]
    assert [row.get("felt_nm") for row in rows] == [None, [1.235] * 7, None, None, None]


def test_a_width_that_is_no_number_costs_no_report(run, monkeypatch):
    read = KinematicRobot.read_state
    monkeypatch.setattr(KinematicRobot, "read_state", lambda self: replace(read(self), width_m=float("nan")))
    report, folder = run()
    assert report.holds == 5 and json.loads((folder / "report.json").read_text())["width_m"] is None
    rows = [json.loads(line) for line in (folder / "steps.jsonl").read_text().splitlines()]
    assert [(row["width_m"], row["by"]) for row in rows] == [(None, None)] * 5


def test_two_that_begin_in_the_same_second_have_two_folders(tmp_path, monkeypatch):
    monkeypatch.setattr(session, "_stamp", lambda: "20261127-080000")
    folders = [session._new_folder(tmp_path).name for _ in range(3)]
    assert folders == ["20261127-080000", "20261127-080000-1", "20261127-080000-2"]


def test_one_that_never_began_leaves_no_folder(run, tmp_path):
    class Absent(ColourCamera):
        def start(self):
            raise UserError("no camera")

    with pytest.raises(UserError, match="no camera"):
        run(Absent)
    assert list((tmp_path / "kept").iterdir()) == []


@pytest.mark.parametrize(
    ("at", "calls", "after"),
    [
        ("start", ["stop"], "the start was broken off"),
        ("first frame", ["start", "hold", "stop"], "the robot holds position"),
    ],
)
def test_one_that_is_interrupted_before_its_first_step_leaves_no_folder(run, monkeypatch, at, calls, after):
    robots, stopped, said = [], [], []

    def stop(self):
        robots.append(self)
        self.calls.append("stop")

    def asked(self):
        raise KeyboardInterrupt

    monkeypatch.setattr(KinematicRobot, "stop", stop)
    monkeypatch.setattr(ColourCamera, "stop", lambda self: stopped.append(self))
    if at == "start":
        monkeypatch.setattr(KinematicRobot, "start", asked)
    fails_at = 1 if at == "first frame" else None
    report, folder = run(lambda clock: ColourCamera(clock, fails_at), said.append)
    assert report.interrupted and not report.steps and folder is None
    assert [robot.calls for robot in robots] == [calls] and len(stopped) == 1
    assert len(said) == 1 and said[0].endswith(f"stop: interrupted; {after}")


@pytest.mark.parametrize(("device", "error"), [(ColourCamera, CameraError), (KinematicRobot, RobotError)])
def test_one_whose_device_fails_in_its_start_is_no_failed_trial(run, monkeypatch, device, error):
    def fail(self):
        raise error("no answer")

    monkeypatch.setattr(device, "start", fail)
    report, folder = run(yes=True)
    assert report.fault == "no answer" and not report.steps and folder is None


def test_one_whose_arm_fails_at_the_first_command_is_kept(run, monkeypatch):
    def fail(self, q_target_rad, close):
        raise RobotError("joint_reflex")

    monkeypatch.setattr(KinematicRobot, "command", fail)
    report, folder = run(yes=True)
    assert not report.steps and json.loads((folder / "report.json").read_text())["fault"] == "joint_reflex"


def test_two_in_a_second_are_two_recordings_of_one_folder(run, tmp_path):
    folders = {run()[1] for _ in range(2)}
    assert {recording.path for recording in find_recordings(tmp_path / "kept")} == folders


def test_an_interrupted_one_is_kept_as_far_as_it_went_and_not_judged(run, monkeypatch):
    monkeypatch.setattr(ColourCamera, "success", lambda self: False, raising=False)  # a rig knows
    said = []
    report, folder = run(lambda clock: ColourCamera(clock, fails_at=4), said.append, seconds=60.0)
    assert report.interrupted and len(Recording.open(folder)) == 3
    kept = json.loads((folder / "report.json").read_text())
    assert kept["interrupted"] and kept["success"] is None and not any("verdict" in line for line in said)
    assert [deployment.ended for deployment in deployments.find(folder)] == ["interrupted"]
    assert json.loads((run()[1] / "report.json").read_text())["success"] is False


@pytest.mark.parametrize(("answer", "success"), [("y", True), ("No", False), ("", None), ("perhaps", None)])
def test_a_person_says_how_it_ended(run, monkeypatch, answer, success):
    monkeypatch.setattr(session.sys.stdin, "isatty", lambda: True, raising=False)
    monkeypatch.setattr("builtins.input", lambda question: answer)
    _, folder = run()
    assert json.loads((folder / "report.json").read_text())["success"] is success


def test_a_question_is_seen_on_the_terminal_where_output_goes_to_a_file(monkeypatch, capsys):
    """`ddgrasp deploy ... > log` would wait for an answer to what nobody has read."""
    monkeypatch.setattr(session.sys.stdin, "isatty", lambda: True, raising=False)
    monkeypatch.setattr("builtins.input", lambda question: "y")
    session.ask_person("Is the way clear?")
    assert session.ask_success("Is it lifted?") is True
    told = capsys.readouterr()
    assert told.err == "Is the way clear? [y/N] Is it lifted? [y/n, or Enter for no answer] " and not told.out


@pytest.mark.parametrize(("success", "words"), [(True, "lifted and held"), (False, "failed")])
def test_the_rig_judges_by_itself_and_says_so(run, success, words):
    class Judging(ColourCamera):
        def success(self):
            return success

    said = []
    _, folder = run(Judging, said.append, yes=True)
    assert json.loads((folder / "report.json").read_text())["success"] is success
    assert f"verdict: {words}" in said


def test_a_dry_run_shows_what_the_policy_would_do_with_a_hand_that_is_shut(run, monkeypatch):
    """As a hand may be that was not homed: trying again would take over for good."""
    read = KinematicRobot.read_state
    monkeypatch.setattr(KinematicRobot, "read_state", lambda self: replace(read(self), width_m=0.0))
    rows = {}
    for dry_run in (True, False):
        lines = (run(dry_run=dry_run, seconds=0.8)[1] / "steps.jsonl").read_text().splitlines()
        rows[dry_run] = [json.loads(line)["by"] for line in lines]
    assert rows == {True: ["policy"] * 8, False: ["policy"] + ["retry"] * 7}


@pytest.mark.parametrize(
    ("colour", "words"),
    [
        (None, "no colour"),
        (np.zeros((480, 848, 3), np.float32), "colour of type float32 and shape (480, 848, 3)"),
        (np.zeros((480, 848, 4), np.uint8), "colour of type uint8 and shape (480, 848, 4)"),
    ],
)
def test_a_camera_of_one_s_own_without_colour_that_can_be_kept_is_told_so(run, colour, words):
    class Own(ColourCamera):
        def read(self):
            return replace(super().read(), rgb=colour)

    said = []
    report, folder = run(Own, said.append)
    lost = f"the camera gives {words}; a recording's is (h, w, 3) uint8"
    assert report.steps == 5 and f"frames are missing: {lost}" in said
    kept = json.loads((folder / "report.json").read_text())
    assert (kept["frames"], kept["frames_lost"]) == (0, lost)


def test_a_driver_that_moves_by_itself_is_refused_in_a_dry_run(run, monkeypatch, tmp_path):
    class Moving(KinematicRobot):
        def __init__(self, setup):
            super().__init__(setup.clock)
            setup.confirm("This arm will move. Is the way clear?")

    made = []
    run(seconds=0.1)

    def make(setup):
        made.append(setup)
        return Moving(setup), ColourCamera(setup.clock)

    monkeypatch.setattr(session, "make_devices", make)
    options = SessionOptions(camera="stereo", seconds=0.1, out=tmp_path / "dry", dry_run=True, yes=True)
    with pytest.raises(UserError, match="a dry run moves nothing, and this robot's driver would"):
        session.deploy(CONFIG, tmp_path / "p.onnx", options)
    assert len(made) == 1


def test_a_camera_that_fills_its_buffers_again_is_recorded_frame_by_frame(run, monkeypatch):
    class Reusing(ColourCamera):
        """Hands out the same two arrays again and again, as a driver may that copies nothing."""

        rgb, depth_mm = np.zeros((480, 848, 3), np.uint8), DEPTH_MM.copy()

        def read(self):
            frame = super().read()
            assert frame.rgb is not None
            np.copyto(self.rgb, frame.rgb)
            np.copyto(self.depth_mm, frame.depth)
            return replace(frame, rgb=self.rgb, depth=self.depth_mm)

    add = RecordingWriter.add

    def slowly(self, rgb, depth_mm):
        time.sleep(0.15)
        add(self, rgb, depth_mm)

    monkeypatch.setattr(RecordingWriter, "add", slowly)
    recording = Recording.open(run(Reusing)[1])
    assert [int(recording.depth_mm(i)[-1, 0]) for i in range(5)] == [701, 702, 703, 704, 705]
    assert [round(float(recording.rgb(i).mean())) for i in range(5)] == [1, 2, 3, 4, 5]


def test_a_disk_that_takes_no_frames_stops_nothing(run, monkeypatch):
    def full(self, rgb, depth_mm):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("sensors.recordings.writer.RecordingWriter.add", full)
    report, folder = run()
    kept = json.loads((folder / "report.json").read_text())
    assert report.steps == 5 and "No space left" in kept["frames_lost"] and not (folder / "depth").exists()


def test_a_disk_that_is_full_after_three_frames_keeps_them(run, monkeypatch):
    write, files = writing._write, []

    def filling(path, data, sync=False):
        files.append(path)
        if len(files) == 8:  # half of the fourth frame is there
            path.touch()
            raise OSError(28, "No space left on device")
        write(path, data, sync)

    monkeypatch.setattr(writing, "_write", filling)
    report, folder = run(seconds=0.8)
    kept = json.loads((folder / "report.json").read_text())
    rows = [json.loads(line) for line in (folder / "steps.jsonl").read_text().splitlines()]
    assert report.steps == len(rows) == 8 and kept["frames"] == len(Recording.open(folder)) == 3
    assert kept["frames_lost"].startswith("those after the first 3: [Errno 28] No space left")
    assert [row.get("frame") for row in rows] == [0, 1, 2, *[None] * 5]
    assert len(list((folder / "color").iterdir())) == len(list((folder / "depth").iterdir())) == 3


def test_a_camera_that_fails_as_it_stops_costs_nothing_of_what_was_recorded(run, tmp_path):
    class Unplugged(ColourCamera):
        def stop(self):
            raise RuntimeError("no device connected")

    with pytest.raises(RuntimeError, match="no device connected"):
        run(Unplugged)
    (folder,) = (tmp_path / "kept").iterdir()
    assert len(Recording.open(folder)) == 5
    kept = json.loads((folder / "report.json").read_text())
    assert kept["steps"] == 5 and kept["fault"] == "RuntimeError: no device connected"


@pytest.fixture
def signals_count(ctrl_c):
    """Not as under nohup."""
    before = signal.signal(signal.SIGHUP, signal.SIG_DFL)
    yield
    signal.signal(signal.SIGHUP, before)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_second_signal_does_not_cut_the_stopping_short(run, number, signals_count):
    class Stopping(ColourCamera):
        def stop(self):
            os.kill(os.getpid(), signal.SIGINT)
            os.kill(os.getpid(), signal.SIGTERM)

        def read(self):
            if self._reads == 2:
                os.kill(os.getpid(), number)
            return super().read()

    def say(text):  # a terminal that was closed
        raise OSError(5, "Input/output error")

    report, folder = run(Stopping, say, seconds=60.0)
    assert report.interrupted and report.steps == len(Recording.open(folder)) == 2
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_nor_does_the_first_where_the_time_is_over(run, number, signals_count):
    class Stopping(ColourCamera):
        def stop(self):
            os.kill(os.getpid(), number)
            stopped.append(self)

    stopped = []
    report, folder = run(Stopping)
    assert stopped and report.steps == len(Recording.open(folder)) == 5
    assert not report.interrupted and not report.fault
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_whoever_ends_a_deployment_that_ends_anyway_wants_no_next_one(run, signals_count):
    class Stopping(ColourCamera):
        def stop(self):
            os.kill(os.getpid(), signal.SIGINT)

    run()
    assert not interrupts.ended_late()
    run(Stopping)
    assert interrupts.ended_late()
    run()
    assert not interrupts.ended_late()


def test_nor_is_the_report_cut_short_while_frames_go_to_the_disk(run, monkeypatch, signals_count):
    add = RecordingWriter.add

    def slowly(self, rgb, depth_mm):
        time.sleep(0.3)
        add(self, rgb, depth_mm)

    def judged(camera, ask):
        threading.Timer(0.2, os.kill, (os.getpid(), signal.SIGINT)).start()  # the disk is at it then
        return True

    monkeypatch.setattr(RecordingWriter, "add", slowly)
    monkeypatch.setattr(session, "verdict", judged)
    report, folder = run()
    kept = json.loads((folder / "report.json").read_text())
    assert report.steps == len(Recording.open(folder)) == 5
    assert kept["success"] is True and not kept["fault"] and kept["frames"] == 5


@pytest.mark.parametrize(
    ("camera", "expected"), [("stereo", "stereo, other tables"), ("realsense", "realsense")]
)
def test_a_simulated_camera_before_other_tables_is_called_another(run, camera, expected):
    config = get_preset("debug")
    many = replace(config, record=replace(config.record, other_tables=True))
    _, folder = run(config=many, camera_name=camera)
    assert json.loads((folder / "report.json").read_text())["camera"] == expected
    meta = Recording.open(folder).meta
    if camera == "stereo":
        assert (meta["sensor"], meta["baseline_m"]) == (f"{expected}, D455 profile", contract.D455.baseline_m)
    else:  # whose driver does not say what it is: no baseline is taken for it
        assert meta["sensor"] == f"{expected}, brought to the policy's picture" and "baseline_m" not in meta


def test_a_rig_knows_what_lies_there(run):
    class Rig(ColourCamera):
        def object_name(self):
            return "cube"

    for camera, expected in ((Rig, "cube"), (ColourCamera, "apple")):
        _, folder = run(camera, object_name="apple")
        assert json.loads((folder / "report.json").read_text())["object"] == expected


def test_a_camera_of_a_rig_that_gives_colour_with_every_frame_is_kept_as_often(run):
    class Rig(ColourCamera):
        def picture(self):
            return np.zeros((180, 320, 3), np.uint8)

    meta = Recording.open(run(Rig)[1]).meta
    assert (meta["hz"], meta["consecutive_frames"]) == (10.0, True) and "repeated_frames" not in meta


def test_a_frame_that_came_again_is_no_next_one(run):
    class Stalled(ColourCamera):
        def read(self):
            if self._reads != 2:
                self.newest = super().read()
            else:
                self._reads += 1
            return self.newest

    report, folder = run(Stalled)
    recording = Recording.open(folder)
    assert report.holds == 1 and len(recording) == 5 and not recording.consecutive
    assert recording.meta["repeated_frames"] == 1


def test_frames_before_and_after_an_outage_do_not_follow_each_other(run):
    class Gone(ColourCamera):
        def read(self):
            frame = super().read()
            if self._reads == 3:
                raise CameraError("no frame came")
            return frame

    report, folder = run(Gone)
    recording = Recording.open(folder)
    assert report.holds == 1 and len(recording) == 4 and not recording.consecutive


def test_where_nothing_can_be_kept_nothing_moves(run, tmp_path, monkeypatch):
    monkeypatch.setattr(KinematicRobot, "start", lambda self: pytest.fail("the robot was started"))
    (tmp_path / "file").touch()
    with pytest.raises(FileExistsError):
        run(out=tmp_path / "file")


def test_the_report_of_deployments_has_their_verdicts_and_films(run, capsys):
    _, judged = run()
    _, other = run()
    values = json.loads((judged / "report.json").read_text())
    (judged / "report.json").write_text(json.dumps({**values, "success": True}))
    (judged.parent / "begun").mkdir()
    parse("report", [str(judged.parent)]).run()
    said = capsys.readouterr().out
    reports = [json.loads((path / "report.json").read_text()) for path in (judged, other)]
    missed = sum(report["missed_deadlines"] for report in reports)
    assert "Success 100.0 % of 1" in said and f"Missed deadlines: {missed} in 10 steps." in said
    text = (judged.parent / "report.html").read_text()
    assert text.count("data:image/webp;base64,") == 2
    for words in (f"{judged.name}: lifted and held", f"{other.name}: not judged", "width=device-width"):
        assert words in text
    assert find_recordings(judged.parent), "the page beside them does not disturb a fit"
    for written, message in (
        ("{", "not valid JSON"),
        ("{}", "has no 'success'"),
        ("null", "has no 'success'"),
        ("5", "has no 'success'"),
        ('{"success": true, "steps": 3, "events": []}', "lacks holds, missed_deadlines, fault, latency_ms"),
        (None, "success\" is 'yes'"),
        (json.dumps({**values, "steps": "x"}), "steps is 'x': change nothing in it but 'success'"),
        (json.dumps({**values, "missed_deadlines": None}), "missed_deadlines is None: change nothing"),
        (json.dumps({**values, "latency_ms": {}, "events": 1}), "latency_ms is {}, events is 1: change"),
        (json.dumps({**values, "latency_ms": {"p50": 1.0, "p99": None}}), "latency_ms is .*: change"),
        (json.dumps({**values, "events": [1]}), r"events is \[1\]: change"),
    ):
        text = json.dumps({**values, "success": "yes"}) if written is None else written
        (other / "report.json").write_text(text)
        with pytest.raises(UserError, match=message):
            parse("report", [str(other)]).run()
    (other / "report.json").write_text(json.dumps({**values, "success": None, "dry_run": True}))
    parse("report", [str(other)]).run()
    said = capsys.readouterr().out
    assert "none was judged" in said and "in 0 steps. Beside them 1 dry run." in said
    late = {**values, "success": None, "dry_run": True, "missed_deadlines": 3}
    (other / "report.json").write_text(json.dumps(late))
    parse("report", [str(other)]).run()
    assert "<p class=verdict>" in (other / "report.html").read_text(), "no arm was late"
