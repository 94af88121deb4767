"""Recordings: round trip, damaged frames, wrong units, real files."""

import os
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from app import pipeline
from app.commands.ddg import DDGFit
from ddgrasp.errors import UserError
from ddgrasp.files import TEMPORARY
from ddgrasp.presets import PRESETS
from recording_support import set_meta
from sensors.recordings import writer as writer_module
from sensors.recordings.recording import Recording, contents, depth_picture_count, find_recordings
from sensors.recordings.writer import RecordingWriter, check_place

REAL = Path(__file__).parents[2] / "shared" / "real_depth"


def _frame(seed: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    depth_mm = rng.integers(500, 1500, (24, 32)).astype(np.uint16)
    depth_mm[:3] = 0
    return np.full((24, 32, 3), 40 * seed, np.uint8), depth_mm


def _write(path: Path, frames: int = 4) -> Path:
    with RecordingWriter(path, {"sensor": "test", "fx_px": 20.0, "consecutive_frames": True}) as writer:
        for seed in range(frames):
            writer.add(*_frame(seed))
    return path


def _replace_depth(path: Path, index: int, image: np.ndarray) -> None:
    assert cv2.imwrite(str(path / "depth" / f"{index:06d}.png"), image)


def test_round_trip_is_exact_in_depth(tmp_path):
    recording = Recording.open(_write(tmp_path / "a"))
    assert len(recording) == 4 and not recording.skipped
    assert (recording.height_px, recording.width_px, recording.fx_px) == (24, 32, 20.0)
    for seed, (rgb, depth_mm) in enumerate(recording.frames()):
        np.testing.assert_array_equal(depth_mm, _frame(seed)[1])
        assert depth_mm.dtype == np.uint16 and np.abs(rgb.astype(int) - 40 * seed).max() <= 2
    assert recording.meta["invalid_fraction_mean"] == 0.125
    np.testing.assert_allclose(recording.depth_m(0), _frame(0)[1] / 1000.0, atol=1e-6)


def test_depth_pictures_in_capital_letters_are_counted_as_they_are_read(tmp_path):
    one, other = _write(tmp_path / "a", frames=3), _write(tmp_path / "b", frames=2)
    file = one / "depth" / "000001.png"
    file.rename(file.with_suffix(".PNG"))
    (other / "depth" / "notes.txt").write_text("")
    assert depth_picture_count([one, other]) == len(Recording.open(one)) + len(Recording.open(other)) == 5


def test_contents_change_with_what_is_there_and_not_with_where_it_is(tmp_path):
    for name in ("a", "b"):
        _write(tmp_path / "all" / name)
    first = contents(tmp_path / "all")
    assert first.startswith("2 recordings of 8 pictures, ")
    shutil.copytree(tmp_path / "all", tmp_path / "elsewhere")
    shutil.copytree(tmp_path / "all/a", tmp_path / "elsewhere/.unfinished")
    for name in ("depth/.DS_Store", "depth/._000000.png"):  # macOS lays them there
        (tmp_path / "elsewhere/b" / name).write_bytes(b"\0")
    assert contents(tmp_path / "elsewhere") == first
    seen = Recording.open(tmp_path / "elsewhere/b")
    assert len(seen) == depth_picture_count([seen.path]) == 4 and not seen.skipped
    assert contents(tmp_path / "all/a") == contents(tmp_path / "elsewhere/a")
    _write(tmp_path / "elsewhere" / "c", frames=1)
    assert contents(tmp_path / "elsewhere").startswith("3 recordings of 9 pictures, ")
    set_meta(tmp_path / "all" / "a", fx_px=21.0)
    assert contents(tmp_path / "all") != first


def test_a_generator_s_recordings_are_part_of_what_it_is_made_from(tmp_path, monkeypatch):
    given = []
    monkeypatch.setattr(pipeline, "make", lambda *_, inputs, **__: given.append(inputs))
    for name in ("a", "b"):
        _write(tmp_path / "all" / name)
        DDGFit(config=PRESETS["debug"], out=tmp_path / "run", data=tmp_path / "all").run()
    assert given[0]["data"] == given[1]["data"]
    assert given[0]["recordings"] != given[1]["recordings"]


def test_interrupted_writer_keeps_the_previous_recording(tmp_path):
    path = _write(tmp_path / "a", frames=2)
    with pytest.raises(KeyboardInterrupt), RecordingWriter(path, {}) as writer:
        writer.add(*_frame(0))
        raise KeyboardInterrupt
    assert [p.name for p in tmp_path.iterdir()] == ["a"]
    assert len(Recording.open(path)) == 2


def test_what_is_no_recording_is_not_to_be_replaced_by_one(tmp_path):
    notes = tmp_path / "a" / "notes.txt"
    notes.parent.mkdir()
    notes.write_text("mine")
    with pytest.raises(UserError, match=r"a is no recording \(meta.json is missing\): move it"):
        check_place(tmp_path / "a")
    (tmp_path / "b").write_text("mine")
    (tmp_path / "c").symlink_to(tmp_path / "nowhere")
    for name, kind in (("b", "no folder"), ("c", "a link to nothing")):
        with pytest.raises(UserError, match=f"{name} is {kind}: delete it"):
            check_place(tmp_path / name)
    (tmp_path / "empty").mkdir()
    check_place(tmp_path / "empty")
    check_place(_write(tmp_path / "again"))


def test_frames_that_come_but_once_are_not_recorded_over(tmp_path):
    """By whichever command: a killed import's come again, a killed camera's do not."""
    for name, keep in (("import", False), ("live", True)):
        killed = RecordingWriter(tmp_path / name, {}, keep=keep)
        killed.__enter__()
        killed.add(*_frame(1))
        killed._alone.close()  # as the system does
    assert len(Recording.open(_write(tmp_path / "import", frames=2))) == 2
    for _ in range(2):
        with pytest.raises(UserError, match=r"\.live\.partial has 1 frames of a recording that did not end"):
            _write(tmp_path / "live")
    assert len(list((tmp_path / ".live.partial" / "depth").iterdir())) == 1


def test_two_writers_of_one_name_do_not_meet(tmp_path):
    path = tmp_path / "take"
    with RecordingWriter(path, {}) as first:
        first.add(*_frame(1))
        with pytest.raises(UserError, match="take is being recorded by another process: choose another name"):
            _write(path)
        first.add(*_frame(2))
    assert len(Recording.open(path)) == 2 and [p.name for p in tmp_path.iterdir()] == ["take"]


@pytest.mark.parametrize("step", ["_write", "replace_folder"])
def test_a_recording_that_cannot_be_ended_leaves_what_was_there_and_nothing_else(tmp_path, monkeypatch, step):
    path = _write(tmp_path / "a", frames=2)

    def fail(*_: object, sync: bool = False) -> None:
        if sync or step == "replace_folder":
            raise OSError(28, "No space left on device")
        (tmp_path / ".a.partial" / "depth" / "000000.png").touch()

    with pytest.raises(OSError, match="No space left"), RecordingWriter(path, {}) as writer:
        writer.add(*_frame(0))
        monkeypatch.setattr(writer_module, step, fail)
    assert [p.name for p in tmp_path.iterdir()] == ["a"] and len(Recording.open(path)) == 2


def test_what_a_killed_process_of_the_same_number_left_costs_no_recording(tmp_path):
    path = _write(tmp_path / "a", frames=2)
    old = tmp_path / f"{TEMPORARY}{os.getpid()}-old-a"
    shutil.copytree(path, old)
    assert len(Recording.open(_write(path, frames=3))) == 3
    assert [p.name for p in tmp_path.iterdir()] == ["a"]


def test_a_writer_whose_folder_ends_as_it_waits_for_it_makes_its_own(tmp_path, monkeypatch):
    first, alone_in = RecordingWriter(tmp_path / "a", {}), writer_module.alone_in
    first.__enter__()
    first.add(*_frame(1))

    def late(folder):
        monkeypatch.setattr(writer_module, "alone_in", alone_in)
        first.__exit__(None, None, None)
        return alone_in(folder)

    monkeypatch.setattr(writer_module, "alone_in", late)
    with RecordingWriter(tmp_path / "a", {}) as second:
        for number in range(2):
            second.add(*_frame(number))
        assert len(Recording.open(tmp_path / "a")) == 1
    assert len(Recording.open(tmp_path / "a")) == 2


def test_what_a_killed_writer_left_is_not_part_of_the_next(tmp_path):
    for folder in ("color", "depth"):
        (tmp_path / ".a.partial" / folder).mkdir(parents=True)
        (tmp_path / ".a.partial" / folder / "000007.png").write_bytes(b"old")
    assert len(Recording.open(_write(tmp_path / "a", frames=2))) == 2
    assert not list((tmp_path / "a").glob("*/000007.png"))


def test_writer_replaces_and_hides_until_complete(tmp_path):
    path = _write(tmp_path / "a", frames=2)
    with RecordingWriter(path, {}) as writer:
        writer.add(*_frame(3))
        assert [r.name for r in find_recordings(tmp_path)] == ["a"]
        assert len(find_recordings(tmp_path)[0]) == 2
    assert len(Recording.open(path)) == 1
    assert [p.name for p in tmp_path.iterdir()] == ["a"]


def test_pictures_are_on_the_disk_before_the_file_that_says_they_are_all_there(tmp_path, monkeypatch):
    synced, on_disk = [], os.sync

    def sync() -> None:
        synced.append(sorted(path.name for path in tmp_path.rglob("*") if path.is_file()))
        on_disk()

    monkeypatch.setattr(os, "sync", sync)
    path = _write(tmp_path / "a", frames=2)
    pictures = sorted(place.name for place in path.glob("*/*"))
    assert len(pictures) == 4
    assert [[name for name in names if name[0] == "0"] for names in synced] == [pictures]
    assert "meta.json" not in synced[0]


def test_damaged_frames_are_named_and_the_rest_stays_readable(tmp_path):
    path = _write(tmp_path / "a", frames=7)
    truncated = path / "depth" / "000001.png"
    truncated.write_bytes(truncated.read_bytes()[:-30])
    flipped = path / "depth" / "000002.png"
    data = bytearray(flipped.read_bytes())
    data[len(data) // 2] ^= 0xFF
    flipped.write_bytes(data)
    (path / "color" / "000003.jpg").unlink()
    jpeg = path / "color" / "000004.jpg"
    jpeg.write_bytes(jpeg.read_bytes()[:100])
    _replace_depth(path, 5, np.zeros((24, 32), np.uint16))
    recording = Recording.open(path)
    assert [f.stem for f in recording.depth_files] == ["000000", "000006"]
    assert [s.file.stem for s in recording.skipped] == ["000001", "000002", "000003", "000004", "000005"]
    assert [s.reason.split()[-1] for s in recording.skipped] == [
        "corrupt",
        "corrupt",
        "missing",
        "corrupt",
        "pixel",
    ]
    assert "left out 5 of 7 frames" in recording.skipped_summary()
    np.testing.assert_array_equal(recording.depth_mm(1), _frame(6)[1])


@pytest.mark.parametrize(
    ("damaged", "consecutive"), [((), True), ((6, 7), True), ((11,), True), ((9,), False), ((6, 10), False)]
)
def test_a_frame_that_is_left_out_between_others_ends_consecutive_frames(tmp_path, damaged, consecutive):
    path = _write(tmp_path / "a", frames=6)
    for index in range(6):  # 6 to 11: in the order of letters 10 comes first
        (path / "depth" / f"{index:06d}.png").rename(path / "depth" / f"{index + 6}.png")
        (path / "color" / f"{index:06d}.jpg").rename(path / "color" / f"{index + 6}.jpg")
    for index in damaged:
        (path / "color" / f"{index}.jpg").unlink()
    assert Recording.open(path).consecutive == consecutive
    if consecutive:  # one that somebody took away, as is advised of pictures that cannot be read
        for kept in (path / "depth" / "9.png", path / "color" / "9.jpg"):
            kept.unlink()
        assert not Recording.open(path).consecutive
    set_meta(path, consecutive_frames=False)
    assert not Recording.open(path).consecutive


@pytest.mark.parametrize("suffix", [".jpeg", ".JPG", ".JPEG", ".PNG"])
def test_colour_has_the_suffixes_that_can_be_imported(tmp_path, suffix):
    path = _write(tmp_path / "a", frames=3)
    for file in sorted((path / "color").iterdir()):
        named = file.with_suffix(suffix)
        if suffix == ".PNG":
            named.write_bytes(cv2.imencode(".png", cv2.imread(str(file)))[1].tobytes())
        else:
            shutil.copy(file, named)
        file.unlink()
    recording = Recording.open(path)
    assert len(recording) == 3 and not recording.skipped
    assert abs(int(recording.rgb(2)[0, 0, 0]) - 80) <= 2
    (path / "color" / f"000001{suffix}").write_bytes(b"cut off")
    assert [str(frame) for frame in Recording.open(path).skipped] == [
        f"000001.png: colour picture 000001{suffix} is truncated or corrupt"
    ]


@pytest.mark.parametrize("names", [("8", "9", "10", "100"), ("9.25", "9.5", "10", "10.125")])
def test_frames_are_in_time_order_whatever_their_names_widths(tmp_path, names):
    path = _write(tmp_path / "a", frames=len(names))
    for index, name in enumerate(names):
        _replace_depth(path, index, np.full((24, 32), 600 + index, np.uint16))
        (path / "depth" / f"{index:06d}.png").rename(path / "depth" / f"{name}.png")
        (path / "color" / f"{index:06d}.jpg").rename(path / "color" / f"{name}.jpg")
    read = Recording.open(path)
    assert [int(read.depth_mm(i).max()) for i in range(len(read))] == [600, 601, 602, 603]


@pytest.mark.parametrize(
    ("image", "message"),
    [
        (np.full((24, 32), 200, np.uint8), "000002.png: depth is a 8-bit grey PNG"),
        (np.full((24, 32, 3), 200, np.uint16), "000002.png: depth is a 16-bit colour PNG"),
        (np.full((12, 16), 800, np.uint16), "000002.png: depth is 16x12, the frames before it 32x24"),
    ],
)
def test_wrong_type_or_size_is_refused_by_name(tmp_path, image, message):
    path = _write(tmp_path / "a")
    _replace_depth(path, 2, image)
    with pytest.raises(UserError, match=message) as error:
        Recording.open(path)
    assert "\n" not in str(error.value)


def test_float_depth_is_refused(tmp_path):
    path = _write(tmp_path / "a")
    np.save(path / "depth" / "000009.npy", np.ones((24, 32), np.float32))
    with pytest.raises(UserError, match=r"000009.npy: depth as .npy; expected 16-bit PNG"):
        Recording.open(path)


@pytest.mark.parametrize(("factor", "message"), [(10.0, "finer unit"), (0.001, "metres"), (0.1, None)])
def test_unit_that_cannot_be_is_refused(tmp_path, factor, message):
    path = _write(tmp_path / "a")
    for index in range(4):
        _replace_depth(path, index, np.rint(_frame(index)[1] * factor).astype(np.uint16))
    if message is None:  # 0.1: half a metre to 1.5 m would read 5 to 15 cm, which a close-up could be
        assert len(Recording.open(path)) == 4
        return
    with pytest.raises(UserError, match=message):
        Recording.open(path)


@pytest.mark.parametrize(("counts", "unit_m"), [(9, 1e-5), (60_000, 1e-2)])
def test_a_unit_that_leaves_no_depth_is_refused_in_one_line(tmp_path, counts, unit_m):
    path = _write(tmp_path / "a")
    for index in range(4):
        _replace_depth(path, index, np.full((24, 32), counts, np.uint16))
    set_meta(path, depth_unit_m=unit_m)
    with pytest.raises(UserError, match=f"a: with depth_unit_m {unit_m:g} no pixel of 4 of its") as error:
        Recording.open(path)
    assert "\n" not in str(error.value)


def test_declared_unit_is_converted_to_millimetres(tmp_path):
    path = _write(tmp_path / "a")
    for index in range(4):
        _replace_depth(path, index, _frame(index)[1] * 10)
    set_meta(path, depth_unit_m=0.0001)
    np.testing.assert_array_equal(Recording.open(path).depth_mm(1), _frame(1)[1])


def test_depth_in_metres_is_as_fine_as_the_declared_unit(tmp_path):
    path = _write(tmp_path / "a")
    counts = np.full((24, 32), 9004, np.uint16)
    counts[0, :3] = 0, 4, 9006  # 4 is less than half a millimetre: a hole in millimetres, so one in metres
    for index in range(4):
        _replace_depth(path, index, counts)
    set_meta(path, depth_unit_m=0.0001)
    recording = Recording.open(path)
    assert recording.depth_mm(0)[0, :4].tolist() == [0, 0, 901, 900]
    np.testing.assert_allclose(recording.depth_m(0)[0, :4], [0, 0, 0.9006, 0.9004], rtol=1e-6)
    assert recording.depth_m(0).dtype == np.float32
    set_meta(path, depth_unit_m=0.0002)
    assert Recording.open(path).depth_m(0)[1, 1] == np.float32(1.8008)


@pytest.mark.parametrize("value", [None, "mm", 1.0])
def test_undeclared_unit_is_refused(tmp_path, value):
    path = _write(tmp_path / "a")
    set_meta(path, depth_unit_m=value)
    with pytest.raises(UserError, match="depth_unit_m is"):
        Recording.open(path)


@pytest.mark.parametrize(
    "fields",
    [
        {"fx_px": "382.7"},
        {"fx_px": -382.7},
        {"baseline_m": True},
        {"consecutive_frames": "false"},
        {"hz": 0},
    ],
)
def test_fields_of_another_kind_are_refused(tmp_path, fields):
    path = _write(tmp_path / "a")
    set_meta(path, **fields)
    with pytest.raises(UserError, match=f"meta.json: {next(iter(fields))} is "):
        Recording.open(path)


def test_find_recordings_errors_name_the_folder(tmp_path):
    with pytest.raises(UserError, match="no such folder"):
        find_recordings(tmp_path / "missing")
    with pytest.raises(UserError, match="no recording in it"):
        find_recordings(tmp_path)
    path = _write(tmp_path / "a")
    (path / "meta.json").unlink()
    with pytest.raises(UserError, match="meta.json is missing"):
        find_recordings(path)


def test_writer_refuses_metres(tmp_path):
    with pytest.raises(UserError, match="got float32"), RecordingWriter(tmp_path / "a", {}) as writer:
        writer.add(_frame(0)[0], np.ones((24, 32), np.float32))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.skipif(not REAL.is_dir(), reason="shared/real_depth is not beside this checkout")
def test_real_recordings_load():
    recordings = {r.name: r for r in find_recordings(REAL)}
    assert {name: len(r) for name, r in recordings.items()} == {
        "d435_boxes": 10,
        "d435_cleargrasp": 8,
        "d435_librealsense": 2,
        "d435_mobile_robot": 120,
    }
    for recording in recordings.values():
        assert not recording.skipped
        assert (recording.height_px, recording.width_px) == (
            recording.meta["height"],
            recording.meta["width"],
        )
    robot = recordings["d435_mobile_robot"]
    invalid = np.mean([np.mean(robot.depth_mm(i) == 0) for i in range(0, 120, 4)])
    assert abs(invalid - robot.meta["invalid_fraction_mean"]) < 0.01


@pytest.mark.skipif(not REAL.is_dir(), reason="shared/real_depth is not beside this checkout")
def test_truncated_copy_of_a_real_recording_stays_readable(tmp_path):
    shutil.copytree(REAL / "d435_boxes", tmp_path / "boxes")
    for file in ("000002.png", "000005.png"):
        path = tmp_path / "boxes" / "depth" / file
        path.write_bytes(path.read_bytes()[:5000])
    recording = Recording.open(tmp_path / "boxes")
    assert len(recording) == 8 and len(recording.skipped) == 2


def test_recording_of_another_contract_version_is_refused(tmp_path):
    path = _write(tmp_path / "a")
    set_meta(path, contract_version=99)
    with pytest.raises(UserError, match="contract version 99, this code has"):
        Recording.open(path)
