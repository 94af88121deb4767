"""A student that starts from another one (`student.init_from`)."""

from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import pytest

from ddgrasp import artifacts
from ddgrasp.config import Config, EncoderConfig, HandViewConfig, HeadConfig, StudentConfig
from ddgrasp.errors import UserError
from ddgrasp.progress import Progress
from ddgrasp.shipped import PRETRAINED
from learning.params import save_params
from student_jax import dagger, start
from student_jax.dagger import Trainer
from student_jax.depth_source import make_source
from student_jax.policy import PARAMS_FILE, init_params, load, param_shapes
from teacher_support import still_teacher

STUDENT = StudentConfig(
    depth_source="ideal",
    encoder=EncoderConfig(width=8, keypoints=4, stage_blocks=(1, 1), features=16),
    head=HeadConfig(width=16, blocks=1, state_features=8),
    hand_view=HandViewConfig(size_px=8, width=8, blocks=1, channels=2, features=8),
)
CONFIG = Config("test", student=STUDENT)
PROFILE = CONFIG.world.profile


@pytest.fixture(scope="module")
def params() -> dict:
    """Those of the student that others start from: not what seed 0 gives."""
    return init_params(jax.random.key(1), STUDENT, PROFILE)


@pytest.fixture
def run(params, tmp_path) -> Path:
    """A run with that student."""
    (tmp_path / "run" / "student").mkdir(parents=True)
    save_params(tmp_path / "run" / "student" / PARAMS_FILE, params)
    return tmp_path / "run"


def test_a_start_is_taken_leaf_by_leaf(params, run, tmp_path):
    config = replace(CONFIG, student=replace(STUDENT, init_from=str(run)))
    start.check(config)
    source = make_source(config, tmp_path)
    begun = Trainer(config, still_teacher(), source, tmp_path / "new", Progress(quiet=True))
    begun._restore()
    jax.tree.map(np.testing.assert_array_equal, begun.params, params)
    fresh = Trainer(CONFIG, still_teacher(), source, tmp_path / "fresh", Progress(quiet=True))
    fresh._restore()
    assert np.any(fresh.params["encoder"]["features"]["kernel"] != params["encoder"]["features"]["kernel"])


@pytest.mark.parametrize(("changed", "where"), [({"width": 16}, "encoder"), ({"features": 24}, "aux_hidden")])
def test_a_start_of_another_width_is_refused(changed, where, run):
    other = replace(STUDENT, init_from=str(run), encoder=replace(STUDENT.encoder, **changed))
    with pytest.raises(UserError, match=f"does not fit this configuration's network .*{where}") as error:
        start.load(other, param_shapes(other, PROFILE))
    assert "\n" not in str(error.value)


@pytest.fixture
def finished(run) -> StudentConfig:
    """A student that starts from the one of `run`, whose training is known."""
    artifacts.finish(run / "student", "student", CONFIG, seconds=1.0, metrics={})
    return replace(STUDENT, init_from=str(run))


@pytest.mark.parametrize(
    ("name", "there", "here"),
    [("height_px", 112, 56), ("width_px", 144, 72), ("min_depth_m", 0.1, 0.2), ("max_depth_m", 2.5, 2.0)],
)
def test_a_start_that_has_seen_other_pictures_is_refused(finished, name, there, here):
    start._check_meaning(finished)
    other = replace(finished, picture=replace(finished.picture, **{name: here}))
    with pytest.raises(UserError, match=f"student.picture.{name} {there}, this configuration {here}: use"):
        start._check_meaning(other)


def test_a_start_whose_holes_were_left_open_is_taken_and_that_is_said(
    finished, params, tmp_path, monkeypatch
):
    class Notes(Progress):
        said: list[str] = []

        def note(self, text: str) -> None:
            self.said.append(text)

    monkeypatch.setattr(dagger, "init_params", lambda *_: params)
    for filled in (False, True):
        student = replace(finished, picture=replace(finished.picture, fill_holes=filled))
        start._check_meaning(student)
        config = replace(CONFIG, student=student)
        Trainer(
            config, still_teacher(), make_source(config, tmp_path), tmp_path / str(filled), Notes()
        )._restore()
    (said,) = Notes.said
    assert "trained with student.picture.fill_holes False, here it is True" in said


@pytest.mark.parametrize(
    ("section", "name", "here"),
    [
        ("picture", "channels", ("valid", "relief")), ("encoder", "output_stride", 4),
        ("hand_view", "pitch_m", 0.006), ("head", "diffusion_steps", 60),
    ],
)  # fmt: skip
def test_a_start_whose_numbers_mean_something_else_is_refused(finished, section, name, here):
    """Arrays of the same shape."""
    other = replace(finished, **{section: replace(getattr(finished, section), **{name: here})})
    with pytest.raises(UserError, match=rf"student\.{section}\.{name} .*, this configuration .*: use"):
        start._check_meaning(other)


@pytest.mark.parametrize("name", ["pretrained", "pretrained/student", PRETRAINED / "student"])
def test_a_student_is_loaded_with_its_configuration(name):
    config, params = load(name)
    shapes = param_shapes(config.student, config.world.profile)
    assert jax.tree.map(np.shape, params) == jax.tree.map(lambda leaf: leaf.shape, shapes)


def test_what_is_no_student_is_not_loaded(tmp_path):
    for name in (tmp_path, "pretrained/ddg"):
        with pytest.raises(UserError, match="holds no finished student"):
            load(name)
