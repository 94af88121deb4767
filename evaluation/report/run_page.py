"""report.html of a run: verdict, contents, summary, then every stage's numbers, curves and pictures."""

import json
from collections.abc import Mapping
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from ddgrasp.files import DAMAGED_NPZ
from ddgrasp.progress import PICTURES, read_curves
from ddgrasp.stages import ON_REQUEST, STAGES, Stage
from evaluation.report import figures
from evaluation.report.html import (
    contents,
    film,
    heading,
    image,
    is_records,
    judgement,
    leaves,
    numbers,
    page,
    records,
    table,
    text,
)
from evaluation.report.meanings import explain
from evaluation.report.summary import summary_rows, trial_run
from evaluation.report.targets import targets
from evaluation.teacher_trials import SHEET_FILE

SUMMARY, ORIGIN = "Summary", "How it was made"
_STUDENT = {"student": ("student_clean", "student_ddg"), "deploy": ("student_rig",)}
"""Numbers of a report's top level, by the stage that measured them."""


def render_html(report: Mapping[str, Any], run_dir: Path) -> str:
    """The whole page of one run."""
    preset = escape(str(report["preset"]))
    made = f"{report['created']}. {_machines(report['stages'])}"
    stages = [stage for stage in (*STAGES, *ON_REQUEST) if stage.name in report["stages"]]
    warning = trial_run(report)
    body = [
        f"<h1>DiffuDepGrasp-JAX: run <code>{escape(run_dir.resolve().name)}</code>, preset {preset}</h1>",
        f"<p class=missed>{escape(warning)}</p>" if warning else "",
        *judgement(targets(report)),
        contents([SUMMARY, *(stage.name for stage in stages), ORIGIN]),
        heading(SUMMARY),
        f"<p class=note>{escape(made)} Success: rate of n trials, Wilson 95 % interval. The development "
        "rig is a Franka in MuJoCo's C engine seen by a simulated active-stereo camera; no real robot was "
        "used.</p>",
        table(("Stage", "From", "Time", "Measured"), summary_rows(report), last_bold=True),
        *(part for stage in stages for part in _section(stage, report, run_dir / stage.name)),
        *_origin(report),
    ]
    return page(f"{preset}: DiffuDepGrasp-JAX report", body)


def _machines(stages: Mapping[str, Any]) -> str:
    """What the stages were made on: one line for all, or each with its own."""
    made_on = {name: _machine(entry.get("machine", {})) for name, entry in stages.items()}
    if len(kinds := set(made_on.values())) == 1:
        return f"Made on {kinds.pop()}."
    return " ".join(f"{name} made on {where}." for name, where in made_on.items())


def _machine(described: Mapping[str, Any]) -> str:
    if not described:
        return "a machine that was not noted then"
    return ", ".join((described["processor"], f"{described['cores']} cores", *described["accelerators"]))


def metrics_of(stage: str, report: Mapping[str, Any]) -> dict[str, Any]:
    """What a stage measured, the student's numbers of the report's top level included."""
    names = _STUDENT.get(stage, ())
    return dict(report.get(stage, {})) | {name: report[name] for name in names if name in report}


def _section(stage: Stage, report: Mapping[str, Any], directory: Path) -> list[str]:
    metrics = metrics_of(stage.name, report)
    tables = {key: value for key, value in metrics.items() if is_records(value)}
    return [
        heading(stage.name),
        f"<p class=note>{escape(stage.makes)}</p>",
        _made_with(report["stages"][stage.name].get("made_with", {}), dict(leaves(report["config"]))),
        numbers({key: value for key, value in metrics.items() if key not in tables}, stage.name),
        *(_titled(title, records(rows, stage.name)) for title, rows in tables.items()),
        *_curves(stage.name, directory),
        *(_titled(path.stem, _picture(path)) for path in _pictures(directory, metrics)),
    ]


def _made_with(own: Mapping[str, Any], run: Mapping[str, Any]) -> str:
    """What the configuration at the page's end does not say of a stage; nothing where it says it all."""
    if not own:
        return ""
    rows = [(name, text(value), text(run.get(name, ""))) for name, value in own.items()]
    return (
        f"<details><summary>Made with other settings than the run's: {len(rows)}</summary>"
        f"{table(('Setting', 'This stage', 'The run'), rows)}</details>"
    )


def _pictures(directory: Path, metrics: Mapping[str, Any]) -> list[Path]:
    """Those of the stage; the sheet of a teacher's trials where these are shown, too."""
    found = sorted((directory / PICTURES).glob("[!.]*"))
    return [path for path in found if path.name != SHEET_FILE or "trials" in metrics]


def _titled(title: str, part: str) -> str:
    return f"<h3>{escape(title.replace('_', ' '))}</h3>{part}"


def _curves(stage: str, directory: Path) -> list[str]:
    curves = read_curves(directory)
    parts = [_curve(stage, name, points) for name, points in curves.items()]
    return ["<h3>Curves</h3>", '<div class="curves">', *parts, "</div>"] if parts else []


def _curve(stage: str, name: str, points: list[tuple[int, float]]) -> str:
    unit, meaning = explain(name)
    drawn = figures.draw_curve(points, name, _step(stage, name), unit)
    return f"<div>{image(drawn, f'{name} of {stage}')}<p class=note>{escape(meaning)}</p></div>"


def _step(stage: str, name: str) -> str:
    """What a curve's points are counted in."""
    if name.startswith(("pose_", "clone_")):
        return "round"
    return "update" if stage == "teacher" else "training step"


def _picture(path: Path) -> str:
    title = path.stem.replace("_", " ")
    if path.suffix == ".png":
        return image(path.read_bytes(), title)
    if path.suffix != ".npz":
        return ""
    try:
        with np.load(path) as panels:
            return film(figures.draw_panels(dict(panels)), title)
    except DAMAGED_NPZ as error:
        return f"<p>{escape(path.name)} cannot be shown: {escape(str(error))}</p>"


def _origin(report: Mapping[str, Any]) -> list[str]:
    versions = ", ".join(f"{name} {version}" for name, version in report["versions"].items())
    config = escape(json.dumps(report["config"], indent=2))
    return [
        heading(ORIGIN),
        f"<p>Seed {escape(str(report['seed']))}. {escape(versions)}.</p>",
        f"<details><summary>Configuration</summary><pre>{config}</pre></details>",
    ]
