"""What a stage leaves on disk: a directory with a manifest, written so that nothing half-done is ever read.

A stage's directory is finished once it holds `manifest.json`, which is written last (how: ddgrasp/files.py).
This module imports no JAX.
"""

import dataclasses
import hashlib
import time
import typing
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from ddgrasp import contract, machine, upgrades
from ddgrasp.config import Config
from ddgrasp.config.checks import has_sections
from ddgrasp.config_hash import check_same, config_hash
from ddgrasp.errors import UserError
from ddgrasp.files import atomic_write_json, is_number, read_json, to_json, to_tuples
from ddgrasp.stages import MADE_BY
from ddgrasp.versions import library_versions

MANIFEST = "manifest.json"

_ORIGINS = ("trained", "loaded")


@dataclasses.dataclass(frozen=True)
class Manifest:
    """Where an artifact came from and what was measured on it."""

    stage: str
    """A name of ddgrasp/stages.py."""
    config: dict[str, Any]
    """The whole configuration, as JSON."""
    config_hash: str
    """Hash of the parts of the configuration that this stage depends on (`stages.config_fields`)."""
    contract_version: int
    versions: dict[str, str]
    """Python, this project and the libraries."""
    seed: int
    parents: dict[str, str]
    """Stage name -> hash of the manifest this artifact was made from."""
    seconds: float
    """Wall time spent, interrupted attempts included."""
    origin: str
    """"trained" (made in this run) or "loaded" (a checkpoint made by another run)."""
    metrics: dict[str, Any]
    """What the stage measured; goes into report.json. A success rate is {"successes": k, "n": n}."""
    created: str = ""
    """UTC time."""
    machine: dict[str, Any] = dataclasses.field(default_factory=dict)
    """What it was made on (`machine.describe`); empty before 2026-11-28."""
    manifest_version: int = upgrades.VERSION
    """Format of the configuration's fields (ddgrasp/upgrades.py). A Manifest's are always this code's."""

    def __post_init__(self):
        if self.origin not in _ORIGINS:
            raise ValueError(f"origin is {self.origin!r}; expected 'trained' or 'loaded'")


@dataclasses.dataclass(frozen=True)
class Artifact:
    """A finished stage."""

    directory: Path
    manifest: Manifest
    hash: str
    """Identifies this very artifact: children name it among their parents."""


def write_manifest(directory: Path | str, manifest: Manifest) -> Artifact:
    """Finishes a stage: writes manifest.json, the last file of its directory, and returns the artifact."""
    atomic_write_json(Path(directory) / MANIFEST, manifest)
    return read_artifact(directory)


def read_manifest(directory: Path | str) -> Manifest:
    """The manifest of a finished stage; UserError if there is none, it is damaged, or of another contract."""
    path = Path(directory) / MANIFEST
    if not path.exists():
        raise UserError(
            f"{directory} holds no finished artifact ({MANIFEST} is absent): run that stage first."
        )
    value = read_json(path)
    names = {field.name for field in dataclasses.fields(Manifest)}
    later = {"created", "machine", upgrades.VERSION_FIELD}
    absent = names - value.keys() - later if isinstance(value, dict) else names
    if absent or not _has_own_kinds(value):
        raise _damaged(path)
    if value["contract_version"] != contract.CONTRACT_VERSION:
        raise UserError(
            f"{path} was made with contract version {value['contract_version']}, this code has "
            f"{contract.CONTRACT_VERSION}: make it again, or use the release that made it."
        )
    if (config := config_of(value, path)) is None:
        raise _damaged(path)
    known = {name: value[name] for name in names & value.keys()}
    return Manifest(**known | {"config": config, upgrades.VERSION_FIELD: upgrades.VERSION})


def _has_own_kinds(value: Mapping[str, Any]) -> bool:
    """Whether a manifest's fields are of the kinds that `Manifest` has."""
    return (
        has_mappings(value, "config", "parents", "metrics", "versions")
        and _is_machine(value.get("machine", {}))
        and value["origin"] in _ORIGINS
        and type(value["seed"]) is int
        and is_number(value["seconds"])
    )


def _is_machine(value: Any) -> bool:
    """Whether that is what `machine.describe` gives, or nothing."""
    if value == {}:
        return True
    if not isinstance(value, dict):
        return False
    accelerators = value.get("accelerators")
    listed = isinstance(accelerators, list) and all(isinstance(name, str) for name in accelerators)
    return listed and isinstance(value.get("processor"), str) and is_number(value.get("cores"))


def has_mappings(value: Any, *names: str) -> bool:
    """Whether `value`, as it was read from a file, is a mapping with mappings under these `names`."""
    return isinstance(value, dict) and all(isinstance(value.get(name), dict) for name in names)


def config_of(value: Mapping[str, Any], path: Path) -> dict[str, Any] | None:
    """The configuration in what was read from `path`, a manifest or an attempt's note, with the fields that
    this code has; None if it is damaged. UserError if a later version wrote it."""
    version = value.get(upgrades.VERSION_FIELD, 1)
    if not isinstance(version, int):
        return None
    if version > upgrades.VERSION:
        raise UserError(
            f"{path} is of version {version}, this code reads up to {upgrades.VERSION}: use the release that "
            "made it, or make it again."
        )
    try:
        config = upgrades.upgraded(value["config"], version)
    except (AttributeError, TypeError):  # of what is no section, or no number
        return None
    return config if has_sections(config, Config) else None


def _damaged(path: Path) -> UserError:
    return UserError(
        f"{path} is no manifest of this project: move it elsewhere if it is another program's; if "
        f"{path.parent} is a stage of a run, delete that and run the stage again."
    )


def read_artifact(directory: Path | str) -> Artifact:
    """The finished stage in `directory`, whatever its configuration (see `read_manifest` for errors)."""
    manifest = read_manifest(directory)
    digest = hashlib.sha256((Path(directory) / MANIFEST).read_bytes()).hexdigest()[:16]
    return Artifact(Path(directory), manifest, digest)


def is_finished(directory: Path | str) -> bool:
    """Whether the stage in `directory` ran to its end."""
    return (Path(directory) / MANIFEST).exists()


def finish(
    directory: Path | str,
    stage: str,
    config: Config,
    *,
    seconds: float,
    metrics: Mapping[str, Any],
    parents: Iterable[Artifact] = (),
    origin: str = "trained",
) -> Artifact:
    """Writes the manifest of a stage that has just ended.

    Args:
      seconds: wall time; `progress.seconds` counts interrupted attempts too.
      metrics: what was measured; a success rate as {"successes": k, "n": n}.
      parents: the artifacts this one was made from.
      origin: "trained", or "loaded" if its main content came from a checkpoint of another run.
    """
    return write_manifest(
        directory,
        Manifest(
            stage=stage,
            config=to_json(config),
            config_hash=config_hash(config, stage),
            contract_version=contract.CONTRACT_VERSION,
            versions=library_versions(),
            seed=config.seed,
            parents={parent.manifest.stage: parent.hash for parent in parents},
            seconds=round(float(seconds), 3),
            origin=origin,
            metrics=to_json(metrics),
            created=time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
            machine=machine.describe(),
        ),
    )


def check_stage(option: str, directory: Path, stage: str) -> None:
    """UserError if the finished stage in `directory`, which `option` names, is another than `stage`."""
    if (there := read_manifest(directory).stage) != stage:
        raise UserError(
            f"{option} is {directory}, which is of stage {there!r}: give a run that has made {stage}, or its "
            "folder."
        )


def require(run_dir: Path | str, stage: str, config: Config) -> Artifact:
    """The finished `stage` of the run in `run_dir`, made with this configuration; UserError otherwise."""
    directory = Path(run_dir) / stage
    if not is_finished(directory):
        raise UserError(
            f"{run_dir} has no finished stage {stage!r}: make it first, `ddgrasp {MADE_BY.get(stage, 'run')} "
            f"--out {run_dir}`."
        )
    artifact = read_artifact(directory)
    check_config(artifact, config)
    return artifact


def check_config(artifact: Artifact, config: Config) -> None:
    """UserError that names both values if `artifact` was made with another configuration than `config`."""
    check_same(artifact.directory, artifact.manifest.stage, artifact.manifest.config, config)


def config_from_json(value: Mapping[str, Any]) -> Config:
    """The Config whose `to_json` is `value`: what a manifest's `config` holds.

    Raises UserError if it has fields that this code does not know or lacks fields without default.
    """
    return _dataclass_from_json(Config, value, "config")


def _dataclass_from_json(cls: type, value: Mapping[str, Any], name: str) -> Any:
    types = typing.get_type_hints(cls)
    fields = {field.name: field for field in dataclasses.fields(cls)}
    if unknown := sorted(value.keys() - fields.keys()):
        raise UserError(
            f"{name} has no field {unknown[0]!r}: it was made by another version of this project."
        )
    missing = [
        field.name
        for field in fields.values()
        if field.name not in value and field.default is field.default_factory is dataclasses.MISSING
    ]
    if missing:
        raise UserError(f"{name} lacks {missing[0]!r}, which has no default: it is damaged.")
    arguments = {
        key: _dataclass_from_json(types[key], item, f"{name}.{key}")
        if dataclasses.is_dataclass(types[key])
        else to_tuples(item)
        for key, item in value.items()
    }
    return cls(**arguments)
