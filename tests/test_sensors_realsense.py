"""RealSense into recordings: files and a live camera, through librealsense where it is, else a stand-in."""

import math
import os
import signal
import sys
from collections.abc import Callable
from itertools import count
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from app.commands import parse
from ddgrasp.errors import UserError
from realsense_support import (
    FX_PX,
    NAME,
    SERIAL,
    SIZE,
    ScriptedLibrary,
    SoftwareCamera,
    depth_mm,
    full_after,
    scripted,
)
from sensors.recordings import realsense
from sensors.recordings import writer as writing
from sensors.recordings.realsense import Gaps, once
from sensors.recordings.realsense_live import Pace, Take, frame_count
from sensors.recordings.recording import Recording, check_fields, find_recordings
from sensors.recordings.sources import RawFrame

SMALL = ("--width", str(SIZE[1]), "--height", str(SIZE[0]))
TIMEOUT = RuntimeError("Frame didn't arrive within 3000")


@pytest.fixture
def rs():
    """The real library; its wheel loads only where libusb is."""
    return pytest.importorskip("pyrealsense2", exc_type=ImportError)


def record(out: Path, *args) -> None:
    parse("record realsense", ["--out", str(out), *SMALL, *map(str, args)]).run()


def numbers_in(path: Path) -> list[int]:
    """Which synthetic frames a recording has; every pixel of each is as it was given."""
    recording = Recording.open(path)
    numbers = [int(recording.depth_mm(i)[0, -1]) - 600 for i in range(len(recording))]
    for i, number in enumerate(numbers):
        np.testing.assert_array_equal(recording.depth_mm(i), depth_mm(number))
        assert abs(int(recording.rgb(i)[20, 30, 0]) - 8 * number % 256) <= 3  # JPEG
    return numbers


# --- librealsense itself ---------------------------------------------------------------------------


def test_a_file_that_librealsense_wrote_becomes_a_recording(rs, tmp_path, capsys):
    file = tmp_path / "desk.bag"
    try:
        SoftwareCamera(rs).write(file, range(1, 21))
    except RuntimeError:  # newer versions read .bag, but write .db3 alone
        file = tmp_path / "desk.db3"
        SoftwareCamera(rs).write(file, range(1, 21))
    parse("record import", [str(file), "--out", str(tmp_path / "out")]).run()
    numbers = numbers_in(tmp_path / "out" / "desk")
    assert numbers == list(range(1, 21))
    meta = Recording.open(tmp_path / "out" / "desk").meta
    assert (meta["sensor"], meta["fx_px"], meta["baseline_m"], meta["hz"]) == (NAME, FX_PX, 0.095, 30)
    assert meta["consecutive_frames"] and not meta["color_aligned_to_depth"]
    assert capsys.readouterr().out.splitlines()[-1].endswith("left out: 0 frames, 0 recordings")


def test_frames_that_a_file_lacks_end_consecutive_frames(rs, tmp_path):
    """The recorder wrote 1 to 3 and 9 to 12; librealsense gives 9 twice, first with the colour of 3."""
    camera = SoftwareCamera(rs)
    try:
        camera.write(tmp_path / "desk.bag", (1, 2, 3, 9, 10, 11, 12))
    except RuntimeError:  # see above
        camera = SoftwareCamera(rs)
        camera.write(tmp_path / "desk.db3", (1, 2, 3, 9, 10, 11, 12))
    file = next(tmp_path.glob("desk.*"))
    parse("record import", [str(file), "--out", str(tmp_path / "out")]).run()
    assert numbers_in(tmp_path / "out" / "desk") == [1, 2, 3, 9, 10, 11, 12]
    assert not Recording.open(tmp_path / "out" / "desk").consecutive


def test_a_live_camera_becomes_a_recording(rs, tmp_path, monkeypatch, capsys):
    camera, pipeline = SoftwareCamera(rs), rs.pipeline()
    pipeline.set_device(camera.device)
    monkeypatch.setattr(rs, "pipeline", lambda: pipeline)
    with camera.streaming():
        record(tmp_path, "--name", "desk", "--seconds", 0.5)
    numbers = numbers_in(tmp_path / "desk")
    assert len(numbers) == 5 and numbers[0] >= 16
    slots = [(number - numbers[0]) // 3 for number in numbers]
    lost = slots[-1] - 4  # a busy machine may lose frames; then it says how many
    said = capsys.readouterr().out
    assert sorted(set(slots)) == slots
    assert said == (
        f"{lost} frames were lost, writing them took too long: take a lower --hz or size\n" * (lost > 0)
        + f"{tmp_path / 'desk'}: 5 frames\n"
    )
    meta = Recording.open(tmp_path / "desk").meta
    assert (meta["sensor"], meta["fx_px"], meta["baseline_m"]) == (NAME, FX_PX, 0.095)
    assert meta["hz"] == (float(f"{50 / (5 + lost):.3g}") if lost else 10)
    assert meta["consecutive_frames"] == (not lost)


def test_a_size_the_camera_does_not_have_is_named(rs, tmp_path, monkeypatch):
    camera, pipeline = SoftwareCamera(rs), rs.pipeline()
    pipeline.set_device(camera.device)
    monkeypatch.setattr(rs, "pipeline", lambda: pipeline)
    monkeypatch.setattr(rs, "context", ScriptedLibrary(()).context)
    with pytest.raises(
        UserError, match=r"no depth and colour of 65x48 at 30 Hz \(Couldn't resolve requests\)"
    ):
        record(tmp_path, "--width", 65)
    assert list(tmp_path.iterdir()) == []


# --- a file's frames -------------------------------------------------------------------------------


def test_a_depth_picture_that_is_given_again_counts_once_with_its_own_colour():
    frames = [RawFrame(f"depth {d}, colour {c}", None, None) for d, c in ((1, 1), (9, 1), (9, 9), (9, 10))]
    nothing = RawFrame("no depth", None, None)
    sets = [*zip((1, 9, 9, 9), (2.0, 270.0, 3.0, 31.0), frames, strict=True), (None, math.inf, nothing)]
    given = list(once([*sets, (None, math.inf, nothing)]))
    assert given == [(1, frames[0]), (9, frames[2]), (None, nothing), (None, nothing)]
    assert list(once([])) == []


@pytest.mark.parametrize(("numbers", "gaps"), [((7, 8, 9), False), ((1, 2, 4), True), ((5, 6, 1), True)])
def test_numbers_that_are_missing_between_a_files_frames_are_a_gap(numbers, gaps):
    counted = Gaps()
    for number in numbers:
        counted.count(number)
    assert counted.meta() == ({"consecutive_frames": False} if gaps else {})


def test_a_file_plays_once_both_streams_have_started(monkeypatch):
    said: list[str] = []

    def say(what: str, answer: Any = None) -> Callable[..., Any]:
        return lambda *_: (said.append(what), answer)[1]

    playback = SimpleNamespace(set_real_time=say("speed"), pause=say("pause"), resume=say("resume"))
    profile = SimpleNamespace(get_device=lambda: SimpleNamespace(as_playback=lambda: playback))
    pipeline = SimpleNamespace(
        start=say("start"), stop=say("stop"), try_wait_for_frames=say("wait", (False, None))
    )
    monkeypatch.setattr(realsense, "_opened", lambda rs, file: (pipeline, None, profile))
    assert list(realsense._frames(None, Path("desk.bag"), Gaps())) == []
    assert said == ["speed", "pause", "start", "resume", "wait", "stop"]

    def broken(*_: object) -> None:
        raise RuntimeError("bad chunk")

    pipeline.try_wait_for_frames = broken
    with pytest.raises(UserError, match=r"desk.bag: cannot be read \(bad chunk\)"):
        list(realsense._frames(None, Path("desk.bag"), Gaps()))


# --- a scripted camera -----------------------------------------------------------------------------


def test_every_third_frame_is_kept_once_the_exposure_has_settled(tmp_path, monkeypatch, capfd):
    library = scripted(monkeypatch, count(1))
    record(tmp_path, "--frames", 4, "--serial", SERIAL)
    assert numbers_in(tmp_path / "take") == [16, 19, 22, 25]
    streams = [("depth", 64, 48, "z16", 30), ("color", 64, 48, "rgb8", 30)]
    assert library.asked == [(SERIAL,), *streams, ("emitter", 1.0)]
    assert library.stopped
    shown = capfd.readouterr()
    unit, frames = shown.out.splitlines()
    assert "take: depth in units of 0.0001 m was rounded to whole millimetres" in unit
    assert frames == f"{tmp_path / 'take'}: 4 frames"
    assert "first 0.5 s are left out while its exposure settles" in shown.err and "4/4" in shown.err


def test_frames_that_writing_was_too_slow_for_are_counted(tmp_path, monkeypatch, capsys):
    # After 16 are due 19 (lost), 22 (23 has to do), 25 (lost), 28 (30 has to do).
    scripted(monkeypatch, [*range(1, 17), 18, 23, 24, 30])
    record(tmp_path, "--frames", 3)
    assert numbers_in(tmp_path / "take") == [16, 23, 30]
    assert "\n2 frames were lost, writing them took too long" in capsys.readouterr().out
    recording = Recording.open(tmp_path / "take")
    assert recording.meta["hz"] == 6.0 and not recording.consecutive  # 10, but 3 of 5


@pytest.mark.parametrize(("take", "hz", "kept"), [
    (Take(2, 300), 1, 0.00662), (Take(99, 1), 30, 29.7), (Take(7), 30, 30),
])  # fmt: skip
def test_the_rate_that_is_left_is_never_none(take, hz, kept):
    meta = take.meta(hz)
    assert meta["hz"] == kept
    check_fields(Path("meta.json"), meta)


@pytest.mark.parametrize("kind", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_ctrl_c_keeps_what_was_recorded(tmp_path, monkeypatch, capsys, kind):
    def interrupted():
        os.kill(os.getpid(), kind)
        return 22

    before = signal.getsignal(kind)
    if before is signal.SIG_IGN:
        pytest.skip("these tests run under nohup, where a closed terminal ends nothing")
    scripted(monkeypatch, [*range(1, 22), interrupted, 25, 28])
    with pytest.raises(KeyboardInterrupt):
        record(tmp_path, "--seconds", 60)
    assert numbers_in(tmp_path / "take") == [16, 19, 22]
    assert capsys.readouterr().out.endswith("take: 3 frames, stopped before the 600 asked for\n")
    assert signal.getsignal(kind) is before


def test_frames_that_a_killed_recording_left_are_not_recorded_over(tmp_path, monkeypatch, capsys):
    def killed(self, *_):
        self._alone.close()  # as the system does
        raise SystemExit(9)

    scripted(monkeypatch, list(range(1, 60)))
    with monkeypatch.context() as patch, pytest.raises(SystemExit):
        patch.setattr(writing.RecordingWriter, "__exit__", killed)
        record(tmp_path, "--frames", 2)
    with pytest.raises(UserError, match=r"\.take\.partial has 2 frames of a recording that did not end"):
        record(tmp_path, "--frames", 2)
    parse("record import", [str(tmp_path / ".take.partial"), "--out", str(tmp_path / "kept")]).run()
    (kept,) = find_recordings(tmp_path / "kept")
    assert "2 frames" in capsys.readouterr().out and not kept.color_aligned and kept.fx_px
    assert kept.meta["hz"] == 10


def test_ctrl_c_before_the_first_frame_leaves_nothing(tmp_path, monkeypatch):
    scripted(monkeypatch, [1, lambda: os.kill(os.getpid(), signal.SIGINT) or 2, 3])
    with pytest.raises(KeyboardInterrupt, match="nothing was recorded"):
        record(tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_a_camera_that_stops_keeps_what_it_gave(tmp_path, monkeypatch, capsys):
    library = scripted(monkeypatch, [*range(1, 20), TIMEOUT], stop_error="No device connected")
    with pytest.raises(UserError, match=r"the camera stopped \(Frame didn't arrive within 3000\).*is kept"):
        record(tmp_path, "--frames", 100)
    assert numbers_in(tmp_path / "take") == [16, 19] and library.stopped
    assert capsys.readouterr().out.endswith("take: 2 frames, stopped before the 100 asked for\n")


def test_a_full_disk_ends_the_take_and_keeps_it(tmp_path, monkeypatch, capsys):
    library = scripted(monkeypatch, [*range(1, 20), *range(28, 40)])  # 22 and 25 are lost before the last
    monkeypatch.setattr(writing, "_write", full_after(writing._write, files=5))
    with pytest.raises(UserError, match=r"could not be written \(No space left on device\).*kept") as error:
        record(tmp_path, "--frames", 100)
    assert "USB" not in str(error.value) and library.stopped
    assert numbers_in(tmp_path / "take") == [16, 19]
    assert sorted(p.name for p in (tmp_path / "take" / "color").iterdir()) == ["000000.jpg", "000001.jpg"]
    recording = Recording.open(tmp_path / "take")
    assert recording.meta["hz"] == 10 and recording.consecutive
    assert capsys.readouterr().out.endswith("take: 2 frames, stopped before the 100 asked for\n")


def test_a_disk_that_takes_no_frame_leaves_nothing(tmp_path, monkeypatch):
    scripted(monkeypatch, count(1))
    monkeypatch.setattr(writing, "_write", full_after(writing._write, files=0))
    with pytest.raises(OSError, match="No space left"):
        record(tmp_path, "--frames", 100)
    assert list(tmp_path.iterdir()) == []


def test_a_take_that_ends_far_away_is_kept(tmp_path, monkeypatch, capsys):
    # 5 frames of 0.6 m, 7 of 6.6 m: the camera's own unit is certain.
    scripted(monkeypatch, [*range(1, 29), *range(6000, 6030)])
    record(tmp_path, "--frames", 12)
    assert capsys.readouterr().out.endswith(f"{tmp_path / 'take'}: 12 frames\n")
    assert len(Recording.open(tmp_path / "take")) == 12
    parse("record import", [str(tmp_path / "take"), "--out", str(tmp_path / "again")]).run()
    assert len(find_recordings(tmp_path / "again")[0]) == 12


def test_a_take_that_cannot_be_ended_leaves_its_frames_to_be_imported(tmp_path, monkeypatch, capsys):
    """Another one may take what room is left on the disk: these frames do not come again."""
    scripted(monkeypatch, count(1))

    def full(path: Path, data: bytes, sync: bool = False) -> None:
        if path.name == "meta.json":
            path.touch()  # as a disk does that is full when the data are to go there
            raise OSError(28, "No space left on device")
        write(path, data, sync)

    write = writing._write
    with monkeypatch.context() as patch, pytest.raises(UserError) as error:
        patch.setattr(writing, "_write", full)
        record(tmp_path, "--frames", 2)
    said, left = str(error.value), tmp_path / ".take.partial"
    assert "No space left" in said and f"its 2 frames are in {left};" in said
    parse("record import", [str(left), "--out", str(tmp_path / "kept")]).run()
    (kept,) = find_recordings(tmp_path / "kept")
    assert len(kept) == 2


@pytest.mark.parametrize(
    ("numbers", "how", "args", "message"),
    [
        ([TIMEOUT], {}, (), "has started but gives no frames"),
        ((), {"silent": "hwmon"}, (), r"streams, and does not answer \(hwmon\): plug it in anew"),
        ((), {"start_error": "No device connected", "serials": ()}, (), "no RealSense camera is connected"),
        ((), {"start_error": "No device"}, ("--serial", "000132"), "Did you mean '000123'"),
        ((), {"start_error": "Couldn't resolve"}, ("--width", 65), "no depth and colour of 65x48 at 30 Hz"),
        (
            range(5500, 5530),
            {},
            ("--frames", 2),
            "expected 0.08 to 6 m: point the camera at something nearer",
        ),
    ],
)
def test_what_the_camera_cannot_give_is_one_line_and_leaves_nothing(
    tmp_path, monkeypatch, numbers, how, args, message
):
    scripted(monkeypatch, numbers, **how)
    with pytest.raises(UserError, match=message) as error:
        record(tmp_path, *args)
    assert "\n" not in str(error.value)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("args", "message"),
    [
        (("--hz", 7), "--hz is 7; expected one of 1, 2, 3, 5, 6, 10, 15, 30"),
        (("--hz", 0), "--hz is 0; expected one of 1"),
        (("--seconds", 0), "--seconds is 0; expected more than 0, up to 3600"),
        (("--seconds", "nan"), "--seconds is nan"),
        (("--frames", -1), "--frames is -1; expected at least 1"),
        (("--name", "a/b"), "--name is 'a/b'; expected a folder's name"),
        (("--name", ".."), "--name is '..'"),
    ],
)
def test_wrong_values_are_named_before_the_camera_starts(tmp_path, monkeypatch, args, message):
    library = scripted(monkeypatch, ())
    with pytest.raises(UserError, match=message):
        record(tmp_path, *args)
    assert library.asked == [] and list(tmp_path.iterdir()) == []


def test_a_recording_is_never_overwritten(tmp_path, monkeypatch):
    scripted(monkeypatch, count(1))
    record(tmp_path, "--frames", 2)
    record(tmp_path, "--frames", 1, "--name", "take_2")
    with pytest.raises(UserError, match="take exists already: choose another, for example --name take_3"):
        record(tmp_path, "--frames", 1)
    assert numbers_in(tmp_path / "take") == [16, 19]


def test_seconds_and_rate_make_the_number_of_frames():
    assert frame_count(0, 10.0, 30) == 300
    assert frame_count(0, 0.25, 10) == 3
    assert frame_count(0, 8.3, 30) == 249  # in binary 8.3 x 30 is a little more
    assert frame_count(7, 10.0, 30) == 7


def test_a_counter_that_starts_again_is_followed():
    pace = Pace(3)
    assert [pace.lost_before(n) for n in (50, 51, 53, 2, 3, 5, 5, 8)] == [0, None, 0, 0, None, 0, None, 0]


def test_a_missing_library_names_the_remedy(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pyrealsense2", None)
    with pytest.raises(UserError, match=r"needs pyrealsense2 .* pip install 'ddgrasp\[realsense\]'"):
        record(tmp_path)
    monkeypatch.delitem(sys.modules, "pyrealsense2")
    (tmp_path / "path").mkdir()
    (tmp_path / "path" / "pyrealsense2.py").write_text("raise ImportError('libusb-1.0.so.0: cannot open')")
    monkeypatch.syspath_prepend(tmp_path / "path")
    with pytest.raises(UserError, match=r"cannot be loaded \(libusb-1.0.so.0.*apt install libusb-1.0-0"):
        record(tmp_path)
