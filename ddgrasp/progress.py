"""What a person sees while a stage works, and the curves it leaves behind.

A stage gets one `Progress`. In a terminal it draws a bar with an estimate; elsewhere it prints a plain line
now and then. Scalars go to TensorBoard events (`<run>/<stage>/tb`, each step once when an attempt ends) and
to `<run>/<stage>/curves.jsonl`, which the report reads. `Progress.seconds` is the stage's wall time, attempts
before a `--resume` included.
"""

import contextlib
import json
import sys
import time
from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from typing import Any, TypeVar

from ddgrasp.events import ScalarEvents
from ddgrasp.files import DAMAGED_JSON, atomic_path, atomic_write_json, to_json

CURVES = "curves.jsonl"
EVENTS = "tb"
PICTURES = "pictures"
_CLOCK = ".elapsed.json"
_PLAIN_PERIOD_S = 15.0
_CLOCK_PERIOD_S = 10.0

T = TypeVar("T")


class Task:
    """One bar: `advance` it as the work goes on; keyword values are shown beside it."""

    def __init__(self, label: str, total: int, draw: Callable[["Task"], None]):
        self.label = label
        self.total = total
        self.done = 0
        self.shown = ""
        self._draw = draw
        self._start = time.monotonic()
        self._start_done = 0

    def start_at(self, done: int) -> None:
        """Says that `done` units were finished before this attempt: they do not enter the estimate."""
        self.done = self._start_done = done
        self._draw(self)

    def advance(self, n: int = 1, **shown: Any) -> None:
        """Adds `n` units; `shown` (for example success=0.93) stands beside the bar."""
        self.done += n
        if shown:
            self.shown = "  ".join(f"{name} {_format(value)}" for name, value in shown.items())
        self._draw(self)

    @property
    def remaining_s(self) -> float | None:
        """Estimate of the time left, None before the first unit."""
        fresh = self.done - self._start_done
        if fresh <= 0:
            return None
        return (time.monotonic() - self._start) / fresh * max(0, self.total - self.done)


class Progress:
    """Progress, notes and scalars of one stage.

    Args:
      directory: the stage's directory, `<run>/<stage>`; None keeps nothing on disk.
      name: shown in front of every line.
      quiet: print nothing (tests).
    """

    def __init__(self, directory: Path | str | None = None, name: str = "", *, quiet: bool = False):
        self.directory = Path(directory) if directory is not None else None
        self.name = name
        self._quiet = quiet
        self._start = time.monotonic()
        self._before_s = self._read_clock()
        self._clock_saved = time.monotonic()
        self._events: ScalarEvents | None = None
        self._again = False
        self._live = None
        self._plain_last = -_PLAIN_PERIOD_S
        self._tty = sys.stderr.isatty()

    @property
    def seconds(self) -> float:
        """Wall time of this stage so far, interrupted attempts included."""
        return self._before_s + time.monotonic() - self._start

    @contextlib.contextmanager
    def task(self, label: str, total: int) -> Iterator[Task]:
        """A bar of `total` units:  `with progress.task("PPO", updates) as task: ... task.advance()`."""
        if self._quiet:
            yield Task(label, total, lambda task: self._tick())
        elif self._tty:
            with self._bar(label, total) as task:
                yield task
        else:
            self._plain_last = time.monotonic() - _PLAIN_PERIOD_S
            yield Task(label, total, self._plain)

    def track(self, items: Collection[T], label: str, total: int | None = None) -> Iterator[T]:
        """Iterates over `items` under a bar of `total` units, by default one per item."""
        with self.task(label, len(items) if total is None else total) as task:
            for item in items:
                yield item
                task.advance()

    def note(self, text: str) -> None:
        """Prints one line."""
        if self._quiet:
            return
        line = f"[{self.name}] {text}" if self.name else text
        if self._live is not None:
            self._live.console.print(line, markup=False, highlight=False)
        else:
            print(line, file=sys.stderr, flush=True)

    def scalars(self, step: int, **values: Any) -> None:
        """Adds one point to each named curve. `/` is allowed in names given as **{"loss/policy": 0.1}."""
        self._tick()
        if self.directory is None:
            return
        plain = {name: float(value) for name, value in values.items()}
        self.directory.mkdir(parents=True, exist_ok=True)
        if self._events is None:
            _end_line(self.directory / CURVES)
            self._again = (self.directory / EVENTS).exists()
            self._events = ScalarEvents(self.directory / EVENTS)
        with open(self.directory / CURVES, "a") as file:
            file.write(json.dumps(to_json({"step": int(step), **plain})) + "\n")
        for name, value in plain.items():
            self._events.add(int(step), name, value)

    def picture(self, name: str, **panels: Any) -> None:
        """Keeps images for the report, to be drawn side by side (see `evaluation/report/figures.py`).

        Args:
          name: file name without suffix; the report's title for it.
          panels: title -> (H, W, 3) RGB, uint8 or in [0, 1]; (H, W) depth, uint16 millimetres or float
            metres, 0 = invalid. One more leading axis makes a film strip: frames from left to right, panels
            as rows.
        """
        if self.directory is None:
            return
        import numpy as np

        with atomic_path(self.directory / PICTURES / f"{name}.npz") as path:
            arrays: dict[str, Any] = {title: np.asarray(panel) for title, panel in panels.items()}
            np.savez_compressed(path, **arrays)

    def close(self) -> None:
        """Flushes the events and keeps the time spent, so that a later attempt adds to it."""
        self._save_clock()
        if self._events is not None:
            self._events.close()
            if self._events.trouble:
                self.note(f"TensorBoard's events are not whole ({self._events.trouble}); {CURVES} has all.")
            self._events = None
            if self._again:
                self._rewrite_events()

    def _rewrite_events(self) -> None:
        """TensorBoard's events of all attempts, a step that was done twice once, as `read_curves` has it; all
        have the time of now. What is left if it fails is `curves.jsonl`, and events that repeat steps."""
        assert self.directory is not None
        with contextlib.suppress(OSError):
            before = list((self.directory / EVENTS).iterdir())
            events = ScalarEvents(self.directory / EVENTS, f".{time.time_ns()}")
            for name, points in read_curves(self.directory).items():
                for step, value in points:
                    events.add(step, name, value)
            events.close()
            for path in () if events.trouble else before:
                path.unlink()

    # --- drawing ---

    @contextlib.contextmanager
    def _bar(self, label: str, total: int) -> Iterator[Task]:
        from rich.console import Console
        from rich.progress import BarColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn
        from rich.progress import Progress as RichProgress

        columns = (
            TextColumn(f"{self.name:>8}  {{task.description}}"),
            BarColumn(bar_width=28),
            TextColumn("{task.completed:.0f}/{task.total:.0f}"),
            TimeElapsedColumn(),
            TextColumn("left"),
            TimeRemainingColumn(),
            TextColumn("{task.fields[shown]}"),
        )
        with RichProgress(*columns, console=Console(stderr=True)) as live:
            handle = live.add_task(label, total=total, shown="")

            def draw(task: Task) -> None:
                live.update(handle, completed=task.done, total=task.total, shown=task.shown)
                self._tick()

            self._live = live
            try:
                yield Task(label, total, draw)
            finally:
                self._live = None

    def _plain(self, task: Task) -> None:
        self._tick()
        now = time.monotonic()
        if now - self._plain_last < _PLAIN_PERIOD_S and task.done < task.total:
            return
        self._plain_last = now
        left = task.remaining_s
        estimate = f"  {left:.0f} s left" if left else ""
        self.note(f"{task.label} {task.done}/{task.total}{estimate}  {task.shown}".rstrip())

    # --- time spent ---

    def _tick(self) -> None:
        if time.monotonic() - self._clock_saved > _CLOCK_PERIOD_S:
            self._save_clock()

    def _save_clock(self) -> None:
        self._clock_saved = time.monotonic()
        if self.directory is not None and self.directory.exists():
            with contextlib.suppress(OSError):
                atomic_write_json(self.directory / _CLOCK, {"seconds": self.seconds})

    def _read_clock(self) -> float:
        if self.directory is None:
            return 0.0
        try:
            return float(json.loads((self.directory / _CLOCK).read_text())["seconds"])
        except (*DAMAGED_JSON, OSError, KeyError, TypeError):
            return 0.0


def read_curves(directory: Path | str) -> dict[str, list[tuple[int, float]]]:
    """Curve name -> points (step, value) that `Progress.scalars` left in a stage's directory.

    A step written twice (before a crash, and again after the resume) counts once, with its last value; a line
    cut off by a crash is skipped.
    """
    path = Path(directory) / CURVES
    curves: dict[str, dict[int, float]] = {}
    if not path.exists():
        return {}
    for line in path.read_text(errors="replace").splitlines():
        try:
            point = json.loads(line)
            step = point.pop("step")
        except (*DAMAGED_JSON, KeyError, AttributeError, TypeError):
            continue
        for name, value in point.items():
            if value is not None:
                curves.setdefault(name, {})[step] = value
    return {name: sorted(points.items()) for name, points in curves.items()}


def _end_line(path: Path) -> None:
    """Ends a line that a crash cut off, so that the next one is not lost with it."""
    with contextlib.suppress(FileNotFoundError), open(path, "rb+") as file:
        if file.read()[-1:] not in (b"", b"\n"):
            file.write(b"\n")


def _format(value: Any) -> str:
    return f"{value:.3g}" if isinstance(value, float) else str(value)
