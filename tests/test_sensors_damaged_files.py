"""Files of a recording that claim what they do not hold, or are no files: named, never waited for."""

import os
import signal
import struct
from pathlib import Path

import cv2
import numpy as np
import pytest

from app.commands import parse
from ddgrasp.errors import UserError
from recording_support import claiming, png, write_depth
from sensors.recordings import integrity
from sensors.recordings.pictures import decoded
from sensors.recordings.recording import Recording, contents, find_recordings

TOO_MANY = claiming(70_000, 70_000)
"""More than OpenCV's 2^30 pixels."""


def _depth(frame: int) -> np.ndarray:
    return np.random.default_rng(frame).integers(500, 1500, (24, 32)).astype(np.uint16)


def _folder(root: Path, frames: int = 3) -> Path:
    """Depth and colour to be imported."""
    for i in range(frames):
        for name, picture in (("depth", _depth(i)), ("color", np.full((24, 32, 3), 10 * i, np.uint8))):
            (root / name).mkdir(parents=True, exist_ok=True)
            assert cv2.imwrite(str(root / name / f"{i:06d}.png"), picture)
    return root


def _imported(root: Path) -> Recording:
    parse("record import", [str(root), "--out", str(root.parent / "out")]).run()
    return Recording.open(root.parent / "out" / root.name)


def test_what_cannot_be_decoded_is_none():
    for data in (b"", b"no picture", TOO_MANY, png(b"\0")):
        assert decoded(data, cv2.IMREAD_UNCHANGED) is None
    whole = cv2.imencode(".png", _depth(0))[1].tobytes()
    np.testing.assert_array_equal(decoded(whole, cv2.IMREAD_UNCHANGED), _depth(0))


@pytest.mark.parametrize("folder", ["depth", "color"])
def test_a_picture_to_import_that_claims_too_much_is_left_out(tmp_path, folder):
    root = _folder(tmp_path / "desk")
    (root / folder / "000001.png").write_bytes(TOO_MANY)
    assert len(_imported(root)) == 2


@pytest.mark.parametrize(
    "data",
    [TOO_MANY, claiming(20_000, 20_000), png(b"\0"), png(b"")],
    ids=["beyond OpenCV", "400 Mpx", "short header", "no header"],
)
def test_a_depth_picture_of_no_camera_s_size_is_left_out(tmp_path, data):
    """Without a look at its pixels: a file of 800 kB may be 1.6 GB of them."""
    path = write_depth(tmp_path / "a", [_depth(i) for i in range(3)])
    (path / "depth" / "000001.png").write_bytes(data)
    recording = Recording.open(path)
    assert len(recording) == 2
    assert [frame.reason for frame in recording.skipped] == ["depth picture is truncated or corrupt"]


def test_as_many_pixels_as_a_camera_may_have_are_read():
    header = struct.pack(">IIBBBBB", 8000, 8000, 16, 0, 0, 0, 0)
    assert integrity._png_header(png(header)) == (8000, 8000, 16, 0)


@pytest.mark.parametrize("folder", ["depth", "color"])
def test_pictures_that_claim_too_much_once_a_recording_is_open_are_named(tmp_path, folder):
    recording = Recording.open(write_depth(tmp_path / "a", [_depth(0)]))
    files = recording.depth_files if folder == "depth" else recording.color_files
    files[0].write_bytes(TOO_MANY)
    with pytest.raises(UserError, match=f"{folder}/000000.* cannot be decoded"):
        recording.depth_mm(0) if folder == "depth" else recording.rgb(0)


def test_names_that_are_no_utf8_are_told_apart_and_others_keep_their_hash(tmp_path):
    folder = write_depth(tmp_path / "a" / "tür", [_depth(0)])
    (folder / "meta.json").write_text('{"depth_unit_m": 0.001}')
    assert contents(tmp_path / "a") == "1 recordings of 1 pictures, 6b0bfebe"
    told = set()
    for name in (b"\xff", b"\xfe"):
        folder = folder.rename(os.fsdecode(bytes(tmp_path / "a") + b"/" + name))
        assert len(find_recordings(tmp_path / "a")[0].rgb(0)) == 24
        told.add(contents(tmp_path / "a"))
    assert len(told) == 2


@pytest.fixture
def soon():
    """Fails what takes 20 s: a pipe without a writer is waited for until a signal comes."""

    def waited(*_) -> None:
        raise AssertionError("waited")

    before = signal.signal(signal.SIGALRM, waited)
    signal.alarm(20)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)


@pytest.mark.parametrize("name", ["depth/000001.png", "depth/000001.npy", "color/000001.png"])
def test_a_pipe_among_the_pictures_is_not_waited_for(tmp_path, soon, name):
    root = _folder(tmp_path / "desk")
    (root / name).with_suffix(".png").unlink()
    os.mkfifo(root / name)
    assert len(_imported(root)) == 2
