"""Table II by one command: one teacher, one set of demos, a student per training depth, the same trials.

The stages are the pipeline's own. What all rows share is made once, in a folder of its own; a student's
manifest names it by hash. Every trial that was run is on disk before the next one ends.
"""

import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from app import pipeline
from ddgrasp import artifacts, attempts, machine
from ddgrasp.artifacts import Artifact
from ddgrasp.config import Config
from ddgrasp.files import atomic_write_bytes, atomic_write_json, atomic_write_text, read_json, to_json
from ddgrasp.job import start_of
from ddgrasp.policy_metadata import POLICY_FILE
from ddgrasp.progress import Progress
from ddgrasp.stages import get_stage
from ddgrasp.versions import library_versions
from evaluation import rig_trials
from evaluation.rig_trials import Series
from evaluation.table2 import results
from evaluation.table2.results import PAPER, SHARED, STUDENTS
from evaluation.table2.rows import ROWS, Row, row_config

STUDY_JSON, STUDY_HTML, STUDY_PNG = "study.json", "study.html", "study.png"
LAST_STAGE = "deploy"
"""A study depends on what this stage depends on."""
FILMED_FAILURES = 3
"""Films that are kept of an object's failures, per row."""
_COMMON = ("teacher", "demos", "record", "ddg")


@dataclass(frozen=True)
class Study:
    """What is to be done; everything in it was checked."""

    config: Config
    """What the rows have in common."""
    out: Path
    rows: tuple[str, ...]
    series: Series
    """Trials of every row."""
    workers: int
    left_out: Mapping[str, str]
    """Rows of the tables that cannot be made here, and why."""
    paper_from: str = ""
    """Run or folder with the paper's own generator, fitted already."""

    def row_config(self, row: Row) -> Config:
        """What one row is made with."""
        return row_config(self.config, row, self.paper_from)


def check_shared(config: Config, out: Path, resume: bool) -> None:
    """UserError unless the study in `out` can make or take its shared stages; a run that was lent to it may
    have gone on with a student of its own. Writes nothing."""
    pipeline.check_place(config, out / SHARED, resume=resume, stages=[get_stage(name) for name in _COMMON])


def check_place(study: Study, resume: bool) -> None:
    """Marks the folder as this study's. UserError if it holds one and `resume` is off, another one, a student
    that began with another checkpoint than is there now, or trials of a row that were begun otherwise."""
    check_shared(study.config, study.out, resume)
    start = start_of(study.config, "student")
    for made in sorted((study.out / STUDENTS).glob("*/student")):
        if artifacts.is_finished(made):  # else rows differ in more than the depth
            attempts.check_start(made, start)
    pipeline.create(study.out)
    attempts.begin(study.out, LAST_STAGE, study.config, clean=False)  # other rows may be made there
    for name in study.rows:
        _check_trials(study, name)


def _check_trials(study: Study, name: str) -> None:
    """UserError if the row's trials could not go on; without its policy nobody can say."""
    exported = study.out / STUDENTS / ROWS[name].student / "export"
    if artifacts.is_finished(exported):
        series, folder = _trials(study, name)
        rig_trials.check_place(study.row_config(ROWS[name]), exported / POLICY_FILE, series, folder)


def run(study: Study) -> dict[str, Any]:
    """Makes what is missing, row after row, and writes the tables after every one; returns study.json."""
    note = Progress(name="study table2").note
    for name, why in study.left_out.items():
        note(f"{ROWS[name].title} left out: {why}")
    common = {name: _shared(study, name) for name in _COMMON}
    written = {}
    for place, name in enumerate(study.rows, 1):
        row = ROWS[name]
        note(f"row {place} of {len(study.rows)}, {row.title}: student {row.student!r}")
        exported = _student(study, row, common)
        _try(study, name, study.row_config(row), exported)
        written = write(study)
    return written


def _shared(study: Study, stage: str) -> Artifact:
    return pipeline.make(get_stage(stage), study.config, study.out / SHARED, resume=True)


def _student(study: Study, row: Row, common: Mapping[str, Artifact]) -> Artifact:
    """The row's exported student, made if no other row that trains alike has made it."""
    config, folder = study.row_config(row), study.out / STUDENTS / row.student
    parents = {name: common[name] for name in get_stage("student").parents}
    if row.paper_generator:
        recordings = {"record": common["record"]}
        parents["ddg"] = pipeline.make(
            get_stage("ddg"), config, study.out / PAPER, resume=True, parents=recordings
        )
    pipeline.make(get_stage("student"), config, folder, resume=True, parents=parents)
    return pipeline.make(get_stage("export"), config, folder, resume=True)


def _try(study: Study, name: str, config: Config, exported: Artifact) -> None:
    series, folder = _trials(study, name)
    progress = Progress(name=f"trials, {name}")
    try:
        policy = exported.directory / POLICY_FILE
        rig_trials.run(config, policy, series, folder, study.workers, progress, FILMED_FAILURES)
    except KeyboardInterrupt:
        raise KeyboardInterrupt(
            f"Interrupted in the trials of row {name!r}. Finished ones are kept: the same command with "
            "--resume goes on."
        ) from None


def _trials(study: Study, name: str) -> tuple[Series, Path]:
    """A row's trials, and where they lie."""
    series = replace(study.series, depth=ROWS[name].depth)
    return series, results.row_folder(study.out, results.set_name(series), name)


def write(study: Study) -> dict[str, Any]:
    """Writes study.json, study.html and study.png from what is there; returns what study.json holds."""
    from evaluation.table2 import page

    config = to_json(study.config)
    collected, left_out = results.collect(study.out), _left_out(study.out) | dict(study.left_out)
    made = {
        "preset": study.config.preset,
        "seed": study.config.seed,
        "scale": study.config.scale,
        "created": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
        "machine": machine.describe(),
        "versions": library_versions(),
        "left_out": {name: why for name, why in left_out.items() if name not in collected["rows"]},
        **collected,
        "config": config,
    }
    picture = page.draw(made)
    atomic_write_bytes(study.out / STUDY_PNG, picture)
    atomic_write_text(study.out / STUDY_HTML, page.render(made, picture))
    atomic_write_json(study.out / STUDY_JSON, made)
    return made


def _left_out(out: Path) -> dict[str, str]:
    """Why which rows could not be made when they were last asked for."""
    path = out / STUDY_JSON
    return dict(read_json(path).get("left_out", {})) if path.exists() else {}
