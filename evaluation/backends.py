"""What a teacher loses on physics backends it was not trained on: kept beside it, shown by the report."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from evaluation import beside, wilson

BACKENDS_FILE = "backends.json"
_KEPT = ("success", "objects", "saturated_actions", "contacts_dropped")


def save(directory: Path, results: Mapping[str, Mapping[str, Any]], seed: int) -> Path:
    """Writes `results` (backend -> what `ppo.evaluate` gave) beside the teacher in `directory`.

    Backends measured before stay, unless the teacher was made anew since. Returns the file.
    """
    rows = {row["backend"]: row for row in load(directory)}
    for name, result in results.items():
        rows[name] = {"backend": name, "seed": seed} | {key: result[key] for key in _KEPT}
    return beside.save(directory, BACKENDS_FILE, {"backends": list(rows.values())})


def load(directory: Path) -> list[dict[str, Any]]:
    """A row for each backend that `save` wrote of the teacher now in `directory`."""
    return beside.load(directory, BACKENDS_FILE).get("backends", [])


def table(directory: Path, trained_on: str) -> list[dict[str, Any]]:
    """For the report: backend, success, drop in points from the backend trained on (None if that one was not
    measured, or on episodes of another seed), the seed, contacts dropped (None if they were not kept), and
    the success of each object."""
    rows = {row["backend"]: row for row in load(directory)}
    rates = {name: _success(row["success"]) for name, row in rows.items()}
    home = rows.get(trained_on)
    return [
        {
            "backend": name + (" (trained on)" if name == trained_on else ""),
            "success": rates[name],
            "drop_points": 100 * (rates[trained_on]["rate"] - rates[name]["rate"])
            if home is not None and home["seed"] == row["seed"]
            else None,
            "seed": row["seed"],
            "contacts_dropped": row.get("contacts_dropped"),
            **{key: _success(counts) for key, counts in row["objects"].items()},
        }
        for name, row in rows.items()
    ]


def _success(counts: Mapping[str, int]) -> dict[str, Any]:
    return wilson.success(counts["successes"], counts["n"])
