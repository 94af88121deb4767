"""What was measured on a finished stage afterwards: in a file beside it, and true of that artifact alone."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ddgrasp import artifacts
from ddgrasp.files import atomic_write_json, read_json


def save(directory: Path, name: str, measured: Mapping[str, Any]) -> Path:
    """Writes `measured`, and under the stage's name which artifact it is of; returns the file."""
    artifact = artifacts.read_artifact(directory)
    atomic_write_json(directory / name, {artifact.manifest.stage: artifact.hash, **measured})
    return directory / name


def load(directory: Path, name: str) -> dict[str, Any]:
    """What the file holds; nothing without one, or if it is not of that artifact: made anew since, say."""
    if not (directory / name).exists():
        return {}
    saved, artifact = read_json(directory / name), artifacts.read_artifact(directory)
    own = isinstance(saved, dict) and saved.get(artifact.manifest.stage) == artifact.hash
    return saved if own else {}
