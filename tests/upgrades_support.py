"""Configurations of this version as earlier ones wrote them."""

import copy
from collections.abc import Mapping, Sequence
from typing import Any

from ddgrasp import config_hash, upgrades
from ddgrasp.config import Config
from ddgrasp.files import to_json


def config_hash_of_version(version: int, config: Config, sections: Sequence[str]) -> str:
    """`config_hash` as an earlier version of the fields had it for a stage that read `sections`."""
    value = downgraded(to_json(config), version)
    return config_hash._hash({name: value[name] for name in sections})


def _flatten(made: dict[str, Any]) -> None:
    """Fields of version 2 as version 1 had them."""
    for name, value in upgrades._DROPPED_AFTER_1.items():
        section, field = upgrades._section_of(made, name)
        section[field] = value
    upgrades._drop(made, upgrades._ADDED_AFTER[1])
    for section, groups in upgrades._GROUPS_OF_2.items():
        taken = {group: made[section].pop(group) for group in groups}
        for group, fields in groups.items():
            made[section] |= {old: taken[group][new] for new, old in fields.items()}


def downgraded(config: Mapping[str, Any], version: int) -> dict[str, Any]:
    """The JSON of a configuration of this version with the fields of an earlier one: what its hashes were
    over. Values of fields that it lacked are lost."""
    made = copy.deepcopy(dict(config))
    for lacking in range(max(version, 2), upgrades.VERSION):
        upgrades._drop(made, upgrades._ADDED_AFTER[lacking])
    if version < 3:
        teacher = made["teacher"]
        start = teacher.pop("start")
        teacher["init_from"] = "" if start in ("nothing", "guide") else start
        if start == "nothing":
            teacher["clone_rounds"] = 0
    if version < 2:
        _flatten(made)
    return made
