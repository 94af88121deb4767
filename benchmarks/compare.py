"""Speed of several ways to do the same work, measured in turns, and how they compare with their peers.

Every round runs each contender once, so that other work on the machine slows all of them; a ratio is the
median over rounds of the two rates within a round.
"""

import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from ddgrasp import tables

Rates = Mapping[str, np.ndarray]
"""Name -> (rounds,) units of work per second."""


@dataclass(frozen=True)
class Contender:
    """Something to time."""

    run: Callable[[], object]
    """Returns when its work is done."""
    work: float
    """Units of work in a call."""
    calls: int = 1
    """Calls per round: quick ones need several to be timed well."""


def seconds_in_turns(runners: Mapping[str, Callable[[], object]], rounds: int) -> dict[str, np.ndarray]:
    """Wall time (rounds,) of a call of each, taken in turns."""
    times = np.zeros((rounds, len(runners)))
    for row in times:
        for column, runner in enumerate(runners.values()):
            start = time.perf_counter()
            runner()
            row[column] = time.perf_counter() - start
    return dict(zip(runners, times.T, strict=True))


def measure(contenders: Mapping[str, Contender], rounds: int) -> dict[str, np.ndarray]:
    """Rates of each over `rounds` rounds, after two calls that are not counted."""

    def repeated(contender: Contender) -> Callable[[], None]:
        def run() -> None:
            for _ in range(contender.calls):
                contender.run()

        return run

    for name, contender in contenders.items():  # twice: the first result may have other types than the start
        start = time.perf_counter()
        contender.run()
        contender.run()
        print(f"  {name}: ready after {time.perf_counter() - start:.0f} s", file=sys.stderr, flush=True)
    seconds = seconds_in_turns({name: repeated(c) for name, c in contenders.items()}, rounds)
    return {name: c.work * c.calls / seconds[name] for name, c in contenders.items()}


@dataclass(frozen=True)
class Row:
    """One comparison."""

    what: str
    unit: str
    """Of the rates."""
    ours: str
    ours_rate: float
    peer: str
    peer_rate: float | None
    """None where there is no such peer on this machine."""
    ratio: float | None
    """Ours over the peer's."""
    target: float | None
    """Least ratio that is claimed; None for what is only reported."""

    @property
    def met(self) -> bool | None:
        """Whether the target is reached; None without target or peer."""
        return None if self.target is None or self.ratio is None else self.ratio >= self.target


def compare(
    rates: Rates, what: str, unit: str, ours: str, peer: str, *, target: float | None = None,
    ours_units: float = 1.0, peer_units: float = 1.0,
) -> Row:  # fmt: skip
    """The row of `ours` against `peer`; `..._units`: measured units of work that make one `unit`."""
    ours_rates = rates[ours] / ours_units
    if peer not in rates:
        return Row(what, unit, ours, float(np.median(ours_rates)), peer, None, None, target)
    peer_rates = rates[peer] / peer_units
    medians = [float(np.median(r)) for r in (ours_rates, peer_rates, ours_rates / peer_rates)]
    return Row(what, unit, ours, medians[0], peer, medians[1], medians[2], target)


def as_json(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """The rows with `met`, as plain values."""
    return [asdict(row) | {"met": row.met} for row in rows]


def print_table(title: str, rows: Sequence[Row]) -> None:
    """Prints the rows to standard output."""
    columns = ("What", "Unit", "Ours", "Rate", "Peer", "Rate", "Ratio", "Target", "Met")
    made = tables.table(columns, map(_cells, rows), title, numbers=("Rate", "Ratio", "Target"))
    tables.console(width=150).print(made)


def _cells(row: Row) -> tuple[str, ...]:
    met = {True: "yes", False: "NO", None: ""}[row.met]
    target = "" if row.target is None else f">= {row.target:g}"
    ours, peer = _number(row.ours_rate), _number(row.peer_rate)
    return row.what, row.unit, row.ours, ours, row.peer, peer, _number(row.ratio), target, met


def _number(value: float | None) -> str:
    if value is None:
        return "none here"
    return f"{value:,.0f}" if value >= 100 else f"{value:.3g}"
