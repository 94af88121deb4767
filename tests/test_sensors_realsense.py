"""RealSense files into recordings, through librealsense where it is installed."""

import sys
from pathlib import Path

import numpy as np
import pytest

from ddgrasp.commands import parse
from ddgrasp.errors import UserError
from realsense_support import FX_PX, NAME, SoftwareCamera, depth_mm
from sensors.realsense import file_source
from sensors.recordings import Recording


@pytest.fixture
def rs():
    """The real library; its wheel loads only where libusb is."""
    return pytest.importorskip("pyrealsense2", exc_type=ImportError)


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
        SoftwareCamera(rs).write(file, 20)
    except RuntimeError:  # newer versions read .bag, but write .db3 alone
        file = tmp_path / "desk.db3"
        SoftwareCamera(rs).write(file, 20)
    parse("record import", [str(file), "--out", str(tmp_path / "out")]).run()
    numbers = numbers_in(tmp_path / "out" / "desk")
    # librealsense's pipeline leaves out a .bag's first frame.
    assert numbers == list(range(1 if file.suffix == ".db3" else numbers[0], 21)) and len(numbers) >= 19
    meta = Recording.open(tmp_path / "out" / "desk").meta
    assert (meta["sensor"], meta["fx_px"], meta["baseline_m"], meta["hz"]) == (NAME, FX_PX, 0.095, 30)
    assert meta["consecutive_frames"] and not meta["color_aligned_to_depth"]
    assert capsys.readouterr().out.splitlines()[-1].endswith("left out: 0 frames, 0 recordings")


def test_a_missing_library_names_the_remedy(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pyrealsense2", None)
    with pytest.raises(UserError, match=r"needs pyrealsense2 .* pip install -e '\.\[realsense\]'"):
        file_source(tmp_path / "a.bag")
    monkeypatch.delitem(sys.modules, "pyrealsense2")
    (tmp_path / "path").mkdir()
    (tmp_path / "path" / "pyrealsense2.py").write_text("raise ImportError('libusb-1.0.so.0: cannot open')")
    monkeypatch.syspath_prepend(tmp_path / "path")
    with pytest.raises(UserError, match=r"cannot be loaded \(libusb-1.0.so.0.*apt install libusb-1.0-0"):
        file_source(tmp_path / "a.bag")
