"""What a student perceives beside the truth: kept beside it, shown by the report. Without JAX."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from evaluation import beside

PERCEPTION_FILE = "perception.json"


def describe(rows: Sequence[Mapping[str, Any]]) -> str:
    """The rows as text."""
    lines = (
        [list(rows[0]), *(["" if value is None else str(value) for value in row.values()] for row in rows)]
        if rows
        else []
    )
    widths = [max(len(line[i]) for line in lines) for i in range(len(lines[0]))] if lines else []
    return "\n".join("  ".join(cell.rjust(w) for cell, w in zip(line, widths, strict=True)) for line in lines)


def save(directory: Path, camera: str, rows: Sequence[Mapping[str, Any]]) -> Path:
    """Writes the rows of one camera beside the student in `directory`; those of others stay, unless the
    student was made anew since. Returns the file."""
    kept = [row for row in load(directory) if row["camera"] != camera]
    made = [{"camera": camera, **row} for row in rows]
    return beside.save(directory, PERCEPTION_FILE, {"rows": kept + made})


def load(directory: Path) -> list[dict[str, Any]]:
    """Rows that `save` wrote of the student now in `directory`."""
    return beside.load(directory, PERCEPTION_FILE).get("rows", [])
