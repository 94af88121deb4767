"""A run's configuration as a YAML file.

`ddgrasp run` leaves one with every setting, `config.yaml`, in the run's folder: presets change from release
to release, and a run is to be had again. `--config FILE` takes it, or one written by hand of a preset's name
and what differs from it.
"""

import json
import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from ddgrasp import upgrades
from ddgrasp.artifacts import config_from_json, to_json
from ddgrasp.config import Config
from ddgrasp.errors import UserError, unknown_name
from ddgrasp.files import atomic_write_text
from ddgrasp.presets import PRESETS, get_preset
from ddgrasp.scaling import scaled

CONFIG_FILE = "config.yaml"
_FIRST_LINE = "ddgrasp run --config"
"""What those that `write` makes begin with, as a comment."""
_PRESET = "preset"
_MERGE = "tag:yaml.org,2002:merge"
"""YAML's `<<`."""


def write(config: Config, path: Path) -> None:
    """Writes what `read` makes `config` of, by this release and later ones; atomically.

    What differs from the preset as it is now stands above, as comments.
    """
    import yaml

    preset = PRESETS.get(config.preset, Config(config.preset))
    if config.scale != 1:
        preset = replace(scaled(preset, config.scale), scale=1.0)
    different = _differences(to_json(preset), to_json(config), "")
    head = [
        f"{_FIRST_LINE} {path.name}",
        f"Preset {config.preset} but for:" if different else f"Preset {config.preset} as it is.",
        *(f"  {name}: {json.dumps(value)}" for name, value in different.items()),
    ]
    values = {_PRESET: config.preset, upgrades.VERSION_FIELD: upgrades.VERSION, **to_json(config)}
    text = yaml.dump(values, Dumper=_dumper(), sort_keys=False, allow_unicode=True, width=110)
    atomic_write_text(path, "".join(f"# {line}\n" for line in head) + text)


def is_of_a_person(path: Path) -> bool:
    """Whether somebody wrote the file by hand: `write` would take their comments away."""
    try:
        return not path.read_bytes().startswith(f"# {_FIRST_LINE}".encode())
    except OSError:
        return False


def read(path: Path) -> Config:
    """The configuration of the file.

    Settings that it lacks are those of the preset that it names.

    Raises UserError if there is no such file, it is no YAML, names no preset, is of a later release, or has a
    setting that does not exist or a value that is out of bounds.
    """
    import yaml

    try:
        values = yaml.load(path.read_text(encoding="utf-8"), _loader())  # noqa: S506 - a safe loader
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "no text"
        raise UserError(f"--config {path} cannot be read ({reason}).") from None
    except (yaml.YAMLError, ValueError, RecursionError) as error:  # ValueError: seed: 2026-13-45
        raise UserError(f"--config {path} is no YAML: {' '.join(str(error).split())}.") from None
    if not isinstance(values, dict) or not isinstance(values.get(_PRESET), str):
        raise UserError(f"--config {path} names no preset: its first line is to be `preset: demo`.")
    try:
        preset = _preset(values)
        if (scale := values.get("scale", 1.0)) != 1:
            preset = scaled(replace(preset, scale=scale), scale)
        merged = _merged(to_json(preset), _of_this_release(values), "")
        return config_from_json(merged)
    except UserError as error:
        raise UserError(f"--config {path}: {error}") from None


def _preset(values: Mapping[str, Any]) -> Config:
    """The preset that is named; one that is gone does not matter to a file that has every setting."""
    name = values[_PRESET]
    if upgrades.VERSION_FIELD in values and name not in PRESETS:
        return Config(name)
    return get_preset(name)


def _of_this_release(values: Mapping[str, Any]) -> dict[str, Any]:
    """The settings with the names that they have now; a file written by hand, without a version, has them."""
    version = values.get(upgrades.VERSION_FIELD, upgrades.VERSION)
    if type(version) is not int or not 1 <= version <= upgrades.VERSION:
        raise UserError(
            f"{upgrades.VERSION_FIELD} is {version!r}; this release reads 1 to {upgrades.VERSION}: use the "
            "one that wrote the file, or take the line out."
        )
    given = {name: value for name, value in values.items() if name != upgrades.VERSION_FIELD}
    if version == upgrades.VERSION:
        return given
    try:
        return upgrades.upgraded(given, version)
    except (AttributeError, TypeError):  # of what is no section: `_merged` names it
        return given


_NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)[eE][-+]?\d+$")
"""3e-4, which YAML 1.1 takes for a text."""


def _reads_numbers(yaml_class: Any) -> None:
    yaml_class.add_implicit_resolver("tag:yaml.org,2002:float", _NUMBER, list("-+.0123456789"))


def _dumper() -> Any:
    """YAML's safe dumper; lists are one line, and a text that `_loader` would read as a number is quoted."""
    import yaml

    class Dumper(yaml.SafeDumper):
        pass

    tag = "tag:yaml.org,2002:seq"
    Dumper.add_representer(list, lambda made, values: made.represent_sequence(tag, values, flow_style=True))
    _reads_numbers(Dumper)
    return Dumper


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

    _reads_numbers(Loader)
    return Loader


def _differences(preset: Mapping[str, Any], here: Mapping[str, Any], section: str) -> dict[str, Any]:
    """The values of `here` that are not those of `preset`, by their dotted names."""
    different: dict[str, Any] = {}
    for name, value in here.items():
        if isinstance(value, Mapping) and isinstance(preset[name], Mapping):
            different |= _differences(preset[name], value, f"{section}{name}.")
        elif value != preset[name]:
            different[f"{section}{name}"] = value
    return different


def _merged(preset: Mapping[str, Any], given: Mapping[str, Any], section: str) -> dict[str, Any]:
    merged = dict(preset)
    for name, value in given.items():
        place = f"{section}{name}"
        if name not in preset and isinstance(name, str) and "." in name:
            *above, last = name.split(".")
            below = " below ".join(f"{part}:" for part in reversed(above))
            raise UserError(f"{place} stands in one line: write {last}: indented below {below}")
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
