"""A study's outcome, read from what its rows left on disk: success, paired tests, simulation, times.

DIR/shared/{teacher, demos, record, ddg}   what all rows have in common
DIR/paper/ddg                              the paper's own generator
DIR/students/<student>/{student, export}   rows that train alike share one
DIR/trials/<set>/<row>/trials.jsonl        outcome of every trial
DIR/study.{json, html, png}                the tables
"""

import hashlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ddgrasp import artifacts
from ddgrasp.artifacts import Artifact
from ddgrasp.policy_metadata import POLICY_FILE
from deploy.trial_log import read_log
from deploy.trials import TrialResult
from evaluation import paired, rig_trials
from evaluation.report.summary import with_intervals
from evaluation.rig_trials import Series
from evaluation.table2.rows import DEPLOYED, ROWS, TABLES, TRAINING, Row, Table

SHARED, PAPER, STUDENTS, TRIALS = "shared", "paper", "students", "trials"
SIMULATED = {"clean": "student_clean", "own": "student_ddg"}
"""Depth in simulation -> what the student's manifest calls the success on it (own: as in its training)."""

_ALIKE = ("camera", "contact", "retry")
"""What the rows of a table agree on besides their trials."""


def set_name(series: Series) -> str:
    """Folder of the trials that are paired: one rig, one split, one seed."""
    return f"{series.rig}-{series.split}-{series.number}"


def describe_set(name: str) -> str:
    """What `set_name` made, in words."""
    rig, split, number = name.rsplit("-", 2)
    return f"{rig} rig, {split} seed {number}"


def row_folder(out: Path, set_of_trials: str, row: str) -> Path:
    """Where a row's trials lie."""
    return out / TRIALS / set_of_trials / row


def has_students(out: Path, rows: Sequence[str]) -> bool:
    """Whether the students of all `rows` are finished."""
    return all(artifacts.is_finished(out / STUDENTS / ROWS[row].student / "student") for row in rows)


def finished(out: Path, row: Row) -> set[str]:
    """Those of the stages that begin with a checkpoint which `row` finds made."""
    folders = {
        "teacher": SHARED,
        "ddg": PAPER if row.paper_generator else SHARED,
        "student": f"{STUDENTS}/{row.student}",
    }
    return {stage for stage, folder in folders.items() if artifacts.is_finished(out / folder / stage)}


def collect(out: Path) -> dict[str, Any]:
    """What study.json holds of rows and trials.

    Keys: `rows.<row>` = {title, training, deployment, generator_from (empty if it was fitted in the study),
    ripple_px, ellipses (expected in a picture), student: {name, seconds, simulation}}, of rows whose student
    is finished; `sets.<set>` = {trials: how the main table's reference was tried, or the first row that was,
    rows: each as `evaluation.rig_trials.tabulate` gives it, tables: see `compare`, apart: rows that are left
    out of their table's comparisons, see `tried_otherwise`}. A success rate is {rate, n, successes, low,
    high}.
    """
    rows = {
        name: _describe(row, artifacts.read_artifact(out / STUDENTS / row.student / "student"))
        for name, row in ROWS.items()
        if artifacts.is_finished(out / STUDENTS / row.student / "student")
    }
    return {"rows": rows, "sets": {folder.name: _set(folder) for folder in _sets(out)}}


def _sets(out: Path) -> list[Path]:
    """Folders of trials; what else lies beside them is somebody else's."""
    return sorted(folder for folder in (out / TRIALS).glob("*-*-*") if folder.is_dir())


def _describe(row: Row, student: Artifact) -> dict[str, Any]:
    measured = with_intervals(student.manifest.metrics)
    return {
        "title": row.title,
        "training": TRAINING[row.source],
        "deployment": DEPLOYED[row.depth],
        "generator_from": student.manifest.config["ddg"]["init_from"] if "learned" in row.source else "",
        "ripple_px": student.manifest.config["student"]["training"]["disparity_noise_px"],
        "ellipses": student.manifest.config["student"]["ellipse_dropout"],
        "student": {
            "name": row.student,
            "seconds": student.manifest.seconds,
            "simulation": {name: measured[key] for name, key in SIMULATED.items() if key in measured},
        },
    }


def _set(folder: Path) -> dict[str, Any]:
    logs = {name: read_log(folder / name / rig_trials.TRIALS_FILE) for name in ROWS}
    logs = {
        name: (belong_to, results)
        for name, (belong_to, results) in logs.items()
        if results and not _outdated(folder, name, belong_to)
    }
    headers = {name: belong_to for name, (belong_to, _) in logs.items()}
    tried = {name: results for name, (_, results) in logs.items()}
    apart = {name: tried_otherwise(table, headers) for name, table in TABLES.items()}
    same = ("rig", "split", "number", "shapes", "camera", "stereo", "seconds", "contact")
    belong_to = headers.get(TABLES["main"].reference) or next(iter(headers.values()), {})
    return {
        "trials": {key: value for key, value in rig_trials.shown(belong_to).items() if key in same},
        "rows": {
            name: rig_trials.tabulate(results, rig_trials.trained_on(headers[name]))
            for name, results in tried.items()
        },
        "tables": {name: compare(table, _without(apart[name], tried)) for name, table in TABLES.items()},
        "apart": apart,
    }


def tried_otherwise(table: Table, headers: Mapping[str, Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Rows of `table` that were not tried as its reference was, or, without it, as the first that was tried.

    Args:
      headers: row -> header of its log; of those that were tried.

    Keys: row; against, what it is set beside; differs, in what. Policy and treatment may differ: they are
    what the rows are tried for.
    """
    names = [name for name in (table.reference, *table.rows) if name in headers]
    return [
        {"row": name, "against": names[0], "differs": differs}
        for name in names[1:]
        if (differs := rig_trials.differing(headers[name], headers[names[0]], _ALIKE))
    ]


def _without(apart: Sequence[Mapping[str, Any]], tried: Mapping[str, Any]) -> dict[str, Any]:
    """Those of `tried` that are not `apart`."""
    left_out = {row["row"] for row in apart}
    return {name: results for name, results in tried.items() if name not in left_out}


def _outdated(folder: Path, row: str, belong_to: Mapping[str, Any]) -> bool:
    """Whether a log's trials were run with another policy than the row's student is now."""
    policy = folder.parent.parent / STUDENTS / ROWS[row].student / "export" / POLICY_FILE
    made = belong_to.get("policy_sha256")
    return made is not None and policy.is_file() and made != hashlib.sha256(policy.read_bytes()).hexdigest()


def compare(table: Table, tried: Mapping[str, Sequence[TrialResult]]) -> list[dict[str, Any]]:
    """A row of `table` each, but its reference: the reference against it on the trials that both had.

    Args:
      tried: row -> what came of its trials; of those that were tried as the reference was.

    Keys: row; n, pairs of trials; only_reference, only_row, pairs in which one alone succeeded; p, McNemar's
    exact two-sided one; p_holm, the same corrected for all rows of the table that were tried; difference, the
    reference's success less the row's. Rows that were not tried, or without the reference, are left out.
    """
    made = [
        _against(table.reference, name, tried)
        for name in table.rows
        if name != table.reference and name in tried and table.reference in tried
    ]
    made = [comparison for comparison in made if comparison["n"]]
    adjusted = paired.holm([comparison["p"] for comparison in made])
    return [comparison | {"p_holm": p} for comparison, p in zip(made, adjusted, strict=True)]


def _against(reference: str, row: str, tried: Mapping[str, Sequence[TrialResult]]) -> dict[str, Any]:
    ours, theirs = ({r.index: r.success for r in tried[name]} for name in (reference, row))
    return {"row": row, **paired.compared(ours, theirs)}
