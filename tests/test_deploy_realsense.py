"""The RealSense's camera and imager before a scripted library: begun, read, ended, and gone wrong."""

import re
from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from ddgrasp import contract
from ddgrasp.errors import UserError
from deploy.clock import SimClock
from deploy.devices.realsense_camera import RealSenseCamera
from deploy.devices.realsense_imager import SKIPPED, RealSenseImager
from deploy.interfaces import CameraError
from realsense_support import FX_PX, SERIAL, SIZE, depth_mm, rgb
from realsense_support import scripted as script

STREAM = replace(
    contract.D455_STREAM, width_px=SIZE[1], height_px=SIZE[0], fx_px=FX_PX, fy_px=FX_PX, cx_px=SIZE[1] / 2,
    cy_px=SIZE[0] / 2,
)  # fmt: skip
TIMEOUT = RuntimeError("Frame didn't arrive within 200")
UNPLUGGED = "No device connected"


@pytest.fixture
def scripted(monkeypatch):
    """Makes the library that drivers load."""
    return lambda *numbers, **how: script(monkeypatch, numbers, **how)


def camera(serial: str = "", say: Callable[[str], None] = lambda text: None) -> RealSenseCamera:
    return RealSenseCamera(SimClock(), STREAM, serial=serial, stream=STREAM, say=say)


def started() -> RealSenseCamera:
    (one := camera()).start()
    return one


# --- camera ----------------------------------------------------------------------------------------


def test_the_camera_that_is_configured_streams_depth_and_colour(scripted):
    library = scripted()
    camera(SERIAL).start()
    streams = [("depth", 64, 48, "z16", 30), ("color", 64, 48, "rgb8", 30)]
    assert library.asked == [(SERIAL,), *streams, ("emitter", 1.0)]


@pytest.mark.parametrize(
    ("name", "line"),
    [
        ("Intel RealSense D455", "camera: Intel RealSense D455"),
        (
            "Intel RealSense D435",
            r"camera: Intel RealSense D435, whose noise .*: docs/hardware\.md says how to train for it",
        ),
    ],
)
def test_which_camera_it_is_is_said(scripted, monkeypatch, name, line):
    monkeypatch.setattr("realsense_support.NAME", name)
    scripted()
    said: list[str] = []
    camera(say=said.append).start()
    assert len(said) == 1 and re.fullmatch(line, said[0])


def test_the_first_read_waits_and_later_ones_do_not(scripted):
    library = scripted(None, 1, None, 2)
    one = started()
    library.said.clear()
    first, paused, second = one.read(), one.read(), one.read()
    assert library.said == ["poll", "wait", "poll", "poll"]
    assert paused is first
    for frame, number in ((first, 1), (second, 2)):
        np.testing.assert_array_equal(frame.depth, depth_mm(number))


def test_a_frame_that_is_there_is_not_waited_for(scripted):
    library = scripted(1)
    started().read()
    assert "wait" not in library.said


def test_the_same_number_twice_is_the_same_frame(scripted):
    scripted(7, 7, 8)
    one = started()
    first, again, next_one = one.read(), one.read(), one.read()
    assert again is first and next_one is not first


@pytest.mark.parametrize("unit_m", [0.001, 0.0001])
def test_pictures_are_copies_of_the_library_s_buffers(scripted, unit_m):
    scripted(1, 2, unit_m=unit_m)
    one = started()
    first, second = one.read(), one.read()
    for frame, number in ((first, 1), (second, 2)):
        np.testing.assert_array_equal(frame.depth, depth_mm(number))
        np.testing.assert_array_equal(frame.rgb, rgb(number))


@pytest.mark.parametrize(
    ("numbers", "message"),
    [
        ((RuntimeError(UNPLUGGED),), UNPLUGGED),
        ((None, TIMEOUT), "didn't arrive within 200"),
        ((None, None), "no frame has come yet"),
    ],
)
def test_no_frame_is_a_camera_error(scripted, numbers, message):
    scripted(*numbers)
    with pytest.raises(CameraError, match=message):
        started().read()


def test_a_camera_that_is_unplugged_between_frames_is_a_camera_error(scripted):
    scripted(1, RuntimeError(UNPLUGGED), 2)
    one = started()
    one.read()
    with pytest.raises(CameraError, match=UNPLUGGED):
        one.read()
    np.testing.assert_array_equal(one.read().depth, depth_mm(2))


def test_a_camera_begun_again_does_not_give_the_old_frame(scripted):
    library = scripted(1, None, TIMEOUT, 1)
    one = started()
    old = one.read()
    one.stop()
    assert library.stopped
    one.start()
    with pytest.raises(CameraError, match="didn't arrive"):
        one.read()
    assert one.read() is not old  # the counter has begun anew


# --- both ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("make", [camera, RealSenseImager])
def test_a_camera_that_is_not_there_is_told_with_its_serial(scripted, make):
    library = scripted(start_error=UNPLUGGED)
    one = make(SERIAL)
    with pytest.raises(UserError, match=rf"{UNPLUGGED}.*deploy\.realsense\.serial '{SERIAL}'"):
        one.start()
    one.stop()
    assert "stop" not in library.said  # it never ran


@pytest.mark.parametrize("make", [camera, RealSenseImager])
def test_a_camera_that_streams_and_does_not_answer_is_closed(scripted, make):
    library = scripted()
    library.silent = UNPLUGGED
    with pytest.raises(UserError, match=rf"does not answer \({UNPLUGGED}\): plug it in anew") as error:
        make().start()
    assert library.stopped and "\n" not in str(error.value)


def test_another_camera_than_the_policy_s_is_closed(scripted):
    library = scripted()
    library.intrinsics = SimpleNamespace(**{**vars(library.intrinsics), "fx": 2 * FX_PX})
    with pytest.raises(UserError, match="the camera's fx is 80.0 px"):
        started()
    assert library.stopped


# --- imager ----------------------------------------------------------------------------------------


def test_the_imager_s_projector_is_off_for_pictures_and_on_again_after(scripted):
    library = scripted(*range(1, SKIPPED + 2))
    imager = RealSenseImager(SERIAL)
    imager.start()
    picture = imager.picture()
    for _ in range(2):
        imager.stop()
    stream = ("infrared", 1, 1280, 720, "y8", 15)
    waits = ["wait"] * (SKIPPED + 1)
    assert library.said == [(SERIAL,), stream, ("emitter", 0.0), *waits, ("emitter", 1.0), "stop"]
    np.testing.assert_array_equal(picture, SKIPPED + 1)  # those before may be older than the call


def test_the_imager_s_lens_is_the_one_it_reports(scripted):
    scripted()
    imager = RealSenseImager()
    imager.start()
    lens = imager.lens()
    np.testing.assert_array_equal(lens.matrix, [[40, 0, 31.5], [0, 40, 23.5], [0, 0, 1]])
    np.testing.assert_array_equal(lens.distortion, [0.1, 0.2, 0.3, 0.4, 0.5])
    assert (lens.width_px, lens.height_px) == (64, 48)


def test_the_imager_s_pictures_are_copies(scripted):
    scripted(*range(2 * SKIPPED + 2))
    imager = RealSenseImager()
    imager.start()
    first, second = imager.picture(), imager.picture()
    assert (first[0, 0], second[0, 0]) == (SKIPPED, 2 * SKIPPED + 1)


@pytest.mark.parametrize(
    ("numbers", "message"), [((1, TIMEOUT), "didn't arrive"), ((1, 2, 3, None), "null pointer")]
)
def test_an_imager_without_a_frame_is_a_camera_error(scripted, numbers, message):
    scripted(*numbers)
    imager = RealSenseImager()
    imager.start()
    with pytest.raises(CameraError, match=message):
        imager.picture()


def test_an_imager_that_was_unplugged_is_closed_quietly(scripted):
    library = scripted()
    imager = RealSenseImager()
    imager.start()
    library.silent = UNPLUGGED
    imager.stop()
    assert library.stopped
