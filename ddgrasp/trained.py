"""Which objects a policy was trained on, those of what it started from among them."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ddgrasp.artifacts import MANIFEST, is_finished, read_artifact, read_manifest
from ddgrasp.config import GUIDE, NOTHING, Config
from ddgrasp.errors import UserError
from ddgrasp.files import to_json
from ddgrasp.shipped import NAME, PRETRAINED, holding

_START = {"teacher": "start", "student": "init_from"}


def trains(config: Mapping[str, Any], stage: str) -> bool:
    """Whether the teacher or student of a configuration (as JSON) learns, or is a start taken as it is."""
    if stage == "teacher":
        return config["teacher"]["total_steps"] > 0
    student = config["student"]
    in_rounds = (student[name]["rounds"] * student[name]["steps"] for name in ("poses", "dagger"))
    return any((student["training"]["steps"], student["head"]["train_steps"], *in_rounds))


def policy_objects(policy: Path, config: Config) -> tuple[str, ...]:
    """`trained_objects` of an exported policy: of what made it, where its manifest lies beside it, or else of
    `config`."""
    beside = policy.parent
    made = read_manifest(beside).config if is_finished(beside) else to_json(config)
    return trained_objects(made, "student")


def trained_objects(config: Mapping[str, Any], stage: str) -> tuple[str, ...]:
    """Objects that the teacher or student of a configuration (as JSON) has seen in training, each once.

    Its own world's, unless it is a start taken as it is, then those of the start, of the start's start, and
    so on for as long as their folders are here: what lies there now, of shipped ones only what is shipped.
    """
    names: dict[str, None] = {}
    folder, been = None, set[Path]()
    while True:
        start = _start(config, stage, folder)
        folder = holding(start, MANIFEST, stage) if start else None
        if folder is None or trains(config, stage):
            names |= dict.fromkeys(config["world"]["objects"])
        if folder is None or folder in been:
            return tuple(names)
        been.add(folder)
        try:
            config = read_artifact(folder).manifest.config
        except UserError:  # of another version, or not finished: nothing is known of it
            return tuple(names)


def _start(config: Mapping[str, Any], stage: str, folder: Path | None) -> str:
    """What it began from; nothing where `folder` is shipped and that is not: another may lie there here."""
    start = config[stage][_START[stage]]
    if stage == "teacher" and start in (NOTHING, GUIDE):  # whatever folder has that name
        return ""
    is_shipped = folder is not None and folder.resolve().is_relative_to(PRETRAINED.resolve())
    return "" if is_shipped and Path(start).parts[:1] != (NAME,) else start
