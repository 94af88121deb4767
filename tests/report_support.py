"""What tests ask of a report."""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from ddgrasp.progress import read_curves
from evaluation.report.html import is_records
from evaluation.report.meanings import explain
from evaluation.report.run_page import metrics_of


def unexplained(report: Mapping[str, Any], run: Path | None = None) -> list[str]:
    """Names of numbers of the stages, and of the curves of `run`, that a reader is told nothing about."""
    names = [name for stage in report["stages"] for name in _numbers(stage, metrics_of(stage, report))]
    names += [name for stage in report["stages"] if run for name in read_curves(run / stage)]
    return sorted({name for name in names if not explain(name)[1]})


def _numbers(name: str, value: Any) -> Iterator[str]:
    if isinstance(value, Mapping):
        for key, item in value.items():
            yield from _numbers(f"{name}.{key}", item)
    elif is_records(value):
        for row in value:
            yield from _numbers(name, row)
    elif isinstance(value, (int, float)) and not isinstance(value, bool):
        yield name
