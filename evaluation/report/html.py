"""report.html: one file with everything in it, to be opened by double-click or sent by mail."""

import base64
import json
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from ddgrasp.progress import PICTURES, read_curves
from ddgrasp.stages import ON_REQUEST, STAGES
from evaluation import wilson
from evaluation.report import figures
from evaluation.report.summary import summary_rows, trial_run

REPORT_HTML = "report.html"

_STYLE = """
:root { color-scheme: light; }
body { font: 15px/1.5 system-ui, sans-serif; max-width: 72rem; margin: 2rem auto; padding: 0 1rem; }
body { color: #1b1f24; background: #fff; }
h1 { font-size: 1.5rem; } h2 { font-size: 1.15rem; margin-top: 2.2rem; border-bottom: 1px solid #d5d9de; }
h3 { font-size: 1rem; margin-bottom: .3rem; }
table { border-collapse: collapse; margin: .6rem 0; font-variant-numeric: tabular-nums; }
table { display: block; overflow-x: auto; }
th, td { text-align: left; padding: .2rem .9rem .2rem 0; vertical-align: top; }
tr { border-bottom: 1px solid #eceef1; }
tr.last td { font-weight: 600; }
img { max-width: 100%; display: block; margin: .5rem 0; }
.note { color: #57606a; } details { margin: .5rem 0; } pre { overflow: auto; font-size: 12px; }
"""


def render_html(report: Mapping[str, Any], run_dir: Path) -> str:
    """The whole page: summary, then per stage its numbers, curves and pictures, then how it was made."""
    preset = escape(str(report["preset"]))
    machine = report["machine"]
    made = f"{report['created']}, {machine['processor']}, {machine['cores']} cores."
    body = [
        f"<h1>DiffuDepGrasp-JAX: run <code>{escape(run_dir.name)}</code>, preset {preset}</h1>",
        f"<p><strong>{escape(trial_run(report))}</strong></p>",
        f"<p class=note>{escape(made)} Success: rate of n trials, Wilson 95 % interval. The pseudo-real "
        "rig is a Franka in MuJoCo's C engine seen by a simulated active-stereo camera; no real robot was "
        "used.</p>",
        table(("Stage", "From", "Time", "Measured"), summary_rows(report), last_bold=True),
    ]
    for stage in (*STAGES, *ON_REQUEST):
        if stage.name in report["stages"]:
            body.append(f"<h2>{stage.name}</h2><p class=note>{escape(stage.makes)}</p>")
            body.extend(_stage_section(stage.name, report, run_dir / stage.name))
    versions = ", ".join(f"{name} {version}" for name, version in report["versions"].items())
    body.append(f"<h2>How it was made</h2><p>Seed {report['seed']}. {escape(versions)}.</p>")
    config = escape(json.dumps(report["config"], indent=2))
    body.append(f"<details><summary>Configuration</summary><pre>{config}</pre></details>")
    return page(f"{preset}: DiffuDepGrasp-JAX report", body)


def page(title: str, body: Sequence[str]) -> str:
    """An HTML document with the report's style; `title` and `body` are HTML already."""
    phone = '<meta name=viewport content="width=device-width, initial-scale=1">'
    head = f"<meta charset=utf-8>{phone}<title>{title}</title><style>{_STYLE}</style>"
    lines = "\n".join(body)
    return f"<!doctype html><html lang=en><head>{head}</head><body>\n{lines}\n</body></html>\n"


def _stage_section(name: str, report: Mapping[str, Any], directory: Path) -> list[str]:
    metrics = dict(report.get(name, {}))
    if name == "student":
        metrics.update({key: report[key] for key in ("student_clean", "student_ddg") if key in report})
    if name == "deploy" and "student_rig" in report:
        metrics["student_rig"] = report["student_rig"]
    tables = {key: value for key, value in metrics.items() if _is_records(value)}
    scalars = flatten({key: value for key, value in metrics.items() if key not in tables})
    parts = [table((), scalars)] if scalars else []
    for title, records in tables.items():
        columns = list(dict.fromkeys(key for record in records for key in record))
        rows = [[_text(record.get(column, "")) for column in columns] for record in records]
        parts.append(f"<h3>{escape(title.replace('_', ' '))}</h3>" + table(columns, rows))
    if curves := read_curves(directory):
        parts.append("<h3>Curves</h3>" + image(figures.draw_curves(curves), f"curves of stage {name}"))
    for path in sorted((directory / PICTURES).glob("*")):
        title = path.stem.replace("_", " ")
        parts.append(f"<h3>{escape(title)}</h3>" + _picture(path, title))
    return parts


def _picture(path: Path, title: str) -> str:
    if path.suffix == ".png":
        return image(path.read_bytes(), title)
    if path.suffix != ".npz" or path.name.startswith("."):
        return ""
    try:
        with np.load(path) as panels:
            return image(figures.draw_panels(dict(panels)), title)
    except (ValueError, OSError, EOFError) as error:
        return f"<p>{escape(path.name)} cannot be shown: {escape(str(error))}</p>"


def image(png: bytes, alt: str) -> str:
    """An <img> with the picture in it."""
    data = base64.b64encode(png).decode()
    return f'<img alt="{escape(alt)}" src="data:image/png;base64,{data}">'


def table(header: Sequence[str], rows: Sequence[Sequence[str]], last_bold: bool = False) -> str:
    """A <table> of plain text, which is escaped."""
    head = "<tr>" + "".join(f"<th>{escape(title)}</th>" for title in header) + "</tr>" if header else ""
    lines = []
    for index, row in enumerate(rows):
        mark = " class=last" if last_bold and index == len(rows) - 1 else ""
        lines.append(f"<tr{mark}>" + "".join(f"<td>{escape(cell)}</td>" for cell in row) + "</tr>")
    return f"<table>{head}{''.join(lines)}</table>"


def _is_records(value: Any) -> bool:
    return isinstance(value, list) and bool(value) and all(isinstance(item, Mapping) for item in value)


def flatten(value: Mapping[str, Any], prefix: str = "") -> list[tuple[str, str]]:
    """(dotted name, text) of every number and text in nested objects; a success rate is one line, and lists
    of objects, which are tables, are left out."""
    lines = []
    for key, item in value.items():
        name = f"{prefix}{key}"
        if _is_records(item):
            continue
        if isinstance(item, Mapping) and not _is_success(item):
            lines.extend(flatten(item, f"{name}."))
        else:
            lines.append((name, _text(item)))
    return lines


def _is_success(value: Any) -> bool:
    return isinstance(value, Mapping) and {"rate", "n", "low", "high"} <= value.keys()


def _text(value: Any) -> str:
    if _is_success(value):
        return wilson.describe(value)
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, list):
        return ", ".join(_text(item) for item in value)
    return "" if value is None else str(value)
