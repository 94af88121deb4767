"""A run's configuration as a small YAML file: its preset, and what differs from it.

`ddgrasp run` leaves one, `config.yaml`, in the run's folder; `--config FILE` takes it.
"""

import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from ddgrasp.artifacts import config_from_json, to_json
from ddgrasp.config import Config
from ddgrasp.errors import UserError, unknown_name
from ddgrasp.files import atomic_write_text
from ddgrasp.presets import PRESETS, get_preset
from ddgrasp.scaling import scaled

CONFIG_FILE = "config.yaml"
_PRESET = "preset"
_MERGE = "tag:yaml.org,2002:merge"
"""YAML's `<<`."""


def write(config: Config, path: Path) -> None:
    """Writes what `read` makes `config` of."""
    import yaml

    preset = PRESETS.get(config.preset, Config(config.preset))
    if config.scale != 1:
        preset = replace(scaled(preset, config.scale), scale=1.0)
    values = {_PRESET: config.preset, **_differences(to_json(preset), to_json(config))}
    text = yaml.safe_dump(values, sort_keys=False, allow_unicode=True, width=110)
    atomic_write_text(path, f"# ddgrasp run --config {path.name}\n{text}")


def read(path: Path) -> Config:
    """The configuration of the file.

    Raises UserError if there is no such file, it is no YAML, names no preset, or has a setting that does not
    exist or a value that is out of bounds.
    """
    import yaml

    try:
        values = yaml.load(path.read_text(), _loader())  # noqa: S506 - a safe loader
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "no text"
        raise UserError(f"--config {path} cannot be read ({reason}).") from None
    except (yaml.YAMLError, ValueError) as error:  # ValueError: seed: 2026-13-45
        raise UserError(f"--config {path} is no YAML: {' '.join(str(error).split())}.") from None
    if not isinstance(values, dict) or not isinstance(values.get(_PRESET), str):
        raise UserError(f"--config {path} names no preset: its first line is to be `preset: demo`.")
    try:
        preset = get_preset(values[_PRESET])
        if (scale := values.get("scale", 1.0)) != 1:
            preset = scaled(replace(preset, scale=scale), scale)
        merged = _merged(to_json(preset), values, "")
        return config_from_json(merged)
    except UserError as error:
        raise UserError(f"--config {path}: {error}") from None


def _loader() -> Any:
    """YAML's safe loader, which reads 3e-4 as a number and refuses a section or setting given twice."""
    import yaml

    class Loader(yaml.SafeLoader):
        def construct_mapping(self, node, deep=False):
            names = [self.construct_object(key, deep=True) for key, _ in node.value if key.tag != _MERGE]
            if twice := [name for name in names if names.count(name) > 1]:
                why = f"{twice[0]} is given twice"
                raise yaml.constructor.ConstructorError(None, None, why, node.start_mark)
            return super().construct_mapping(node, deep)

    number = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)[eE][-+]?\d+$")
    Loader.add_implicit_resolver("tag:yaml.org,2002:float", number, list("-+.0123456789"))
    return Loader


def _differences(preset: Mapping[str, Any], here: Mapping[str, Any]) -> dict[str, Any]:
    different: dict[str, Any] = {}
    for name, value in here.items():
        if isinstance(value, Mapping) and isinstance(preset[name], Mapping):
            if inside := _differences(preset[name], value):
                different[name] = inside
        elif value != preset[name]:
            different[name] = value
    return different


def _merged(preset: Mapping[str, Any], given: Mapping[str, Any], section: str) -> dict[str, Any]:
    merged = dict(preset)
    for name, value in given.items():
        place = f"{section}{name}"
        if name not in preset:
            known = [f"{section}{other}" for other in preset]
            raise unknown_name("setting", place, known)
        if isinstance(preset[name], Mapping):
            if not isinstance(value, Mapping):
                raise UserError(f"{place} is {value!r}; expected its settings, indented below it.")
            merged[name] = _merged(preset[name], value, f"{place}.")
        else:
            merged[name] = value
    return merged
