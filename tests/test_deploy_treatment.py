"""Treatments of recorded depth: what the policy sees instead, and which frames are treated."""

import numpy as np
import pytest

from ddgrasp.errors import UserError
from ddgrasp.presets import PRESETS
from deploy.interfaces import Camera, Frame
from deploy.treatment import Inpaint, TreatedCamera, treated
from evaluation.treatments import make_treatment
from rig.fr3.channel import Channel
from sensors.inpainting import inpainted


class Still:
    """Hands out frames that it was given, the last one again and again."""

    def __init__(self, *frames: Frame):
        self.frames, self.running = list(frames), False

    def start(self) -> None:
        self.running = True

    def read(self) -> Frame:
        return self.frames.pop(0) if len(self.frames) > 1 else self.frames[0]

    def stop(self) -> None:
        self.running = False


class Coloured(Still):
    def picture(self) -> np.ndarray:
        return np.full((2, 2, 3), 7, np.uint8)


class AddRed:
    """Adds the mean of red to depth; counts its calls."""

    needs_rgb = True
    calls = 0

    def __call__(self, depth, rgb):
        self.calls += 1
        return depth + np.uint16(rgb[..., 0].mean())


def frame(depth_mm: np.ndarray, time_s: float = 0.0, rgb: np.ndarray | None = None) -> Frame:
    return Frame(depth_mm.astype(np.uint16), time_s, rgb)


def plane() -> np.ndarray:
    return np.broadcast_to(np.arange(600, 640, dtype=np.uint16), (30, 40)).copy()


def test_holes_of_a_plane_are_filled_with_the_plane_and_readings_stay():
    holed = plane()
    holed[10:15, 12:20] = 0
    filled = inpainted(holed)
    np.testing.assert_array_equal(filled[holed > 0], holed[holed > 0])
    assert np.abs(filled.astype(int) - plane()).max() <= 8  # the hole is 8 mm wide
    np.testing.assert_array_equal(inpainted(np.stack([holed, plane()]))[0], filled)
    assert not inpainted(np.zeros((4, 5), np.uint16)).any()


def test_depth_in_metres_is_not_inpainted():
    with pytest.raises(UserError, match="inpainting takes depth in uint16 millimetres, not float32"):
        Inpaint()(np.ones((4, 5), np.float32), None)


def test_a_treated_camera_treats_every_frame_once_and_keeps_its_time():
    holed = plane()
    holed[5, 5] = 0
    camera = Still(frame(holed, 1.0), frame(plane(), 2.0))
    seen = treated(camera, Inpaint())
    assert isinstance(seen, Camera)
    seen.start()
    assert camera.running
    first, second, again = seen.read(), seen.read(), seen.read()
    assert (first.timestamp_s, second.timestamp_s) == (1.0, 2.0) and again is second
    np.testing.assert_array_equal(first.depth, inpainted(holed))
    assert treated(camera, None) is camera
    seen.stop()
    assert not camera.running


@pytest.mark.parametrize("colour", [False, True])
def test_a_rig_s_time_stands_still_while_a_frame_is_treated(colour):
    """A rig's colour is drawn with its time held too, which must not let it go on before the treatment."""
    told: list[bool] = []

    class Line(Channel):
        def __init__(self):
            self._holding = 0

        def ask(self, what, **values):
            told.append(values["on"])
            return {}

    class Rig(Coloured):
        line = Line()

        def time_held(self):
            return self.line.time_held()

        def picture(self):
            with self.time_held():
                return super().picture()

    class Watching(AddRed):
        needs_rgb = colour

        def __call__(self, depth, rgb):
            assert told == [True]
            return depth

    TreatedCamera(Rig(frame(plane())), Watching()).read()
    assert told == [True, False]


def test_colour_comes_with_the_frame_or_is_asked_for():
    red = AddRed()
    seen = TreatedCamera(Coloured(frame(plane()), frame(plane(), 1.0, np.full((1, 1, 3), 3, np.uint8))), red)
    np.testing.assert_array_equal(seen.read().depth, plane() + 7)
    np.testing.assert_array_equal(seen.read().depth, plane() + 3)
    seen.read()
    assert red.calls == 2
    with pytest.raises(UserError, match="AddRed needs a camera with colour"):
        TreatedCamera(Still(frame(plane())), AddRed())


def test_another_name_is_no_network_on_colour():
    with pytest.raises(UserError, match="Unknown treatment of depth 'inpain'. Did you mean 'inpaint'"):
        make_treatment("inpain", PRESETS["debug"])
