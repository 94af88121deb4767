"""What `ddgrasp teacher eval` measured: kept beside the teacher, shown by the report."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Real

from ddgrasp import artifacts
from ddgrasp.artifacts import Artifact
from ddgrasp.config import WorldConfig
from ddgrasp.files import atomic_write_bytes, atomic_write_json, to_json
from ddgrasp.progress import PICTURES
from ddgrasp.trained import trained_objects
from evaluation import beside, wilson
from evaluation.report import figures

TRIALS_FILE = "trials.json"
SHEET_FILE = "episodes.png"


def summarise(result: Mapping[str, Any], teacher: Artifact, world: WorldConfig, seed: int) -> dict[str, Any]:
    """`result` of `ppo.trials.measure` as it is kept.

    Args:
      result: see there.
      teacher: what was measured.
      world: where it was measured.
      seed: of the episodes.

    Keys: teacher (its hash), seed, world; success, and the same of the objects that it was trained on
    (`seen`) and of the others (`unseen`), if there are any: {rate, n, successes, low, high}; objects: a row
    per object and one for all, {object, success, motion and visibility}.
    """
    counts = {**result["objects"], "all": result["success"]}
    trained = trained_objects(teacher.manifest.config, "teacher")
    groups = {
        "seen": [c for name, c in result["objects"].items() if name in trained],
        "unseen": [c for name, c in result["objects"].items() if name not in trained],
    }
    pooled = {name: _pool(some) for name, some in groups.items() if some}
    rows = [
        {"object": row["object"], "success": _pool([counts[row["object"]]])}
        | {key: value for key, value in row.items() if key != "object"}
        for row in result["motion"]
    ]
    origin = {"teacher": teacher.hash, "seed": seed, "world": to_json(world)}
    return origin | {"success": _pool([result["success"]])} | pooled | {"objects": rows}


def save(
    directory: Path,
    summary: Mapping[str, Any],
    pictures: Mapping[str, Real[np.ndarray, "_ _ _ 3"]],
    titles: Sequence[str],
) -> tuple[Path, Path]:
    """Writes the JSON and the contact sheet into `directory`; returns both files.

    Args:
      directory: the teacher's, if the report is to show them.
      summary: of `summarise`.
      pictures: object -> (M, H, W, 3).
      titles: M names.
    """
    path, sheet = directory / TRIALS_FILE, directory / PICTURES / SHEET_FILE
    atomic_write_json(path, summary)
    atomic_write_bytes(sheet, figures.draw_sheet({k: list(v) for k, v in pictures.items()}, titles))
    return path, sheet


def load(directory: Path) -> list[dict[str, Any]]:
    """The rows that `save` kept of the teacher now in `directory`, if it was tried in the world that it was
    trained in, whatever the objects."""
    saved = beside.load(directory, TRIALS_FILE)
    its_own = saved and is_its_world(artifacts.read_artifact(directory), saved["world"])
    return saved["objects"] if its_own else []


def is_its_world(teacher: Artifact, world: Mapping[str, Any]) -> bool:
    """Whether `world`, a `WorldConfig` as JSON, is the one that the teacher was trained in, whatever the
    objects."""
    here, there = ({**settings, "objects": None} for settings in (teacher.manifest.config["world"], world))
    return _alike(here, there)


def _alike(here: Any, there: Any) -> bool:
    """Whether two configurations agree in all settings that both have: one may be older."""
    if isinstance(here, Mapping) and isinstance(there, Mapping):
        return all(_alike(here[name], there[name]) for name in here.keys() & there.keys())
    return here == there


def print_summary(summary: Mapping[str, Any]) -> None:
    """Prints success, and the table of motion and visibility."""
    rows = summary["objects"]
    lines = {row["object"]: row["success"] for row in rows}
    lines |= {name: summary[name] for name in ("seen", "unseen") if name in summary}
    for name, success in lines.items():
        print(f"{name:<12} {wilson.describe(success)}")
    columns = [column for column in rows[-1] if column not in ("object", "success")]
    print("\n" + "  ".join([f"{'object':<12}", *columns]))
    for row in rows:
        numbers = (f"{row[column]:>{len(column)}.3f}" for column in columns)
        print("  ".join([f"{row['object']:<12}", *numbers]))
    print(
        "acceleration and jerk relative to Franka's limits, over 100 ms; toggles per episode; pixels of the "
        "object\nin the student's crop, over the steps before the first contact"
    )


def _pool(counts: list[Mapping[str, int]]) -> dict[str, Any]:
    return wilson.success(sum(c["successes"] for c in counts), sum(c["n"] for c in counts))
