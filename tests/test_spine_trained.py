"""Which objects count as seen in training: the run's own, and those of what it started from."""

from dataclasses import replace

import pytest

from ddgrasp import artifacts
from ddgrasp.artifacts import read_artifact
from ddgrasp.config import Config
from ddgrasp.files import to_json
from ddgrasp.presets import get_preset
from ddgrasp.shipped import PRETRAINED
from ddgrasp.trained import policy_objects, trained_objects

DEBUG = get_preset("debug")


def of(objects: tuple[str, ...], start: str = "", **teacher) -> Config:
    """A configuration whose teacher and student start from `start`."""
    teachers = replace(DEBUG.teacher, start=start or "nothing", **teacher)
    return replace(
        DEBUG,
        world=replace(DEBUG.world, objects=objects),
        teacher=teachers,
        student=replace(DEBUG.student, init_from=start),
    )


@pytest.fixture
def earlier(tmp_path):
    """Two runs, the second begun from the first; the second's folder."""
    for name, config in (("a", of(("apple",))), ("b", of(("can",), str(tmp_path / "a")))):
        for stage in ("teacher", "student"):
            artifacts.finish(tmp_path / name / stage, stage, config, seconds=1, metrics={}, origin="trained")
    return tmp_path / "b"


@pytest.mark.parametrize("stage", ["teacher", "student"])
def test_objects_of_all_starts_were_trained_on(earlier, stage):
    assert trained_objects(to_json(of(("cube", "can"), str(earlier))), stage) == ("cube", "can", "apple")
    assert trained_objects(to_json(of(("cube",), str(earlier / stage))), stage) == ("cube", "can", "apple")
    assert trained_objects(to_json(of(("cube",))), stage) == ("cube",)
    assert trained_objects(to_json(of(("cube",), "runs/gone")), stage) == ("cube",)


@pytest.mark.parametrize("start", ["guide", "nothing"])
def test_a_run_that_has_a_start_s_name_is_none(earlier, start, monkeypatch):
    monkeypatch.chdir(earlier.parent)
    earlier.rename(start)
    assert trained_objects(to_json(of(("cube",), start)), "teacher") == ("cube",)
    assert trained_objects(to_json(of(("cube",), f"./{start}")), "teacher") == ("cube", "can", "apple")


def test_a_teacher_that_is_taken_as_it_is_was_not_trained_on_the_run_s(earlier):
    taken = to_json(of(("lemon",), str(earlier), total_steps=0))
    assert trained_objects(taken, "teacher") == ("can", "apple")
    assert trained_objects(taken, "student") == ("lemon", "can", "apple"), "its student is"


def test_a_student_that_is_taken_as_it_is_was_not_trained_on_the_run_s(earlier):
    config = of(("lemon",), str(earlier))
    student = config.student
    taken = replace(
        student,
        training=replace(student.training, steps=0),
        head=replace(student.head, train_steps=0),
        poses=replace(student.poses, rounds=0),
        dagger=replace(student.dagger, steps=0),
    )
    assert trained_objects(to_json(replace(config, student=taken)), "student") == ("can", "apple")


def test_what_a_shipped_student_began_with_elsewhere_is_not_looked_for(tmp_path, monkeypatch):
    """Its manifest names a run of whoever trained it; another may lie there under that name."""
    monkeypatch.chdir(tmp_path)
    start = read_artifact(PRETRAINED / "student").manifest.config["student"]["init_from"]
    assert start.startswith("runs/")
    other = of(("bottle",))
    artifacts.finish(tmp_path / start, "student", other, seconds=1, metrics={}, origin="trained")
    assert "bottle" not in trained_objects(to_json(of(("cube",), "pretrained")), "student")


def test_a_policy_s_are_those_of_what_made_it_whatever_it_is_tried_by(tmp_path):
    artifacts.finish(tmp_path, "export", of(("lemon",)), seconds=1, metrics={}, origin="trained")
    assert policy_objects(tmp_path / "policy.onnx", of(("cube",))) == ("lemon",)
    assert policy_objects(tmp_path / "elsewhere" / "policy.onnx", of(("cube",))) == ("cube",)


def test_what_demo_starts_from_is_known():
    trained = trained_objects(to_json(get_preset("demo")), "student")
    assert trained[:6] == get_preset("demo").world.objects and "puck" in trained and "can" not in trained
