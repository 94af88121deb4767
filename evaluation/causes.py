"""Where a policy loses, by cause: the development rig with one thing changed at a time, on the same trials.

DIR/<row>/trials.jsonl     outcome of every trial, kept and not run again
DIR/causes.json, causes.md the table
"""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from ddgrasp.config import Config
from ddgrasp.errors import UserError, unknown_name
from ddgrasp.files import atomic_write_json, atomic_write_text, read_json
from ddgrasp.install import FR3, check_fr3
from ddgrasp.progress import Progress
from ddgrasp.trained import policy_objects
from ddgrasp.versions import library_versions
from deploy.changes import Change
from deploy.fr3_trials import Fr3Bench
from deploy.generated_camera import GENERATED, SHIPPED, digest
from deploy.trial_log import CONFIG_HASH, read_log
from deploy.trials import Bench, Rig, TrialResult
from evaluation import paired, rig_trials, wilson
from evaluation.rig_trials import Series

JSON_FILE, TABLE_FILE, TIMES_FILE = "causes.json", "causes.md", "seconds.json"
EVERYTHING = "all"
REFERENCE, IDEAL, OTHER_TABLES = "development", "ideal", "other_tables"
_FILMED_FAILURES = 1


@dataclass(frozen=True)
class Row:
    """One change."""

    title: str
    cause: str
    """What of the test rig's differences it is."""
    bench: Change | Fr3Bench
    against: str = REFERENCE
    """The row that it differs from in one thing."""

    @property
    def needs(self) -> tuple[str, ...]:
        """Modules of the extra [fr3] that it takes."""
        return FR3 if isinstance(self.bench, Fr3Bench) else FR3[2:] if self.bench.world == "meshes" else ()

    @property
    def generated(self) -> bool:
        """Whether a generator takes part."""
        return isinstance(self.bench, Change) and self.bench.sight in GENERATED

    def make(self, generator: Path) -> Callable[[Config, Path], Bench]:
        """What makes a bench in every worker; `generator` is the file for a row that is `generated`."""
        if isinstance(self.bench, Fr3Bench):
            return self.bench
        return partial(Rig, change=replace(self.bench, generator=generator) if self.generated else self.bench)


ROWS: dict[str, Row] = {
    REFERENCE: Row("development rig", "", Change()),
    IDEAL: Row("camera without errors", "camera noise", Change(sight="ideal")),
    "holes": Row("camera's holes alone", "camera noise", Change(sight="holes"), against=IDEAL),
    "small_holes": Row(
        "camera's holes of up to 16 pixels alone", "camera noise", Change(sight="small holes"), against=IDEAL,
    ),
    "large_holes": Row(
        "camera's larger holes alone", "camera noise", Change(sight="large holes"), against=IDEAL,
    ),
    "values": Row("camera's values alone, no holes", "camera noise", Change(sight="values"), against=IDEAL),
    "ripple": Row(
        "values off by less than 1 px of disparity alone", "camera noise", Change(sight="ripple"),
        against=IDEAL,
    ),
    "mismatches": Row(
        "values off by 1 px or more alone", "camera noise", Change(sight="mismatches"), against=IDEAL,
    ),
    "generator": Row(
        "a generator's errors instead of the camera's", "camera noise", Change(sight="generator"),
    ),
    "generator_holes": Row(
        "a generator's holes, the camera's values", "camera noise", Change(sight="generator's holes"),
    ),
    "generator_values": Row(
        "a generator's values, the camera's holes", "camera noise", Change(sight="generator's values"),
    ),
    "full_size": Row("stereo matched at 848x480", "camera resolution", Change(sight="full size")),
    "meshes": Row("meshes instead of primitives", "object shape", Change("meshes")),
    "off_2mm": Row("camera off by 2 mm and 0.2 degrees", "calibration", Change(off=(0.002, 0.2))),
    "off_10mm": Row("camera off by 10 mm and 1 degree", "calibration", Change(off=(0.010, 1.0))),
    "furniture": Row("end of the table, wall, clutter", "table and clutter", Change("furniture")),
    "dark_table": Row("dark table", "table and clutter", Change("dark table")),
    OTHER_TABLES: Row(
        "a table light and dark elsewhere in every trial", "table and clutter", Change("other tables"),
    ),
    "spring": Row("arm follows as the Franka driver's spring", "dynamics", Change("spring")),
    "fr3": Row(
        "FR3 behind its protocol, on the same ground, primitives", "robot model",
        Fr3Bench("primitive", "ideal", bare=True, paired=True), against=IDEAL,
    ),
    "test_rig": Row("test rig: all of it together", "everything", Fr3Bench(paired=True)),
}  # fmt: skip
"""What the table can have, in its order."""


def chosen(names: Sequence[str]) -> tuple[str, ...]:
    """Rows by name, with those that they are compared with, in the table's order.

    UserError for an unknown one, none at all, or one whose packages are absent.
    """
    if not names:
        raise UserError(f"--rows names none: give {EVERYTHING}, or of {', '.join(ROWS)}.")
    if len(names) > 1 and EVERYTHING in names:
        raise UserError(f"--rows {EVERYTHING} names every row: drop the others, or {EVERYTHING}.")
    asked = tuple(ROWS) if tuple(names) == (EVERYTHING,) else names
    for name in asked:
        if name not in ROWS:
            raise unknown_name("row", name, (*ROWS, EVERYTHING))
        check_fr3(f"row {name!r}", ROWS[name].needs)
    needed = {*asked, *(ROWS[name].against for name in asked), REFERENCE}
    return tuple(name for name in ROWS if name in needed)


def run(
    config: Config,
    policy: Path,
    names: Sequence[str],
    series: Series,
    out: Path,
    workers: int,
    generator: Path = SHIPPED,
) -> dict[str, Any]:
    """The table of the rows `names`; writes it after every row. Trials that `out` has are not run again.

    Row `other_tables` is left out where the configuration has other tables in every row.

    Args:
      series: objects, trials, seed, seconds and retry, the same for every row; rig, camera and depth are a
        row's own and count for nothing. UserError for what rig fr3 alone has: contact, shapes, coarse camera.
      generator: the file for rows with a generator's errors. UserError if there is such a row and it is none.
    """
    series = replace(series, rig="development")
    trained = policy_objects(policy, config)
    config = one_pose(series.configured(config, policy))
    trials = series.plan()
    if config.record.other_tables and OTHER_TABLES in names:
        names = tuple(name for name in names if name != OTHER_TABLES)
        Progress(name="causes").note(
            f"row {OTHER_TABLES} is left out: record.other_tables has it in every row"
        )
    belong_to = rig_trials.made_with(config, policy, trained) | {
        "number": series.number,
        "seconds": series.seconds,
    }
    about = {"number": series.number, "policy": str(policy), "other_tables": config.record.other_tables}
    if set_to := rig_trials.stereo_set_to(config):
        belong_to[rig_trials.STEREO] = about[rig_trials.STEREO] = set_to
    # Rows are compared by it: new ones of a folder that an earlier version began have that version's.
    there = {read_log(out / name / rig_trials.TRIALS_FILE)[0].get(CONFIG_HASH) for name in ROWS}
    belong_to[CONFIG_HASH] = sorted(belong_to[CONFIG_HASH], key=lambda made: made not in there)
    headers = {name: belong_to | {"row": name} for name in names}
    if generated := [name for name in names if ROWS[name].generated]:
        drawn_by = {"generator_sha256": digest(generator, config.world.profile)}
        headers |= {name: headers[name] | drawn_by for name in generated}
        about |= {"generator": str(generator)} | drawn_by
    for name, header in headers.items():
        rig_trials.check_log(out / name, header)
    if set_to:
        Progress(name="causes").note(f"the rig's camera has {rig_trials.describe_stereo(set_to)}")
    made: dict[str, Any] = {}
    for place, name in enumerate(names, 1):
        folder, progress = out / name, Progress(name=name)
        progress.note(f"row {place} of {len(names)}: {ROWS[name].title}")
        known = len(_known(folder))
        begun = time.monotonic()
        rig_trials.run_missing(
            config, policy, trials, ROWS[name].make(generator), headers[name], folder, workers, progress,
            _FILMED_FAILURES,
        )  # fmt: skip
        new = len(_known(folder)) - known
        if new:
            _add_time(folder, time.monotonic() - begun, new, workers)
        made = write(out, about)
    return made


def one_pose(config: Config) -> Config:
    """`config` in which can and block rest as their meshes do: else their pose would be a second change."""
    random = replace(config.world.random, other_pose_share=0.0)
    return replace(config, world=replace(config.world, random=random))


def write(out: Path, about: Mapping[str, Any]) -> dict[str, Any]:
    """Writes causes.json and causes.md from what `out` has; returns what causes.json holds."""
    made = {
        "created": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
        "versions": library_versions(),
        **about,
        "rows": table(out),
    }
    atomic_write_json(out / JSON_FILE, made)
    camera = about.get(rig_trials.STEREO)
    head = f"The rig's camera has {rig_trials.describe_stereo(camera)}:\n\n" if camera else ""
    atomic_write_text(out / TABLE_FILE, head + markdown(made["rows"]))
    return made


def table(out: Path) -> list[dict[str, Any]]:
    """A row each of those that were tried.

    Keys: row, cause, change; success with its Wilson interval; objects; faults; seconds_per_trial, which one
    takes a worker; against and the pairs (`evaluation.paired.compared`), None without a common trial; p_holm,
    corrected for all that have any; differs, in what it was tried otherwise than `against`, and so has no
    pairs.
    """
    tried = {name: {r.index: r.success for r in _known(out / name)} for name in ROWS}
    rows = [_row(out, name, tried) for name in ROWS if tried[name]]
    asked = [row for row in rows if row["pairs"]]
    for row, p in zip(asked, paired.holm([row["pairs"]["p"] for row in asked]), strict=True):
        row["pairs"]["p_holm"] = p
    return rows


def _row(out: Path, name: str, tried: Mapping[str, Mapping[int, bool]]) -> dict[str, Any]:
    row, counts = ROWS[name], rig_trials.tabulate(_known(out / name))
    against = {} if name == REFERENCE else tried[row.against]
    differs = _differing(out / name, out / row.against) if against else []
    pairs = paired.compared({} if differs else against, tried[name])
    return {
        "row": name,
        "cause": row.cause,
        "change": row.title,
        "success": counts["all"],
        "objects": counts["objects"],
        "faults": counts["faults"],
        "seconds_per_trial": _seconds_per_trial(out / name),
        "against": row.against if pairs["n"] else None,
        "pairs": pairs if pairs["n"] else None,
        "differs": differs,
    }


def _differing(one: Path, other: Path) -> list[str]:
    """In what two rows were tried otherwise, policy and configuration included."""
    headers = [read_log(folder / rig_trials.TRIALS_FILE)[0] for folder in (one, other)]
    return rig_trials.differing(*headers, alike=("policy_sha256", CONFIG_HASH))


def markdown(rows: Sequence[Mapping[str, Any]]) -> str:
    """The table for a page."""
    head = "| cause | change | success (Wilson 95 %) | against | lost, gained | p (Holm) | s a trial |"
    lines = [head, "|---|---|---|---|---|---|---|"]
    for row in rows:
        pairs, seconds = row["pairs"], row["seconds_per_trial"]
        against = ROWS[row["against"]].title if pairs else "tried otherwise" if row["differs"] else ""
        flips = f"{pairs['only_reference']}, {pairs['only_row']} of {pairs['n']}" if pairs else ""
        p = paired.describe_p(pairs["p_holm"]) if pairs else ""
        took = f"{seconds:.0f}" if seconds is not None else ""
        cells = (row["cause"], row["change"], wilson.describe(row["success"]), against, flips, p, took)
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def _add_time(folder: Path, seconds: float, trials: int, workers: int) -> None:
    """Adds what a session took, `trials` by that many workers, to those before it."""
    before = _times(folder)
    made = {
        "worker_seconds": before["worker_seconds"] + seconds * max(1, min(workers, trials)),
        "trials": before["trials"] + trials,
    }
    atomic_write_json(folder / TIMES_FILE, made)


def _seconds_per_trial(folder: Path) -> float | None:
    times = _times(folder)
    return times["worker_seconds"] / times["trials"] if times["trials"] else None


def _times(folder: Path) -> dict[str, float]:
    """worker_seconds, of all sessions together, and in how many trials."""
    path = folder / TIMES_FILE
    times = read_json(path) if path.exists() else {"worker_seconds": 0.0, "trials": 0}
    if "seconds_per_trial" in times:  # a session's, as until 2026-11-28; of how many trials it does not say
        return {"worker_seconds": times["seconds_per_trial"] * max(1, times["workers"]), "trials": 1}
    return times


def _known(folder: Path) -> list[TrialResult]:
    return read_log(folder / rig_trials.TRIALS_FILE)[1]
