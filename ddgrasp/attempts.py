"""A stage that is being made: what an attempt notes as it begins, so that the next one goes on from its work
only with the same configuration and inputs. This module imports no JAX."""

import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ddgrasp import artifacts, contract, upgrades
from ddgrasp.config import Config
from ddgrasp.config_hash import check_same, differences
from ddgrasp.errors import UserError
from ddgrasp.files import TEMPORARY, atomic_write_json, read_json

STARTED = "started.json"
START = "start"
"""Among a stage's inputs the checkpoint that it began with; notes of before 2026-11-29 do not have it."""


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
    clean: bool = True,
) -> None:
    """Marks `directory` as the place where `stage` is being made with this configuration and these inputs.

    UserError if an unfinished attempt there used others, or another contract version: its checkpoints would
    not fit. Without `write` it only looks: another process marks the place. Without `clean` half-written
    files stay, those of killed attempts too: another process may be writing them.
    """
    inputs = dict(inputs or {})
    if write and clean:
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
    if artifacts.is_finished(directory):
        artifacts.check_config(artifacts.read_artifact(directory), config)
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
    if (begun_with := artifacts.config_of(started, path)) is None:
        raise _damaged(path)
    check_same(directory, stage, begun_with, config, "begun")
    return started


def _read_started(path: Path) -> dict[str, Any]:
    """What started.json holds; UserError if it is damaged or no such note."""
    started = read_json(path)
    if not artifacts.has_mappings(started, "config", "inputs"):
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


def _damaged(path: Path) -> UserError:
    return UserError(f"{path} does not say how a stage was begun: delete {path.parent}, run it again.")
