"""Recordings from elsewhere: what is kept, what is named and left out, what is refused."""

import json
import shutil
import struct
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from app.commands import parse
from ddgrasp.contract import CONTRACT_VERSION
from ddgrasp.errors import UserError
from realsense_support import full_after
from sensors.recordings import folders, importers
from sensors.recordings import writer as writing
from sensors.recordings.recording import Recording

SIZE = (24, 32)


def depth_mm(frame: int, size=SIZE) -> np.ndarray:
    depth = np.random.default_rng(frame).integers(500, 1500, size).astype(np.uint16)
    depth[:2] = 0
    return depth


def make_folder(root: Path, frames: int = 4, color: str = "rgb") -> Path:
    (root / "depth").mkdir(parents=True)
    (root / color).mkdir()
    for i in range(frames):
        assert cv2.imwrite(str(root / "depth" / f"{i:04d}_depth.png"), depth_mm(i))
        assert cv2.imwrite(str(root / color / f"{i:04d}_rgb.png"), np.full((*SIZE, 3), 10 * i, np.uint8))
    return root


def run(*args) -> None:
    parse("record import", [str(a) for a in args]).run()


def test_folder_becomes_a_recording(tmp_path, capsys):
    make_folder(tmp_path / "desk")
    run(tmp_path / "desk", "--out", tmp_path / "out", "--sensor", "D435", "--fx-px", "380", "--consecutive")
    recording = Recording.open(tmp_path / "out" / "desk")
    assert len(recording) == 4 and recording.consecutive and recording.fx_px == 380.0
    np.testing.assert_array_equal(recording.depth_mm(2), depth_mm(2))
    assert recording.rgb(3)[0, 0, 0] == 30
    assert not any("pose" in key or "serial" in key for key in recording.meta)
    assert (
        capsys.readouterr()
        .out.splitlines()[-1]
        .startswith("1 recordings with 4 frames imported; left out: 0 frames")
    )


@pytest.mark.parametrize("unit_m", [0.001, 0.0005])
def test_the_largest_number_is_no_reading(tmp_path, capsys, unit_m):
    root = make_folder(tmp_path / "desk", frames=2)
    depth = depth_mm(1)
    depth[5:8, 10:20] = 65535
    assert cv2.imwrite(str(root / "depth" / "0001_depth.png"), depth)
    run(root, "--out", tmp_path / "out", "--depth-unit-m", unit_m)
    kept = Recording.open(tmp_path / "out" / "desk").depth_mm(1)
    assert not kept[5:8, 10:20].any() and kept[9].all() and kept.max() <= 1500
    assert "30 pixels of 65535, the largest number, have no reading now" in capsys.readouterr().out


def test_colour_of_a_lens_of_its_own_is_called_so(tmp_path):
    make_folder(tmp_path / "desk")
    run(tmp_path / "desk", "--out", tmp_path / "out", "--no-aligned")
    assert not Recording.open(tmp_path / "out" / "desk").color_aligned
    run(tmp_path / "desk", "--out", tmp_path / "beside")
    assert Recording.open(tmp_path / "beside" / "desk").color_aligned


def test_colour_of_another_shape_is_not_called_aligned(tmp_path, capsys):
    root = make_folder(tmp_path / "desk", frames=1)
    for size, told in (((2 * SIZE[0], 2 * SIZE[1]), False), ((SIZE[0], 2 * SIZE[1]), True)):
        assert cv2.imwrite(str(root / "rgb" / "0000_rgb.png"), np.zeros((*size, 3), np.uint8))
        run(root, "--out", tmp_path / f"out{told}")
        assert Recording.open(tmp_path / f"out{told}" / "desk").color_aligned is not told
        assert ("colour of 64x24 beside depth of 32x24 is not aligned" in capsys.readouterr().out) == told
    run(root, "--out", tmp_path / "known", "--no-aligned")
    assert "beside depth of" not in capsys.readouterr().out


def test_bad_frames_are_named_and_counted(tmp_path, capsys):
    root = make_folder(tmp_path / "desk", frames=7)
    (root / "depth" / "0006_depth.png").unlink()
    (root / "depth" / "0006_depth.png").mkdir()
    cv2.imwrite(str(root / "depth" / "0001_depth.png"), depth_mm(1, (30, 40)))
    cv2.imwrite(str(root / "depth" / "0002_depth.png"), np.zeros(SIZE, np.uint16))
    (root / "rgb" / "0003_rgb.png").unlink()
    (root / "depth" / "0004_depth.png").write_bytes(b"\x89PNG damaged")
    cv2.imwrite(str(root / "depth" / "0005_depth.png"), np.zeros(SIZE, np.uint8))
    run(root, "--out", tmp_path / "out")
    shown = capsys.readouterr().out
    for name, reason in (
        ("0001", "depth is 40x30, the others' 32x24"),
        ("0002", "no valid depth pixel"),
        ("0003", "colour is missing"),
        ("0004", "depth cannot be read"),
        ("0005", "depth is uint8"),
        ("0006", "depth cannot be read"),
    ):
        assert any(name in line and reason in line for line in shown.splitlines()), name
    assert shown.splitlines()[-1] == "1 recordings with 1 frames imported; left out: 6 frames, 0 recordings"


def test_an_odd_first_frame_is_the_one_that_is_left_out(tmp_path, capsys):
    root = make_folder(tmp_path / "desk", frames=5)
    cv2.imwrite(str(root / "depth" / "0000_depth.png"), depth_mm(0, (30, 40)))
    run(root, "--out", tmp_path / "out")
    assert "0000_depth.png: depth is 40x30, the others' 32x24" in capsys.readouterr().out
    assert len(Recording.open(tmp_path / "out" / "desk")) == 4


def test_pictures_in_another_unit_than_most_are_left_out_unless_one_is_given(tmp_path, capsys):
    root = make_folder(tmp_path / "desk", frames=5)
    (root / "depth" / "0001_depth.png").unlink()
    np.save(root / "depth" / "0001_depth.npy", depth_mm(1).astype(np.float32) / 1000)
    run(root, "--out", tmp_path / "out")
    assert "0001_depth.npy: depth is float32, the others' integers: in another" in capsys.readouterr().out
    np.testing.assert_array_equal(Recording.open(tmp_path / "out" / "desk").depth_mm(1), depth_mm(2))
    np.save(root / "depth" / "0001_depth.npy", depth_mm(1).astype(np.float32))
    run(root, "--out", tmp_path / "given", "--depth-unit-m", "0.001")
    np.testing.assert_array_equal(Recording.open(tmp_path / "given" / "desk").depth_mm(1), depth_mm(1))


@pytest.mark.parametrize(
    ("folder", "other"), [("depth", "0001_depth.tif"), ("depth", "0001.png"), ("rgb", "0001_rgb.jpg")]
)
def test_two_pictures_of_one_moment_are_refused(tmp_path, folder, other):
    root = make_folder(tmp_path / "desk", frames=2)
    file = next((root / folder).glob("0001*.png"))
    (root / folder / other).write_bytes(file.read_bytes())
    with pytest.raises(UserError, match=r"0001\S+ and 0001\S+ have one name: keep pictures of one type"):
        run(root, "--out", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_pictures_for_people_beside_depth_are_passed_over(tmp_path):
    root = make_folder(tmp_path / "desk", frames=3)
    for file in (root / "depth").glob("*.png"):
        np.save(file.with_suffix(".npy"), cv2.imread(str(file), cv2.IMREAD_UNCHANGED))
        cv2.imwrite(str(file), np.full(SIZE, 7, np.uint8))
    run(root, "--out", tmp_path / "out", "--consecutive")
    recording = Recording.open(tmp_path / "out" / "desk")
    assert len(recording) == 3 and recording.consecutive
    np.testing.assert_array_equal(recording.depth_mm(2), depth_mm(2))


def test_of_many_pictures_a_few_say_of_which_size_and_unit_they_are(tmp_path, capsys):
    root = make_folder(tmp_path / "desk", frames=20)
    cv2.imwrite(str(root / "depth" / "0000_depth.png"), depth_mm(0, (30, 40)))
    for frame in (3, 6):
        (root / "depth" / f"{frame:04d}_depth.png").unlink()
        np.save(root / "depth" / f"{frame:04d}_depth.npy", depth_mm(frame).astype(np.float32) / 1000)
    run(root, "--out", tmp_path / "out")
    assert len(Recording.open(tmp_path / "out" / "desk")) == 17
    assert capsys.readouterr().out.count("the others' integers") == 2


def test_an_empty_colour_folder_is_passed_over_for_one_with_pictures(tmp_path):
    root = make_folder(tmp_path / "desk", frames=2)
    (root / "color").mkdir()
    run(root, "--out", tmp_path / "out")
    assert len(Recording.open(tmp_path / "out" / "desk")) == 2


def test_two_sources_of_one_name_do_not_call_each_other_made_before(tmp_path):
    source = folders.folder_source(make_folder(tmp_path / "walk"), 0.0, {})
    twice = [replace(source, path=tmp_path / f"walk{suffix}") for suffix in (".bag", ".db3")]
    done, refused = importers.import_all(twice, tmp_path / "out")
    assert (
        len(done) == 1 and [line for line in refused if "another one here is called walk" in line] == refused
    )
    assert refused[0].startswith(str(tmp_path / "walk.db3"))
    empty = replace(twice[0], frames=lambda: iter(()))
    done, refused = importers.import_all([empty, twice[1]], tmp_path / "second")
    assert len(done) == 1 and "it is empty" in refused[0], "one that was refused has taken no name"


def test_a_telephone_that_was_held_upright_turns_no_colour(tmp_path):
    root = make_folder(tmp_path / "desk", frames=1)
    (root / "rgb" / "0000_rgb.png").unlink()
    jpeg = cv2.imencode(".jpg", np.zeros((*SIZE, 3), np.uint8))[1].tobytes()
    turned = b"Exif\0\0II*\0" + struct.pack("<IHHHIII", 8, 1, 0x0112, 3, 1, 6, 0)  # orientation 6
    exif = b"\xff\xe1" + struct.pack(">H", len(turned) + 2) + turned
    (root / "rgb" / "0000_rgb.jpg").write_bytes(jpeg[:2] + exif + jpeg[2:])
    assert cv2.imread(str(root / "rgb" / "0000_rgb.jpg")).shape[:2] == SIZE[::-1]
    run(root, "--out", tmp_path / "out")
    shutil.copy(root / "rgb" / "0000_rgb.jpg", tmp_path / "out" / "desk" / "color" / "000000.jpg")
    recording = Recording.open(tmp_path / "out" / "desk")
    assert recording.color_aligned and recording.rgb(0).shape[:2] == SIZE


@pytest.mark.parametrize(("lost", "consecutive"), [((0, 1), True), ((5,), True), ((2,), False)])
def test_frames_with_a_gap_between_them_are_not_consecutive(tmp_path, lost, consecutive):
    root = make_folder(tmp_path / "desk", frames=6)
    for frame in lost:
        (root / "rgb" / f"{frame:04d}_rgb.png").unlink()
    run(root, "--out", tmp_path / "out", "--consecutive")
    assert Recording.open(tmp_path / "out" / "desk").consecutive == consecutive


def test_what_is_passed_over_is_named(tmp_path, capsys, monkeypatch):
    make_folder(tmp_path / "all" / "desk")
    (make_folder(tmp_path / "all" / "grey") / "rgb").rename(tmp_path / "elsewhere")
    run(tmp_path / "all", "--out", tmp_path / "out")
    shown = capsys.readouterr().out
    assert f"{tmp_path / 'all' / 'grey'}: depth/ without one of color/" in shown
    assert "left out: 0 frames, 1 recordings" in shown
    (tmp_path / "all" / "a.bag").touch()
    source = folders.folder_source(tmp_path / "all" / "desk", 0.0, {})
    monkeypatch.setattr("sensors.recordings.realsense.file_source", lambda file: source)
    _, refused = importers.find_sources(tmp_path / "all", 0.0, {})
    assert refused == [f"{tmp_path / 'all' / 'desk'}: pictures beside RealSense files: import it by itself."]


def test_float_depth_is_metres_unless_its_size_says_otherwise(tmp_path):
    root = make_folder(tmp_path / "desk")
    for i, file in enumerate(sorted((root / "depth").iterdir())):
        np.save(file.with_suffix(".npy"), depth_mm(i).astype(np.float32) / 1000)
        file.unlink()
    run(root, "--out", tmp_path / "out")
    np.testing.assert_array_equal(Recording.open(tmp_path / "out" / "desk").depth_mm(1), depth_mm(1))
    for i, file in enumerate(sorted((root / "depth").iterdir())):
        np.save(file, depth_mm(i).astype(np.float32))
    with pytest.raises(UserError, match="perhaps --depth-unit-m 0.001 or 0.0001"):
        run(root, "--out", tmp_path / "wrong")
    assert not (tmp_path / "wrong" / "desk").exists()
    run(root, "--out", tmp_path / "right", "--depth-unit-m", "0.001")
    np.testing.assert_array_equal(Recording.open(tmp_path / "right" / "desk").depth_mm(1), depth_mm(1))


@pytest.mark.parametrize(
    ("factor", "dtype", "unit"),
    [
        (0.1, np.float32, "0.01"),
        (10, np.uint16, "0.0001"),
        (4.0, np.float32, "0.001"),
        (0.3, np.float32, "0.001"),
    ],
)
def test_the_unit_that_is_advised_is_the_right_one(tmp_path, factor, dtype, unit):
    root = make_folder(tmp_path / "desk")
    for i, file in enumerate(sorted((root / "depth").iterdir())):
        np.save(file.with_suffix(".npy"), (depth_mm(i) * factor).astype(dtype))
        file.unlink()
    with pytest.raises(UserError, match=f"perhaps --depth-unit-m (.* or )?{unit}( or .*)?\\.$"):
        run(root, "--out", tmp_path / "wrong")
    run(root, "--out", tmp_path / "right", "--depth-unit-m", unit)
    median_mm = np.median(Recording.open(tmp_path / "right" / "desk").depth_mm(1))
    assert median_mm == pytest.approx(1000 * float(unit) * factor * np.median(depth_mm(1)), abs=1)


def test_frames_with_one_between_them_that_is_not_there_are_not_called_consecutive(tmp_path):
    root = make_folder(tmp_path / "desk", frames=5)
    run(root, "--out", tmp_path / "whole", "--consecutive")
    whole = tmp_path / "whole" / "desk"
    assert Recording.open(whole).consecutive
    for folder in ("depth", "color"):  # as a person may who looks through a recording
        next(file for file in (whole / folder).iterdir() if file.stem == "000002").unlink()
    run(whole, "--out", tmp_path / "again")
    assert not Recording.open(tmp_path / "again" / "desk").consecutive
    (root / "depth" / "0002_depth.png").unlink()
    run(root, "--out", tmp_path / "gap", "--consecutive")
    assert not Recording.open(tmp_path / "gap" / "desk").consecutive
    (root / "depth" / "0004_depth.png").unlink()
    (root / "rgb" / "0002_rgb.png").unlink()
    run(root, "--out", tmp_path / "begun", "--consecutive")  # colour goes on after the last: no gap
    assert Recording.open(tmp_path / "begun" / "desk").consecutive


@pytest.mark.parametrize("unit_m", [1.0, 0.001])
def test_what_is_lost_of_floating_point_depth_is_said_once(tmp_path, capsys, unit_m):
    root = make_folder(tmp_path / "desk")
    for i, file in enumerate(sorted((root / "depth").iterdir())):
        np.save(file.with_suffix(".npy"), (depth_mm(i).astype(np.float32) + 0.4) / 1000 / unit_m)
        file.unlink()
    run(root, "--out", tmp_path / "out", "--depth-unit-m", unit_m)
    line = f"{tmp_path / 'out' / 'desk'}: floating-point depth was rounded to whole millimetres"
    assert capsys.readouterr().out.count(line) == 1


def test_what_is_hidden_is_no_source(tmp_path, capsys, monkeypatch):
    """`.desk.partial` is a recording that is not finished, `._desk.bag` what a Mac leaves beside a file."""
    for name in ("desk", ".desk.partial"):
        make_folder(tmp_path / "all" / name)
    (make_folder(tmp_path / "all" / ".grey") / "rgb").rename(tmp_path / "elsewhere")
    run(tmp_path / "all", "--out", tmp_path / "out")
    shown = capsys.readouterr().out
    assert shown.splitlines()[-1] == "1 recordings with 4 frames imported; left out: 0 frames, 0 recordings"
    assert [p.name for p in (tmp_path / "out").iterdir()] == ["desk"]
    run(tmp_path / "all" / ".desk.partial", "--out", tmp_path / "named")
    (tmp_path / "all" / "._desk.bag").touch()
    assert len(importers.find_sources(tmp_path / "all", 0.0, {})[0]) == 1
    (tmp_path / "all" / "desk.bag").touch()
    source = folders.folder_source(tmp_path / "all" / "desk", 0.0, {})
    monkeypatch.setattr("sensors.recordings.realsense.file_source", lambda file: source)
    sources, refused = importers.find_sources(tmp_path / "all", 0.0, {})
    assert len(sources) == 1 and [line.split(":")[0] for line in refused] == [str(tmp_path / "all" / "desk")]


def test_a_recording_that_is_there_stays(tmp_path):
    root = make_folder(tmp_path / "desk", frames=2)
    run(root, "--out", tmp_path / "out")
    make_folder(tmp_path / "other" / "desk", frames=1)
    with pytest.raises(UserError, match=r"out/desk exists already: delete it, or give another --out"):
        run(tmp_path / "other", "--out", tmp_path / "out")
    assert len(Recording.open(tmp_path / "out" / "desk")) == 2


def test_what_is_not_a_number_is_a_hole(tmp_path):
    root = make_folder(tmp_path / "desk", frames=1)
    metres = depth_mm(0).astype(np.float32) / 1000
    metres[5, 5], metres[6, 6], metres[7, 7] = np.nan, np.inf, -1.0
    np.save(root / "depth" / "0000_depth.npy", metres)
    (root / "depth" / "0000_depth.png").unlink()
    source = folders.folder_source(root, 0.0, {})
    importers.import_recording(source, tmp_path / "out")
    read = Recording.open(tmp_path / "out").depth_mm(0)
    assert read[5, 5] == read[6, 6] == read[7, 7] == 0 and read[8, 8] == depth_mm(0)[8, 8]


def test_one_refused_recording_does_not_stop_the_others(tmp_path, capsys):
    make_folder(tmp_path / "all" / "a")
    empty = make_folder(tmp_path / "all" / "b", frames=1, color="color")
    cv2.imwrite(str(empty / "depth" / "0000_depth.png"), np.zeros(SIZE, np.uint16))
    run(tmp_path / "all", "--out", tmp_path / "out")
    shown = capsys.readouterr().out
    assert "refused:" in shown and "none of its 1 frames can be used" in shown
    assert shown.splitlines()[-1].endswith("left out: 0 frames, 1 recordings")
    assert [p.name for p in (tmp_path / "out").iterdir()] == ["a"]


def test_a_source_that_cannot_be_opened_does_not_stop_the_others(tmp_path, capsys):
    make_folder(tmp_path / "all" / "b")
    make_folder(tmp_path / "all" / "a", frames=0)
    run(tmp_path / "all", "--out", tmp_path / "out")
    shown = capsys.readouterr().out
    assert f"refused: {tmp_path / 'all' / 'a' / 'depth'}: no depth pictures" in shown
    assert shown.splitlines()[-1] == "1 recordings with 4 frames imported; left out: 0 frames, 1 recordings"
    with pytest.raises(UserError, match="a/depth: no depth pictures"):
        run(tmp_path / "all" / "a", "--out", tmp_path / "out")


def test_a_recording_imported_again_says_the_same_of_its_camera(tmp_path):
    root = make_folder(tmp_path / "desk", color="color")
    known = {"depth_unit_m": 0.0005, "sensor": "D435", "fx_px": 380.0, "hz": 15, "consecutive_frames": True}
    known |= {"licence": "CC BY 4.0", "source": "a kitchen"}
    (root / "meta.json").write_text(json.dumps({**known, "contract_version": -1, "frames": 3}))
    run(root, "--out", tmp_path / "out")
    again = Recording.open(tmp_path / "out" / "desk")
    assert again.meta["contract_version"] == CONTRACT_VERSION and again.meta["frames"] == 4
    assert {name: again.meta[name] for name in known} == {**known, "depth_unit_m": 0.001}
    np.testing.assert_array_equal(again.depth_mm(2), np.rint(depth_mm(2) / 2))
    run(root, "--out", tmp_path / "given", "--sensor", "D455", "--depth-unit-m", "0.001")
    given = Recording.open(tmp_path / "given" / "desk")
    assert (given.meta["sensor"], given.fx_px) == ("D455", 380.0)
    np.testing.assert_array_equal(given.depth_mm(2), depth_mm(2))


@pytest.mark.parametrize(("unit_m", "said"), [("0.0005", 1), ("0.001", 0), ("0.002", 0)])
def test_what_is_lost_of_finer_depth_is_said_once(tmp_path, capsys, unit_m, said):
    run(make_folder(tmp_path / "desk"), "--out", tmp_path / "out", "--depth-unit-m", unit_m)
    line = f"{tmp_path / 'out' / 'desk'}: depth in units of {unit_m} m was rounded to whole millimetres"
    assert capsys.readouterr().out.count(line) == said


@pytest.mark.parametrize("text", ["{", "[1]", '{"depth_unit_m": "mm"}', '{"depth_unit_m": 0}'])
def test_a_broken_meta_json_is_named(tmp_path, text):
    root = make_folder(tmp_path / "desk")
    (root / "meta.json").write_text(text)
    with pytest.raises(UserError, match="desk/meta.json: ") as refused:
        run(root, "--out", tmp_path / "out")
    assert "\n" not in str(refused.value) and not (tmp_path / "out").exists()


def test_arrays_that_are_no_numbers_are_left_out(tmp_path, capsys):
    root = make_folder(tmp_path / "desk", frames=5)
    names = sorted((root / "depth").iterdir())
    metres = depth_mm(4).astype(np.float32) / 1000
    arrays = (np.full(SIZE, "far"), metres > 1, metres.astype(complex), np.zeros(SIZE, np.int8), metres)
    for file, array in zip(names, arrays, strict=True):
        np.save(file.with_suffix(".npy"), array)
        file.unlink()
    np.savez(root / "depth" / "0005_depth", metres)
    (root / "depth" / "0005_depth.npz").rename(root / "depth" / "0005_depth.npy")
    with open(root / "depth" / "0006_depth.npy", "wb") as file:  # says more than any machine holds
        np.lib.format.write_array_header_1_0(
            file, np.lib.format.header_data_from_array_1_0(metres) | {"shape": (2**20, 2**21)}
        )
    run(root, "--out", tmp_path / "out")
    np.testing.assert_array_equal(Recording.open(tmp_path / "out" / "desk").depth_mm(0), depth_mm(4))
    shown = capsys.readouterr().out
    for kind in ("<U3", "bool", "complex128", "int8"):
        assert f"depth is {kind}" in shown, kind
    for name in ("0005", "0006"):
        assert f"left out {name}_depth.npy: depth cannot be read" in shown, name


def test_a_full_disk_leaves_nothing_of_what_can_be_imported_again(tmp_path, monkeypatch):
    root = make_folder(tmp_path / "desk")
    monkeypatch.setattr(writing, "_write", full_after(writing._write, files=4))
    with pytest.raises(OSError, match="No space left"):
        run(root, "--out", tmp_path / "out")
    assert list((tmp_path / "out").iterdir()) == []


def test_numbers_in_names_count_as_numbers(tmp_path):
    root = make_folder(tmp_path / "a", frames=0)
    for i in range(12):
        cv2.imwrite(str(root / "depth" / f"{i}.png"), np.full(SIZE, 600 + i, np.uint16))
        cv2.imwrite(str(root / "rgb" / f"{i}.png"), np.zeros((*SIZE, 3), np.uint8))
    importers.import_recording(folders.folder_source(root, 0.0, {}), tmp_path / "out")
    read = Recording.open(tmp_path / "out")
    assert [int(read.depth_mm(i).max()) for i in range(12)] == list(range(600, 612))


def test_pictures_named_by_their_times_have_the_nearest_colour(tmp_path, capsys):
    root = make_folder(tmp_path / "desk", frames=0)
    for i in range(6):  # as TUM's: seconds, the colour camera 11 ms later and once silent
        stamp = 1305031102.16 + i / 30
        cv2.imwrite(str(root / "depth" / f"{stamp:.6f}.png"), 5 * depth_mm(i))
        if i != 3:
            colour = np.full((*SIZE, 3), 10 * i, np.uint8)
            cv2.imwrite(str(root / "rgb" / f"{stamp + 0.011:.6f}.png"), colour)
    run(root, "--out", tmp_path / "out", "--depth-unit-m", "0.0002", "--consecutive")
    read = Recording.open(tmp_path / "out" / "desk")
    assert [int(read.rgb(i)[0, 0, 0]) for i in range(len(read))] == [0, 10, 20, 40, 50]
    np.testing.assert_array_equal(read.depth_mm(4), depth_mm(5))
    assert not read.consecutive
    shown = capsys.readouterr().out
    assert "colour of 5 frames is the nearest by the times in their names, up to 0.011000 away" in shown
    assert "1305031102.260000.png: colour is missing" in shown


@pytest.mark.parametrize("name", ["frame-{:06d}.{}", "{1}-{0:03d}", "{:d}"])
def test_a_pair_has_one_name_but_for_which_of_the_two_it_is(tmp_path, name):
    root = make_folder(tmp_path / "desk", frames=0)
    for i in (0, 1, 2, 10, 11):
        cv2.imwrite(str(root / "depth" / f"{name.format(i, 'depth')}.png"), depth_mm(i))
        if i != 2:
            cv2.imwrite(
                str(root / "rgb" / f"{name.format(i, 'color')}.png"), np.full((*SIZE, 3), i, np.uint8)
            )
    run(root, "--out", tmp_path / "out")
    read = Recording.open(tmp_path / "out" / "desk")
    assert [int(read.rgb(i)[0, 0, 0]) for i in range(len(read))] == [0, 1, 10, 11]


def test_a_folder_s_recording_has_its_whole_name(tmp_path, monkeypatch):
    for name in ("kitchen.1", "kitchen.2"):
        make_folder(tmp_path / "all" / name)
    run(tmp_path / "all", "--out", tmp_path / "out")
    monkeypatch.chdir(tmp_path / "all" / "kitchen.1")
    run(".", "--out", tmp_path / "here")
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == ["kitchen.1", "kitchen.2"]
    assert [p.name for p in (tmp_path / "here").iterdir()] == ["kitchen.1"]


def test_depth_that_cannot_be_is_refused_after_a_few_frames(tmp_path):
    source, read = folders.folder_source(make_folder(tmp_path / "far", frames=12), 0.0, {}), []

    def frames():
        for frame in source.frames():
            read.append(frame.name)
            yield replace(frame, depth=np.full_like(frame.depth, 7000))

    with pytest.raises(UserError, match="median depth 7 m"):
        importers.import_recording(replace(source, frames=frames), tmp_path / "out")
    assert len(read) == 5 and not (tmp_path / "out").exists()


def test_nothing_to_import_is_one_line(tmp_path):
    (tmp_path / "empty").mkdir()
    (tmp_path / "film.mp4").write_bytes(b"")
    for path, message in (
        (tmp_path / "none", "no such file or folder"),
        (tmp_path / "empty", "no depth/ beside one of color/"),
        (tmp_path / "film.mp4", "expected a RealSense .bag"),
    ):
        with pytest.raises(UserError, match=message):
            run(path, "--out", tmp_path / "out")


def test_bag_needs_pyrealsense2(tmp_path, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "pyrealsense2", None)
    (tmp_path / "a.bag").write_bytes(b"")
    with pytest.raises(UserError, match="needs pyrealsense2"):
        run(tmp_path / "a.bag", "--out", tmp_path / "out")
