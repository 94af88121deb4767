"""Which objects a policy was trained on, those of what it started from among them."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ddgrasp.artifacts import MANIFEST, read_artifact
from ddgrasp.errors import UserError
from ddgrasp.shipped import holding

_START = {"teacher": "start", "student": "init_from"}


def trained_objects(config: Mapping[str, Any], stage: str) -> tuple[str, ...]:
    """Objects that the teacher or student of a configuration (as JSON) has seen in training, each once.

    Its own world's, unless it is a start taken as it is, then those of the start, of the start's start, and
    so on for as long as their folders are here.
    """
    names: dict[str, None] = {}
    been: set[Path] = set()
    while True:
        start = config[stage][_START[stage]]
        folder = holding(start, MANIFEST, stage) if start else None
        if stage != "teacher" or folder is None or config["teacher"]["total_steps"]:
            names |= dict.fromkeys(config["world"]["objects"])
        if folder is None or folder in been:
            return tuple(names)
        been.add(folder)
        try:
            config = read_artifact(folder).manifest.config
        except UserError:  # of another version, or not finished: nothing is known of it
            return tuple(names)
