"""What a person gets of a score: score.html, and a table at the terminal."""

from collections.abc import Mapping
from html import escape
from pathlib import Path
from typing import Any

from ddgrasp import artifacts, tables
from ddgrasp.progress import PICTURES
from evaluation.depth_score import curve, samplers
from evaluation.depth_score import table as score_table
from evaluation.report.html import image, page, table

JSON, HTML = "score.json", "score.html"


def summary(result: Mapping[str, Any]) -> dict[str, Any]:
    """What the manifest, and with it the run's report, keeps: texts of tables and targets."""
    tables = {f"distances, {n}": score_table.distance_rows(t) for n, t in result["tables"].items()}
    return {
        "setting": result["setting"],
        "features": list(result["features"]),
        "targets": result["targets"],
        **tables,
        "hole measures": score_table.hole_rows(result["holes"]),
    }


def render(result: Mapping[str, Any], pictures: Mapping[str, bytes]) -> str:
    """The page: one file with tables and pictures."""
    body = [
        "<h1>Generated depth against recorded depth</h1>",
        f"<p>{escape(result['setting'])} Intervals: 95 %, bootstrap over {escape(result['resampled'])}.</p>",
    ]
    for title, rows in _tables(summary(result)).items():
        columns = list(rows[0])
        body.append(f"<h2>{title}</h2>" + table(columns, [[row[c] for c in columns] for row in rows]))
    body.extend(f"<h2>{n}</h2>" + image(png, n) for n, png in pictures.items() if "table" not in n)
    return page("Generated depth against recorded depth", body)


def print_result(directory: Path) -> None:
    """Prints the tables of a finished score, curve or comparison of samplers, and where the rest is."""
    console = tables.console(width=220)
    for title, rows in _tables(artifacts.read_manifest(directory).metrics).items():
        console.print(tables.table(list(rows[0]), [list(row.values()) for row in rows], title))
    for name in (JSON, curve.JSON, samplers.JSON, HTML, PICTURES):
        if (directory / name).exists():
            print(directory / name)


def _tables(metrics: Mapping[str, Any]) -> dict[str, list[dict[str, str]]]:
    return {
        title: rows
        for title, rows in metrics.items()
        if isinstance(rows, list) and rows and isinstance(rows[0], Mapping)
    }
