"""What a person sees while a stage works: estimates, the bar of a terminal, the time that is kept."""

import json
from types import SimpleNamespace

import pytest

from ddgrasp import progress
from ddgrasp.progress import Progress, Task


@pytest.fixture
def clock(monkeypatch):
    """Time as the tests let it pass: `clock.now` in seconds."""
    faked = SimpleNamespace(now=100.0)
    monkeypatch.setattr(progress.time, "monotonic", lambda: faked.now)
    return faked


def test_what_was_done_before_does_not_enter_the_estimate(clock):
    drawn = []
    task = Task("PPO", 100, lambda task: drawn.append((task.done, task.shown)))
    task.start_at(40)
    assert task.remaining_s is None
    clock.now += 30
    task.advance(10, success=0.5, step=3)
    assert task.remaining_s == 30 / 10 * 50  # three seconds each, half of them left
    clock.now += 10
    task.advance(10)
    assert task.remaining_s == 40 / 20 * 40
    task.advance(50)
    assert task.remaining_s == 0
    assert drawn == [(40, ""), (50, "success 0.5  step 3"), (60, "success 0.5  step 3"), (110, task.shown)]


def test_plain_lines_come_now_and_then_and_at_the_end(clock, capsys):
    with Progress(name="teacher").task("PPO", 4) as task:
        for seconds in (1, 2, 13, 1):  # since the line before: 1, 2, 15, 1
            clock.now += seconds
            task.advance(success=0.9312)
    assert capsys.readouterr().err.splitlines() == [
        "[teacher] PPO 1/4  3 s left  success 0.931",
        "[teacher] PPO 3/4  5 s left  success 0.931",
        "[teacher] PPO 4/4  success 0.931",
    ]


def test_a_terminal_has_a_bar_and_notes_above_it(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "120")
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("FORCE_COLOR", "1")
    shown = Progress(name="teacher")
    shown._tty = True
    with shown.task("PPO", 4) as task:
        task.start_at(1)
        shown.note("a [bold] word")
        assert shown._live is not None
        task.advance(2, success=0.9312)
    assert shown._live is None
    told = capsys.readouterr()
    assert told.out == ""
    last = told.err.rstrip("\x1b[?25h\n").rsplit("\r", 1)[-1]
    assert "[teacher] a [bold] word" in told.err
    assert "teacher" in last and "PPO" in last and "3/4" in last and "success 0.931" in last


def test_a_bar_that_an_interrupt_ends_is_taken_away(capsys):
    shown = Progress(name="teacher")
    shown._tty = True
    with pytest.raises(KeyboardInterrupt), shown.task("PPO", 4):
        raise KeyboardInterrupt
    assert shown._live is None
    shown.note("goes on")
    assert capsys.readouterr().err.endswith("[teacher] goes on\n")


@pytest.mark.parametrize("tty", [True, False, None], ids=["bar", "lines", "quiet"])
def test_the_time_is_kept_every_ten_seconds_of_work(tty, clock, tmp_path, capsys):
    shown = Progress(tmp_path, "teacher", quiet=tty is None)
    shown._tty = bool(tty)
    kept = tmp_path / ".elapsed.json"
    with shown.task("PPO", 100) as task:
        clock.now += 10
        task.advance()
        assert not kept.exists()
        clock.now += 1
        task.advance()
        assert json.loads(kept.read_text()) == {"seconds": 11.0}
        clock.now += 5
        task.advance()
        assert json.loads(kept.read_text()) == {"seconds": 11.0}
    clock.now += 2
    shown.close()
    assert Progress(tmp_path, quiet=True).seconds == 18.0
