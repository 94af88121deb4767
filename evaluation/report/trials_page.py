"""Trials on a rig (`ddgrasp deploy trials`) as one page: verdict, success by object, films of both kinds."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from html import escape
from pathlib import Path
from typing import Any

from ddgrasp.files import atomic_write_bytes, atomic_write_text
from deploy.trial_log import read_log
from deploy.trials import TrialResult
from evaluation import failure_modes, paired, wilson
from evaluation.report import success_chart
from evaluation.report.comparison import COMPARISON_HTML, COMPARISON_PNG
from evaluation.report.html import REPORT_HTML, contents, film_file, heading, image, page, table
from evaluation.rig_trials import TRIALS_FILE, differing, shown, shown_rows, tabulate, trained_on
from evaluation.treatments import RECORDED

_SECTIONS = ("By object", "Failures", "Successes", "Which trials")
_KINDS = ("rig", "row")
"""The header of a log has one of them: of `deploy trials`, or of `study causes`."""


@dataclass(frozen=True)
class Trials:
    """What one folder holds."""

    folder: Path
    belong_to: dict[str, Any]
    """Header of the log: which policy, configuration, rule and series."""
    results: Sequence[TrialResult]
    """In the order of their numbers, not in that in which they ended."""

    @property
    def name(self) -> str:
        """The folder's."""
        return self.folder.resolve().name

    @cached_property
    def table(self) -> dict[str, Any]:
        """See `evaluation.rig_trials.tabulate`."""
        return tabulate(self.results, trained_on(self.belong_to))


def find(folder: Path) -> Trials | None:
    """The finished trials in `folder`'s log, of a series that is under way as well; None without any."""
    belong_to, results = read_log(folder / TRIALS_FILE)
    if not results or not any(kind in belong_to for kind in _KINDS):
        return None
    return Trials(folder, belong_to, sorted(results, key=lambda r: r.index))


def verdict(trials: Trials) -> str:
    """Success of all, what ended by a fault, deadlines missed."""
    missed = sum(result.missed_deadlines for result in trials.results)
    steps = sum(result.steps for result in trials.results)
    made = trials.table
    rate, faults = wilson.describe(made["all"]), made["faults"]
    return f"Success {rate}. Ended by a fault: {faults}. Missed deadlines: {missed} in {steps:,} steps."


def write(trials: Trials) -> Path:
    """Writes the page into the trials' folder; returns its path."""
    bad = trials.table["faults"] or any(result.missed_deadlines for result in trials.results)
    body = [
        f"<h1>Trials <code>{escape(trials.name)}</code></h1>",
        f"<p class={'missed' if bad else 'verdict'}>{verdict(trials)}</p>",
        contents(_SECTIONS),
        heading(_SECTIONS[0]),
        "<p class=note>Success: the object at the lift target, held there; rate of n trials, Wilson 95 % "
        "interval.</p>",
        table(("object", "success"), _rows(trials.table)),
        heading(_SECTIONS[1]),
        *_modes(trials.results),
        *_films(trials.folder, "failure"),
        heading(_SECTIONS[2]),
        *_films(trials.folder, "success"),
        heading(_SECTIONS[3]),
        table(("setting", "value"), _settings(trials)),
    ]
    path = trials.folder / REPORT_HTML
    atomic_write_text(path, page(f"Trials {escape(trials.name)}: DiffuDepGrasp-JAX", body))
    return path


def compare(all_trials: Sequence[Trials]) -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
    """(header, rows) of several series side by side: success by object, then trials that the first lost and
    another won, and the other way round, among those that both ran, with McNemar's exact p, and that after
    Holm's correction where several are set beside the first; the same of success at the first try."""
    header = ("", *(str(trials.folder) for trials in all_trials))
    rates = [dict(_rows(trials.table)) for trials in all_trials]
    names = dict.fromkeys(name for column in rates for name in column)
    rows = [(name, *(column.get(name, "") for column in rates)) for name in names]
    first, *others = all_trials
    against = f"against {first.folder}, same trials"
    tries = _pairs(first, others, lambda result: result.at_first_try)
    return header, [
        *rows,
        (f"{against}, at the first try", "", *tries),
        (against, "", *_pairs(first, others, lambda result: result.success)),
    ]


def write_comparison(all_trials: Sequence[Trials]) -> Path:
    """Writes `compare` as a page, and its picture, into the first folder; returns the page's path."""
    header, rows = compare(all_trials)
    verdicts = (
        f"<p class=verdict>{escape(str(trials.folder))}: {verdict(trials)}</p>" for trials in all_trials
    )
    note = (
        "<p class=note>Success: rate of n trials, Wilson 95 % interval. p: McNemar's test, exact; Holm: "
        "corrected for all that are set beside the first.</p>"
    )
    tables = {f"{i}. {trials.name}": trials.table for i, trials in enumerate(all_trials, 1)}
    picture = success_chart.draw({"trials": tables})
    shown = image(picture, "success with intervals, and by object")
    body = ["<h1>Trials side by side</h1>", *verdicts, note, table(header, rows, last_bold=True), shown]
    body += _otherwise(*all_trials)
    path = all_trials[0].folder / COMPARISON_HTML
    atomic_write_bytes(path.with_name(COMPARISON_PNG), picture)
    atomic_write_text(path, page("Trials side by side: DiffuDepGrasp-JAX", body))
    return path


def _rows(made: dict[str, Any]) -> list[tuple[str, str]]:
    return [(name, wilson.describe(row)) for name, row in shown_rows(made).items()]


def _settings(trials: Trials) -> list[tuple[str, str]]:
    counts = sorted(success["n"] for success in trials.table["objects"].values())
    fewest, most = counts[0], counts[-1]
    each = f"{most} of each object" if fewest == most else f"{fewest} to {most} of an object"
    said = {"trials": f"{sum(counts)}, {each}"}
    if "rig" in trials.belong_to:
        said["depth"] = RECORDED  # what the header leaves out
    given = said | shown(trials.belong_to)
    return [(k, ", ".join(v) if isinstance(v, list) else str(v)) for k, v in given.items()]


Outcome = Callable[[TrialResult], bool]


def _outcomes(trials: Trials, of: Outcome) -> dict[tuple[int, str], bool]:
    return {(r.index, r.object_name): of(r) for r in trials.results if not r.realtime}


def _pairs(first: Trials, others: Sequence[Trials], of: Outcome) -> list[str]:
    """A cell for each of `others`."""
    made = [_compared(first, other, of) for other in others]
    adjusted = paired.holm([pair["p"] for pair in made if pair])
    holm = iter(adjusted if len(adjusted) > 1 else [None] * len(adjusted))
    return [_pair(pair, next(holm)) if pair else "other trials" for pair in made]


def _otherwise(first: Trials, *others: Trials) -> list[str]:
    """A table of the trials that came out otherwise than the first's, for those who look at films."""
    before, rows = _outcomes(first, lambda result: result.success), []
    for other in others:
        if not differing(first.belong_to, other.belong_to):
            after = _outcomes(other, lambda result: result.success)
            rows.append((str(other.folder), _won(after, before), _won(before, after)))
    header = (f"against {first.folder}", "won", "lost")
    return ["<h2>Trials that came out otherwise</h2>", table(header, rows)] if rows else []


def _won(one: Mapping[tuple[int, str], bool], other: Mapping[tuple[int, str], bool]) -> str:
    """Trials that one won and the other lost, by object, with the numbers that films have."""
    of: dict[str, list[str]] = {}
    for index, name in sorted(one.keys() & other.keys()):
        if one[index, name] and not other[index, name]:
            of.setdefault(name, []).append(str(index))
    return "; ".join(f"{name} {', '.join(numbers)}" for name, numbers in of.items())


def _compared(first: Trials, other: Trials, of: Outcome) -> dict[str, Any] | None:
    """None for trials of two kinds, or without one in common."""
    if differing(first.belong_to, other.belong_to):
        return None
    pair = paired.compared(_outcomes(first, of), _outcomes(other, of))
    return pair if pair["n"] else None


def _pair(made: Mapping[str, Any], p_holm: float | None) -> str:
    corrected = "" if p_holm is None else f" (Holm {p_holm:.2g})"
    won, lost = made["only_row"], made["only_reference"]
    return f"{won} won, {lost} lost of {made['n']}, p {made['p']:.2g}{corrected}"


def _modes(results: Sequence[TrialResult]) -> list[str]:
    if not (rows := failure_modes.rows(failure_modes.count(results))):
        return []
    return [f"<p class=note>{failure_modes.NOTE}</p>", table(("mode", "trials", "objects"), rows)]


def _films(folder: Path, outcome: str) -> list[str]:
    strips = sorted(folder.glob(f"*-{outcome}.png"))
    parts = [f"<h3>{escape(strip.stem)}</h3>{film_file(strip, strip.stem)}" for strip in strips]
    return parts or ["<p>No film.</p>"]
