"""What a stage leaves on disk: a directory with a manifest, written so that nothing half-done is ever read.

A stage's directory is finished once it holds `manifest.json`, which is written last (how: ddgrasp/files.py).
This module imports no JAX.
"""

import copy
import dataclasses
import hashlib
import json
import shutil
import time
import typing
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from ddgrasp import contract, machine, upgrades
from ddgrasp.config import Config
from ddgrasp.config.checks import has_sections
from ddgrasp.errors import UserError
from ddgrasp.files import TEMPORARY, atomic_write_json, read_json, to_json, to_tuples
from ddgrasp.stages import INDIFFERENT, config_fields, get_stage
from ddgrasp.versions import library_versions

MANIFEST = "manifest.json"
STARTED = "started.json"
START = "start"
"""Among a stage's inputs the checkpoint that it began with; notes of before 2026-11-29 do not have it."""

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
    if absent or not _has_mappings(value, "config", "parents", "metrics") or value["origin"] not in _ORIGINS:
        raise _damaged(path)
    if value["contract_version"] != contract.CONTRACT_VERSION:
        raise UserError(
            f"{path} was made with contract version {value['contract_version']}, this code has "
            f"{contract.CONTRACT_VERSION}: make it again, or use the release that made it."
        )
    known = {name: value[name] for name in names & value.keys()}
    return Manifest(**known | {"config": _config_of(value, path), upgrades.VERSION_FIELD: upgrades.VERSION})


def _has_mappings(value: Any, *names: str) -> bool:
    """Whether `value`, as it was read from a file, is a mapping with mappings under these `names`."""
    return isinstance(value, dict) and all(isinstance(value.get(name), dict) for name in names)


def _config_of(value: Mapping[str, Any], path: Path) -> dict[str, Any]:
    """The configuration in a manifest or started.json, with the fields that this code has."""
    version = value.get(upgrades.VERSION_FIELD, 1)
    if not isinstance(version, int):
        raise _damaged(path)
    if version > upgrades.VERSION:
        raise UserError(
            f"{path} is of version {version}, this code reads up to {upgrades.VERSION}: use the release that "
            "made it, or make it again."
        )
    try:
        config = upgrades.upgraded(value["config"], version)
    except (AttributeError, TypeError):  # of what is no section, or no number
        raise _damaged(path) from None
    if not has_sections(config, Config):
        raise _damaged(path)
    return config


def _damaged(path: Path) -> UserError:
    if path.name == STARTED:
        return UserError(f"{path} does not say how a stage was begun: delete {path.parent}, run it again.")
    return UserError(f"{path} is no manifest of this project: delete {path.parent} and run the stage again.")


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
        raise UserError(f"{run_dir} has no finished stage {stage!r}: run it first, into the same directory.")
    artifact = read_artifact(directory)
    check_config(artifact, config)
    return artifact


def config_hash(config: Config, stage: str) -> str:
    """Hash over the parts of the configuration that `stage` depends on, and nothing else."""
    return _hash(_relevant(to_json(config), stage))


def check_config(artifact: Artifact, config: Config) -> None:
    """UserError that names both values if `artifact` was made with another configuration than `config`."""
    _check_same_config(artifact.directory, artifact.manifest.stage, artifact.manifest.config, config)


def has_work(directory: Path | str) -> bool:
    """Whether an attempt left a file in `directory` or below it, besides the notes about itself."""
    directory = Path(directory)
    files = (path.relative_to(directory) for path in directory.rglob("*") if not path.is_dir())
    return any(path != Path(STARTED) and not any(p.startswith(".") for p in path.parts) for path in files)


def begin(
    directory: Path | str,
    stage: str,
    config: Config,
    inputs: Mapping[str, str] | None = None,
    *,
    write: bool = True,
) -> None:
    """Marks `directory` as the place where `stage` is being made with this configuration and these inputs.

    UserError if an unfinished attempt there used others, or another contract version: its checkpoints would
    not fit. Without `write` it only looks: another process marks the place.
    """
    inputs = dict(inputs or {})
    if write:
        for litter in Path(directory).glob(f"{TEMPORARY}*"):  # of an attempt that was killed mid-write
            if litter.is_dir() and not litter.is_symlink():
                shutil.rmtree(litter)
            else:
                litter.unlink(missing_ok=True)
    if (started := _check_begun(Path(directory), stage, config)) is not None:
        earlier = {START: inputs[START]} if START in inputs else {}
        _check_same_inputs(directory, earlier | started["inputs"], inputs, "begun")
    elif write:
        value = {
            upgrades.VERSION_FIELD: upgrades.VERSION,
            "contract_version": contract.CONTRACT_VERSION,
            "inputs": inputs,
            "config": config,
        }
        atomic_write_json(Path(directory) / STARTED, value)


def check_place(directory: Path | str, stage: str, config: Config) -> None:
    """UserError if `stage` is finished or begun in `directory` with another configuration than `config`, or
    another contract version. Writes nothing."""
    if is_finished(directory):
        check_config(read_artifact(directory), config)
    else:
        _check_begun(Path(directory), stage, config)


def _check_begun(directory: Path, stage: str, config: Config) -> Mapping[str, Any] | None:
    """What an unfinished attempt noted as it began, None without one; UserError if it used another
    configuration or contract version."""
    path = directory / STARTED
    if not (path.exists() and has_work(directory)):
        return None
    started = _read_started(path)
    if started.get("contract_version") != contract.CONTRACT_VERSION:
        raise UserError(
            f"{directory} was begun with contract version {started.get('contract_version')}, this code "
            f"has {contract.CONTRACT_VERSION}: delete the directory, or choose another --out."
        )
    _check_same_config(directory, stage, _config_of(started, path), config, "begun")
    return started


def _read_started(path: Path) -> dict[str, Any]:
    """What started.json holds; UserError if it is damaged or no such note."""
    started = read_json(path)
    if not _has_mappings(started, "config", "inputs"):
        raise _damaged(path)
    return started


def check_inputs(directory: Path | str, inputs: Mapping[str, str]) -> None:
    """UserError if the finished stage in `directory` noted other `inputs` than these; a path that is there no
    more is let pass, since what is finished does not need it."""
    path = Path(directory) / STARTED
    noted = _read_started(path)["inputs"] if path.exists() else {}
    if noted and inputs and not noted.keys() & inputs.keys():  # made of a stage of the run, say
        _check_same_inputs(directory, noted, inputs, "made")
    there = {
        name: value
        for name, value in noted.items()
        if name in inputs and not (Path(value).is_absolute() and not Path(value).exists())
    }
    _check_same_inputs(directory, there, {name: inputs[name] for name in there}, "made")


def check_start(directory: Path | str, start: Mapping[str, str]) -> None:
    """UserError if the finished stage in `directory` noted another `START` than `start`, if that has one."""
    path = Path(directory) / STARTED
    noted = _read_started(path)["inputs"] if path.exists() else {}
    if START in noted and START in start:
        _check_same_inputs(directory, {START: noted[START]}, {START: start[START]}, "made")


def _check_same_inputs(
    directory: Path | str, there: Mapping[str, str], here: Mapping[str, str], how: str
) -> None:
    if difference := next(differences(there, here), None):
        raise UserError(
            f"{directory} was {how} with other inputs: {difference}. Use those, another --out, or delete the "
            "directory."
        )


def _check_same_config(
    directory: Path, stage: str, made_with: Mapping[str, Any], config: Config, how: str = "made"
) -> None:
    there, here = _relevant(made_with, stage), _relevant(to_json(config), stage)
    if there == here:
        return
    before, expected = _hash(there), _hash(here)
    difference = next(differences(there, here), "a field that no longer exists")
    raise UserError(
        f"{directory} was {how} with another configuration (hash {before}, "
        f"this run has {expected}): {difference}. "
        "Use that configuration, another --out, or delete the directory."
    )


def config_from_json(value: Mapping[str, Any]) -> Config:
    """The Config whose `to_json` is `value`: what a manifest's `config` holds.

    Raises UserError if it has fields that this code does not know or lacks fields without default.
    """
    return _dataclass_from_json(Config, value, "config")


def _dataclass_from_json(cls: type, value: Mapping[str, Any], name: str) -> Any:
    types = typing.get_type_hints(cls)
    fields = {field.name for field in dataclasses.fields(cls)}
    if unknown := sorted(value.keys() - fields):
        raise UserError(
            f"{name} has no field {unknown[0]!r}: it was made by another version of this project."
        )
    arguments = {
        key: _dataclass_from_json(types[key], item, f"{name}.{key}")
        if dataclasses.is_dataclass(types[key])
        else to_tuples(item)
        for key, item in value.items()
    }
    return cls(**arguments)


def _relevant(config: Mapping[str, Any], stage: str) -> dict[str, Any]:
    compared = copy.deepcopy(dict(config))
    for name, value in INDIFFERENT.items():
        *sections, field = name.split(".")
        if isinstance(section := _at(compared, sections), dict):
            section[field] = value
    return {name: _at(compared, name.split(".")) for name in config_fields(get_stage(stage))}


def _at(config: Any, path: Sequence[str]) -> Any:
    """What lies there, None where nothing does."""
    for name in path:
        config = config.get(name) if isinstance(config, Mapping) else None
    return config


def _hash(value: Any) -> str:
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()[:16]


def differences(there: Any, here: Any, name: str = "") -> Iterator[str]:
    """'student.encoder.width is 16 there, 32 here' for every differing leaf."""
    if isinstance(there, Mapping) and isinstance(here, Mapping):
        for key in sorted({*there, *here}):
            yield from differences(there.get(key), here.get(key), f"{name}.{key}" if name else key)
    elif there != here:
        yield f"{name} is {there!r} there, {here!r} here"
