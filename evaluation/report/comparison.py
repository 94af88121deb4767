"""Two runs or more side by side: what was configured otherwise, and what came of it."""

from collections.abc import Iterable, Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

from ddgrasp.files import atomic_write_text
from evaluation.report.html import contents, heading, leaves, page, table, text
from evaluation.report.meanings import explain
from evaluation.report.targets import targets, verdict

COMPARISON_HTML, COMPARISON_PNG = "comparison.html", "comparison.png"
_NO_RESULT = {
    "stages", "outdated", "config", "preset", "scale", "seed", "machine", "versions", "created",
    "contract_version", "targets", "begun",
}  # fmt: skip
"""Parts of a report that measure nothing."""
Rows = list[tuple[str, ...]]


def differences(reports: Sequence[Mapping[str, Any]]) -> tuple[Rows, Rows]:
    """(configuration, results): (dotted name, value in each of `reports`) where they are not all the same.

    Tables in a report, such as one of trials per object, are left out. Values that are too near each other
    for what people read of them are shown to their last digit.
    """
    stages = [item for report in reports for item in report["stages"].items()]
    others = [(stage, name) for stage, entry in stages for name in entry.get("made_with", {})]
    settings = [_settings(report, others) for report in reports]
    return _where_different(settings), _where_different([_results(report) for report in reports])


def write(runs: Sequence[Path], reports: Sequence[Mapping[str, Any]]) -> Path:
    """Writes the page into the first of `runs`; returns its path."""
    header = ("", *(str(run) for run in runs))
    settings, results = differences(reports)
    sections = ("Targets", "Configured otherwise", "Measured")
    verdicts = (
        f"<p class=verdict>{escape(str(run))}: {verdict(targets(r))}</p>"
        for run, r in zip(runs, reports, strict=True)
    )
    body = [
        f"<h1>{escape(' and '.join(run.resolve().name for run in runs))}</h1>",
        *verdicts,
        contents(sections),
        heading(sections[0]),
        table(header, _target_rows(reports)),
        heading(sections[1]),
        table(header, settings) if settings else "<p>Nothing.</p>",
        heading(sections[2]),
        "<p class=note>Where they differ. Success: rate of n trials, Wilson 95 % interval.</p>",
        table((*header, "meaning"), [(*row, explain(row[0])[1]) for row in results]),
    ]
    path = runs[0] / COMPARISON_HTML
    atomic_write_text(path, page("Runs side by side: DiffuDepGrasp-JAX", body))
    return path


def _target_rows(reports: Sequence[Mapping[str, Any]]) -> Rows:
    """(target, what each report measured and whether that meets it)."""
    judged = [{t["target"]: f"{t['measured']} {t['met']}".strip() for t in targets(r)} for r in reports]
    names = dict.fromkeys(name for column in judged for name in column)
    return [(name, *(column.get(name, "") for column in judged)) for name in names]


def _settings(report: Mapping[str, Any], others: Iterable[tuple[str, str]]) -> dict[str, Any]:
    """The run's, and `others`, (stage, setting) where some report's stage was made with another."""
    own = dict(leaves(report["config"]))
    made_with = {stage: own | entry.get("made_with", {}) for stage, entry in report["stages"].items()}
    stages = ((stage, name) for stage, name in others if stage in made_with)
    return own | {f"{stage}: {name}": made_with[stage].get(name) for stage, name in stages}


def _results(report: Mapping[str, Any]) -> dict[str, Any]:
    measured = {key: value for key, value in report.items() if key not in _NO_RESULT}
    seconds = {f"{name}.seconds": stage["seconds"] for name, stage in report["stages"].items()}
    return dict(leaves(measured | seconds))


def _where_different(columns: Sequence[Mapping[str, Any]]) -> Rows:
    names = dict.fromkeys(name for column in columns for name in column)
    rows = ((name, [column.get(name) for column in columns]) for name in names)
    return [(name, *_told_apart(name, values)) for name, values in rows if _count_distinct(values) > 1]


def _told_apart(name: str, values: Sequence[Any]) -> list[str]:
    """The values as people read them, or whole where some that differ would read alike."""
    texts = [text(value, explain(name)[0]) for value in values]
    if len(set(texts)) == _count_distinct(values):
        return texts
    return [_whole(value) for value in values]


def _whole(value: Any) -> str:
    if isinstance(value, Mapping):  # a success rate
        return f"{value['successes']} of {value['n']}"
    return "" if value is None else repr(value)


def _count_distinct(values: Sequence[Any]) -> int:
    return sum(value not in values[:place] for place, value in enumerate(values))
