"""What a person turns while a policy runs: lines, keys, and depth that changes in the middle of a trial."""

import io
import time

import numpy as np
import pytest

from app.commands.play import _ChosenNoise
from ddg_jax.prior import make_prior
from ddg_jax.sample import Generator
from ddgrasp.config import DDGConfig
from ddgrasp.errors import UserError
from deploy.controls import DOWN, ENTER, UP, Controls
from deploy.interfaces import Frame
from deploy.treatment import TreatedCamera

OBJECTS = {"development": ("apple", "banana", "can"), "fr3": ("apple", "banana", "can", "milk")}


def test_a_typed_object_interrupts_and_is_next():
    controls = Controls(OBJECTS, "development")
    assert not controls.interrupts and controls.next_object() is None
    assert controls.line(" Banana\n") == "next: banana"
    controls.line("can")
    assert controls.interrupts
    assert controls.next_object() == "can"
    assert not controls.interrupts


def test_a_typed_noise_does_not_interrupt():
    controls = Controls(OBJECTS, "development")
    assert controls.noise == "camera"
    assert controls.line("none") == "noise: none"
    assert controls.noise == "none" and not controls.interrupts


def test_a_typed_rig_interrupts_and_keeps_the_object_where_it_has_it():
    controls = Controls(OBJECTS, "development")
    controls.begin("can")
    assert "a rig (development, fr3)" in controls.help
    assert controls.line("fr3") == "rig: fr3, next: can"
    assert controls.interrupts and controls.rig == "fr3" and controls.next_object() == "can"
    controls.begin("milk")
    assert controls.line("development") == "rig: development, next: apple"
    controls.key(DOWN)  # goes on from what that rig has, before the trial begins
    assert controls.object_name == "banana"
    with pytest.raises(UserError, match="'milk'"):
        controls.line("milk")
    assert "rig" not in Controls({"development": ("can",)}, "development").help


def test_other_words_are_refused_with_what_there_is():
    with pytest.raises(UserError, match="Unknown object, noise or rig 'bananna'. Did you mean 'banana'"):
        Controls(OBJECTS, "development").line("bananna")


def test_keys_go_round_objects_and_noises():
    controls = Controls(OBJECTS, "development")
    controls.begin("can")
    controls.key(DOWN)
    assert controls.next_object() == "apple"
    controls.key(UP)
    controls.key(UP)
    assert controls.next_object() == "banana"
    seen = []
    for _ in range(3):
        controls.key(ENTER)
        seen.append(controls.noise)
    assert seen == ["none", "generator", "camera"]
    controls.key(ord("A"))
    assert not controls.interrupts


def test_lines_are_obeyed_and_answered_as_they_come():
    controls, said = Controls(OBJECTS, "development"), []
    controls.listen(io.StringIO("nonsense\n\ngenerator\nq\n"), said.append)
    started = time.monotonic()
    controls.wait(lambda: time.monotonic() - started < 30)
    assert controls.ended and controls.noise == "generator"
    assert "nonsense" in said[0] and said[1:] == ["noise: generator", "ending"]


def test_waiting_ends_when_nobody_watches():
    Controls(OBJECTS, "development").wait(lambda: False)


class _Camera:
    """A simulated one: 700 mm with errors, 500 mm without."""

    def __init__(self):
        self.taken = 0

    def start(self) -> None: ...

    def stop(self) -> None: ...

    def read(self) -> Frame:
        self.taken += 1
        return Frame(np.full((4, 6), 700, np.uint16), 0.1 * self.taken)

    def clean_mm(self) -> np.ndarray:
        return np.full((4, 6), 500, np.uint16)


def test_the_policy_sees_the_noise_that_is_chosen_now(tmp_path):
    controls = Controls(OBJECTS, "development")
    noise = _ChosenNoise(controls, tmp_path)
    noise.__dict__["generator"] = lambda clean_mm: clean_mm + 11  # a generator has a test of its own
    camera = TreatedCamera(_Camera(), noise)
    seen = [int(camera.read().depth[0, 0])]
    for word in ("none", "generator", "camera"):
        controls.line(word)
        seen.append(int(camera.read().depth[0, 0]))
    assert seen == [700, 500, 511, 700]


def test_every_trial_has_noise_of_its_own_from_its_first_frame_on(tmp_path, monkeypatch):
    asked = []

    class Source:
        needs_rgb = False

        def __init__(self, *_): ...

        def frames(self, clean_mm, rgb, episode, frame):
            asked.append((int(episode[0]), int(frame[0])))
            return clean_mm

    loaded = Generator(DDGConfig(), {}, make_prior(DDGConfig()))
    monkeypatch.setattr(Generator, "load", staticmethod(lambda folder: loaded))
    monkeypatch.setattr("student_jax.depth_source.GeneratorSource", Source)
    controls = Controls(OBJECTS, "development")
    noise, camera = _ChosenNoise(controls, tmp_path), _Camera()
    controls.line("generator")
    for trial in (7, 9):
        noise.begin(trial)
        for _ in range(2):
            noise.replace(camera.read().depth, camera.clean_mm)
    assert asked == [(7, 0), (7, 1), (9, 0), (9, 1)]


def test_a_camera_that_knows_no_clean_depth_is_refused(tmp_path):
    class Real:
        def start(self) -> None: ...
        def read(self) -> Frame: ...
        def stop(self) -> None: ...

    with pytest.raises(UserError, match="needs a simulation"):
        TreatedCamera(Real(), _ChosenNoise(Controls(OBJECTS, "development"), tmp_path))
