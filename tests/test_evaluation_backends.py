"""A teacher on several physics backends: what is kept beside it and what the report says."""

import pytest

from app.commands.teacher import TeacherCompare
from ddgrasp import artifacts
from ddgrasp.config import Config
from ddgrasp.files import atomic_write_json, read_json
from evaluation import backends
from evaluation.report.run_page import render_html
from evaluation.report.summary import build_report, summary_rows

CONFIG = Config(preset="debug")


def counts(successes, n):
    return {"successes": successes, "n": n}


def result(successes, n, dropped=0):
    objects = {
        "cube": counts(successes // 2, n // 2),
        "apple": counts(successes - successes // 2, n - n // 2),
    }
    motion = {"saturated_actions": 0.1, "motion": []}
    return {"success": counts(successes, n), "objects": objects, "contacts_dropped": dropped} | motion


@pytest.fixture
def teacher(tmp_path):
    metrics = {"success": counts(95, 100), "objects": {"cube": counts(95, 100)}}
    artifacts.finish(tmp_path / "teacher", "teacher", CONFIG, seconds=1, metrics=metrics, origin="trained")
    return tmp_path / "teacher"


def test_the_drop_is_the_difference_of_rates_and_each_rate_has_its_interval(teacher):
    backends.save(teacher, {"cpu": result(96, 100), "jax": result(45, 50)}, seed=3)
    cpu, jax = backends.table(teacher, trained_on="cpu")
    assert cpu["backend"] == "cpu (trained on)" and cpu["drop_points"] == 0
    assert jax["backend"] == "jax" and jax["drop_points"] == pytest.approx(6.0)
    # Wilson 95 % interval of 45 of 50, from the formula by hand.
    assert (jax["success"]["low"], jax["success"]["high"]) == (
        pytest.approx(0.7864, abs=1e-4), pytest.approx(0.9565, abs=1e-4)
    )  # fmt: skip
    assert jax["cube"]["n"] == 25
    backends.save(teacher, {"jax": result(45, 50)}, seed=4)
    assert [row["drop_points"] for row in backends.table(teacher, "cpu")] == [0, None], "other episodes"


def test_backends_add_up_until_the_teacher_is_made_anew(teacher):
    backends.save(teacher, {"jax": result(40, 50)}, seed=0)
    assert backends.table(teacher, "cpu")[0]["drop_points"] is None
    backends.save(teacher, {"cpu": result(50, 50)}, seed=0)
    assert [row["backend"] for row in backends.load(teacher)] == ["jax", "cpu"]
    assert backends.table(teacher, "cpu")[0]["drop_points"] == pytest.approx(20.0)
    artifacts.finish(teacher, "teacher", CONFIG, seconds=2, metrics={}, origin="trained")
    assert backends.load(teacher) == []


def test_contacts_dropped_are_kept_and_shown_and_were_not_always(teacher):
    path = backends.save(teacher, {"jax": result(40, 50, dropped=313), "cpu": result(50, 50)}, seed=0)
    assert [row["contacts_dropped"] for row in backends.table(teacher, "cpu")] == [313, 0]
    page = render_html(build_report(teacher.parent), teacher.parent)
    assert "contacts_dropped" in page and "313" in page
    saved = read_json(path)
    del saved["backends"][0]["contacts_dropped"]
    atomic_write_json(path, saved)
    assert [row["contacts_dropped"] for row in backends.table(teacher, "cpu")] == [None, 0]


def test_the_command_says_how_many_contacts_were_dropped(teacher, monkeypatch, capsys):
    monkeypatch.setattr("ppo.policy.load", lambda directory: None)
    measured = [("cpu", result(96, 100)), ("jax", result(45, 50, dropped=1313))]
    monkeypatch.setattr("ppo.backends.evaluate_backends", lambda *_: iter(measured))
    TeacherCompare(teacher.parent).run()
    cpu, jax, _ = capsys.readouterr().out.splitlines()
    assert cpu == "cpu    96.0 % of 100 (90.2 to 98.4), 0 contacts dropped"
    assert jax == "jax    90.0 % of 50 (78.6 to 95.7), 1,313 contacts dropped"


def test_the_report_shows_them(teacher):
    backends.save(teacher, {"cpu": result(96, 100), "jax": result(45, 50)}, seed=3)
    report = build_report(teacher.parent)
    lines = [row[3] for row in summary_rows(report)]
    assert "on jax: success 90.0 % of 50 (78.6 to 95.7), drop 6.0 points" in lines
    assert "on cpu (trained on): success 96.0 % of 100 (90.2 to 98.4)" in lines
    page = render_html(report, teacher.parent)
    assert "<h3>backends</h3>" in page and "drop_points" in page
