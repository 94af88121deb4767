"""The pages that people look at, as a browser shows them, and the page of a series of trials."""

import json
import os
from dataclasses import asdict

import cv2
import numpy as np
import pytest

from app.commands import parse
from browser_support import WIDTHS_PX, look
from ddgrasp import artifacts
from ddgrasp.config import Config
from ddgrasp.errors import UserError
from ddgrasp.progress import Progress
from deploy.trials import TrialResult
from evaluation.report import html, trials_page
from evaluation.rig_trials import TRIALS_FILE
from recording_support import claiming

CONFIG = Config(preset="debug")


def _result(index: int, name: str, success: bool, missed: int = 0, again: bool = False) -> TrialResult:
    """The object is pushed 5 cm away; the hand tries `again`, or not."""
    times = {name: [0.01] * 3 for name in ("sense_s", "infer_s", "act_s", "latency_s", "period_s")}
    events = ["step 1 (0.10 s) retry: the hand closed to 0 mm, on nothing"] * again
    made = {"safety": {"commands": 3}, "events": events, "holds": 0, "steps": 3, "realtime": False}
    made["object_pos_m"] = [[0.5, 0.0, 0.02], [0.55, 0.0, 0.02]]
    return TrialResult(
        index=index, object_name=name, success=success, missed_deadlines=missed, **made, **times
    )


def _trials(folder, outcomes, missed=0, number=0, again=()):
    """A folder as `ddgrasp deploy trials` leaves it, with a film of a success and of a failure."""
    folder.mkdir()
    results = [_result(i, name, success, missed, i in again) for i, (name, success) in enumerate(outcomes)]
    lines = [{"policy_sha256": "", "rig": "development", "number": number}, *map(asdict, results)]
    (folder / TRIALS_FILE).write_text("".join(json.dumps(line) + "\n" for line in lines))
    for outcome in {result.success for result in results}:
        strip = np.random.default_rng(0).integers(0, 255, (200, 3200, 3), np.uint8)
        cv2.imwrite(str(folder / f"cube-0-{'success' if outcome else 'failure'}.png"), strip)
    return folder


@pytest.fixture
def trials(tmp_path):
    return _trials(tmp_path / "tried", [("cube", True), ("cube", False), ("can", False), ("can", False)])


@pytest.fixture
def run(tmp_path):
    """A finished stage with everything that is wide: curves, many columns, a long film."""
    columns = {f"acceleration_p99_of_joint_{i}": 0.123456 for i in range(12)}
    metrics = {"success": {"successes": 9, "n": 10}, "motion": [{"object": "cube", **columns}] * 3}
    progress = Progress(tmp_path / "run" / "teacher", quiet=True)
    for step in range(3):
        progress.scalars(step, **{name: step for name in ("loss", "success", "episode/return")})
    progress.picture("film", depth=np.full((8, 90, 160), 0.8))
    progress.close()
    artifacts.finish(tmp_path / "run" / "teacher", "teacher", CONFIG, seconds=1, metrics=metrics)
    parse("report", [str(tmp_path / "run")]).run()
    return tmp_path / "run"


def _fits(page, folder):
    """The page is as wide as the window on a telephone and on a laptop; the console is silent."""
    seen, console = look(page, folder)
    assert console == []
    assert tuple(seen) == WIDTHS_PX
    for found in seen.values():
        assert found["excess"] == 0 and found["over"] == [] and found["broken"] == []
    return seen[WIDTHS_PX[0]]["images"]


def test_a_run_s_report_fits_a_telephone_and_says_nothing_on_the_console(run, tmp_path):
    assert _fits(run / html.REPORT_HTML, tmp_path) == 4


def test_trials_and_comparisons_fit_too(trials, tmp_path):
    other = _trials(tmp_path / "other", [("cube", True), ("cube", True), ("can", True), ("can", False)])
    parse("report", [str(trials)]).run()
    parse("report", [str(trials), str(other)]).run()
    assert _fits(trials / html.REPORT_HTML, tmp_path) == 2
    _fits(trials / "comparison.html", tmp_path)


def test_a_page_that_does_not_fit_is_found(tmp_path):
    wide = '<div style="width:600px">wide</div><img alt=lost src="data:image/png;base64,AAAA">'
    (tmp_path / "wide.html").write_text(html.page("wide", [wide, "<script>console.error('no')</script>"]))
    seen, console = look(tmp_path / "wide.html", tmp_path)
    assert seen[390]["excess"] > 200 and "600px" in seen[390]["over"][0]
    assert seen[1280]["excess"] == 0 and seen[1280]["broken"] == ["lost"]
    assert len(console) == len(WIDTHS_PX) and "no" in console[0]


def test_trials_open_with_success_and_show_both_kinds_of_film(trials, capsys):
    parse("report", [str(trials)]).run()
    assert "Success 25.0 % of 4 (4.6 to 69.9)" in capsys.readouterr().out
    page = (trials / html.REPORT_HTML).read_text()
    opening = page[: page.index("<nav")]
    assert "class=verdict" in opening and "Missed deadlines: 0 in 12 steps" in opening
    assert page.index("Failures") < page.index("cube-0-failure") < page.index("cube-0-success")
    assert page.count("data:image/webp") == 2
    assert "<td>can</td><td>0.0 % of 2" in page
    assert "<td>not lifted</td><td>3</td><td>cube 1, can 2</td>" in page
    assert "<td>trials</td><td>4, 2 of each object</td>" in page and "<td>depth</td><td>recorded</td>" in page


def test_a_log_says_of_which_trials_it_is_and_counts_each_once(trials):
    log = trials / TRIALS_FILE
    header, *lines = log.read_text().splitlines(keepends=True)
    log.write_text("".join([header, *lines, lines[1], lines[2][:20]]))  # written twice; torn
    assert trials_page.find(trials).table["all"]["n"] == 4
    log.write_text("".join([json.dumps({"policy_sha256": ""}) + "\n", *lines]))  # a run's last stage
    assert trials_page.find(trials) is None
    log.write_text(header)
    assert trials_page.find(trials) is None


@pytest.mark.parametrize("content", ['{"policy_sha256": "a"}\n{"trial": 1}', "[]\n[]", "3"])
def test_a_log_of_something_else_is_named(tmp_path, content):
    (tmp_path / TRIALS_FILE).write_text(content)
    with pytest.raises(UserError, match=r"/trials\.jsonl is no log of trials"):
        parse("report", [str(tmp_path)]).run()


@pytest.mark.parametrize("content", [b"PNG", b"", claiming(70_000, 70_000)], ids=["cut", "empty", "huge"])
def test_a_film_that_is_no_whole_picture_is_named(trials, content):
    (trials / "cube-0-success.png").write_bytes(content)
    assert "cube-0-success.png cannot be shown" in trials_page.write(trials_page.find(trials)).read_text()


def test_a_folder_s_name_is_no_html(tmp_path):
    folder = _trials(tmp_path / "a<b>", [("cube", True)])
    assert "<code>a&lt;b&gt;</code>" in trials_page.write(trials_page.find(folder)).read_text()
    assert "a<b>" not in trials_page.write_comparison([trials_page.find(folder)] * 2).read_text()


def test_a_folder_s_name_that_is_no_utf8_is_shown_as_its_bytes(tmp_path):
    (tmp_path / "a").mkdir()
    for name in ("a/a", "b"):
        _trials(tmp_path / name, [("cube", True)])
    foreign = (tmp_path / "a" / "a").rename(os.fsdecode(bytes(tmp_path / "a") + b"/x\xff"))
    page = trials_page.write(trials_page.find(foreign)).read_text()
    assert r"<code>x\udcff</code>" in page and "data:image/webp" in page
    pair = [trials_page.find(folder) for folder in (foreign, tmp_path / "b")]
    assert r"/x\udcff</th>" in trials_page.write_comparison(pair).read_text()


def test_a_missed_deadline_is_red(tmp_path):
    page = trials_page.write(trials_page.find(_trials(tmp_path / "late", [("cube", True)], missed=2)))
    assert "<p class=missed>" in page.read_text() and "2 in 3 steps" in page.read_text()


def test_the_same_trials_are_compared_in_pairs(trials, tmp_path, capsys):
    other = _trials(tmp_path / "other", [("cube", False), ("cube", True), ("can", True), ("can", True)])
    parse("report", [str(trials), str(other)]).run()
    assert (trials / "comparison.png").read_bytes()[:4] == b"\x89PNG"
    assert "data:image/png;base64," in (trials / "comparison.html").read_text()
    # three won and one lost: p = 2 (1 + 4) / 2^4
    assert trials_page.compare([trials_page.find(trials), trials_page.find(other)])[1][-1][-1] == (
        "3 won, 1 lost of 4, p 0.62"
    )
    twice = _trials(tmp_path / "twice", [("cube", True), ("cube", True)], again=(0,))
    *_, first_try, whole = trials_page.compare([trials_page.find(folder) for folder in (trials, twice)])[1]
    assert (first_try[-1], whole[-1]) == ("1 won, 1 lost of 2, p 1", "1 won, 0 lost of 2, p 1")
    third = _trials(tmp_path / "third", [("cube", False), ("cube", False), ("can", False), ("can", True)])
    (*_, last) = trials_page.compare([trials_page.find(folder) for folder in (trials, other, third)])[1]
    assert last[-2:] == ("3 won, 1 lost of 4, p 0.62 (Holm 1)", "1 won, 1 lost of 4, p 1 (Holm 1)")
    elsewhere = _trials(tmp_path / "elsewhere", [("cube", False)], number=1)
    pair = trials_page.compare([trials_page.find(trials), trials_page.find(elsewhere)])
    assert pair[1][-1][-1] == "other trials"
    more = _trials(tmp_path / "more", [("pear", True)] * 5)  # numbers 0 to 4 of another object
    (*_, last) = trials_page.compare([trials_page.find(folder) for folder in (trials, other, more)])[1]
    assert last[-2:] == ("3 won, 1 lost of 4, p 0.62", "other trials")
    with pytest.raises(UserError, match="no finished trials to set beside"):
        parse("report", [str(trials), str(tmp_path)]).run()


def test_a_film_too_wide_for_webp_is_kept_as_it_is(tmp_path):
    folder = _trials(tmp_path / "long", [("cube", True)])
    wide = np.zeros((4, 16_384, 3), np.uint8)
    assert cv2.imwrite(str(folder / "cube-0-success.png"), wide)
    page = trials_page.write(trials_page.find(folder)).read_text()
    assert "data:image/png" in page and "data:image/webp" not in page


def test_a_dollar_in_a_folder_s_name_is_no_formula(tmp_path):
    folders = [_trials(tmp_path / name, [("cube", True)]) for name in ("a$^$b", "c")]
    page = trials_page.write_comparison([trials_page.find(folder) for folder in folders]).read_text()
    assert "a$^$b" in page
