"""What a stage depends on of a configuration: its hash, and what differs between two."""

import copy
import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from ddgrasp import upgrades
from ddgrasp.config import Config
from ddgrasp.errors import UserError
from ddgrasp.files import to_json
from ddgrasp.stages import INDIFFERENT, config_fields, get_stage


def config_hash(config: Config, stage: str) -> str:
    """Hash over the parts of the configuration that `stage` depends on, and nothing else."""
    return _hash(_relevant(to_json(config), stage))


def config_hashes(config: Config, stage: str) -> list[str]:
    """`config_hash`, and those that earlier versions gave to the same configuration, which lacked fields."""
    made = to_json(config)
    earlier = (upgrades.without(made, version) for version in range(upgrades.VERSION, 1, -1))
    return list(dict.fromkeys(_hash(_relevant(there, stage)) for there in earlier if there is not None))


def check_same(
    directory: Path, stage: str, made_with: Mapping[str, Any], config: Config, how: str = "made"
) -> None:
    """UserError that names a field and both values if `stage` in `directory` was `how` ("made", "begun") with
    another configuration than `config`, as far as it depends on it."""
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


def differences(there: Any, here: Any, name: str = "") -> Iterator[str]:
    """'student.encoder.width is 16 there, 32 here' for every differing leaf."""
    if isinstance(there, Mapping) and isinstance(here, Mapping):
        for key in sorted({*there, *here}):
            yield from differences(there.get(key), here.get(key), f"{name}.{key}" if name else key)
    elif there != here:
        yield f"{name} is {there!r} there, {here!r} here"


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
