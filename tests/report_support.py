"""What tests ask of a report."""

import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from ddgrasp.progress import read_curves
from evaluation.report.html import is_records
from evaluation.report.meanings import MEANINGS
from evaluation.report.run_page import metrics_of

NAMING = ("objects", "per_object", "reward")
"""Parts of a name behind which an object, or a term of the reward, is named: what that is, no table says."""
RATE = {"rate", "n", "successes", "low", "high"}
"""A success rate, which is shown as one number."""


def unexplained(report: Mapping[str, Any], run: Path | None = None) -> list[str]:
    """Names of numbers of the stages, and of the curves of `run`, of which a part is told to no reader."""
    names = {
        f"{stage}.{name}" for stage in report["stages"] for name in _numbers(metrics_of(stage, report))
        if not _is_explained(stage, name)
    }  # fmt: skip
    curves = {name for stage in report["stages"] if run for name in read_curves(run / stage)}
    return sorted(names | {name for name in curves if not _is_explained("", name)})


def _is_explained(stage: str, name: str) -> bool:
    """Whether every part of the name, "sense_ms.p50" or "reward/lift", is in the table of meanings."""
    parts = re.split(r"[./]", name)
    return all(
        before in NAMING or part in MEANINGS or f"{before}.{part}" in MEANINGS
        for before, part in zip([stage, *parts], parts, strict=False)
    )


def _numbers(values: Mapping[str, Any]) -> Iterator[str]:
    """Names of the numbers in nested objects, and of a table of them the columns, as a page shows them."""
    for key, value in values.items():
        if is_records(value):
            yield from (name for row in value for name in _numbers(row))
        elif isinstance(value, Mapping) and not value.keys() <= RATE:
            yield from (f"{key}.{name}" for name in _numbers(value))
        elif isinstance(value, (int, float, Mapping)) and not isinstance(value, bool):
            yield key
