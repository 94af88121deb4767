"""Configurations of this version as earlier ones wrote them."""

import copy
from collections.abc import Mapping
from typing import Any

from ddgrasp import artifacts, upgrades
from ddgrasp.config import Config
from ddgrasp.files import to_json


def config_hash_of_version(version: int, config: Config, stage: str) -> str:
    """`artifacts.config_hash` as an earlier version of the fields had it."""
    return artifacts._hash(artifacts._relevant(downgraded(to_json(config), version), stage))


def _flatten(made: dict[str, Any]) -> None:
    """Fields of version 2 as version 1 had them."""
    for name, value in upgrades._DROPPED_AFTER_1.items():
        section, field = upgrades._section_of(made, name)
        section[field] = value
    upgrades._drop(made, upgrades._ADDED_AFTER_1)
    for section, groups in upgrades._GROUPS_OF_2.items():
        taken = {group: made[section].pop(group) for group in groups}
        for group, fields in groups.items():
            made[section] |= {old: taken[group][new] for new, old in fields.items()}


def downgraded(config: Mapping[str, Any], version: int) -> dict[str, Any]:
    """The JSON of a configuration of this version with the fields of an earlier one: what its hashes were
    over. Values of fields that it lacked are lost."""
    made = copy.deepcopy(dict(config))
    if version < 10:
        upgrades._drop(made, upgrades._ADDED_AFTER_9)
    if version < 9:
        upgrades._drop(made, upgrades._ADDED_AFTER_8)
    if version < 8:
        upgrades._drop(made, upgrades._ADDED_AFTER_7)
    if version < 7:
        upgrades._drop(made, upgrades._ADDED_AFTER_6)
    if version < 6:
        upgrades._drop(made, upgrades._ADDED_AFTER_5)
    if version < 5:
        upgrades._drop(made, upgrades._ADDED_AFTER_4)
    if version < 4:
        upgrades._drop(made, upgrades._ADDED_AFTER_3)
    if version < 3:
        upgrades._drop(made, upgrades._ADDED_AFTER_2)
        teacher = made["teacher"]
        start = teacher.pop("start")
        teacher["init_from"] = "" if start in ("nothing", "guide") else start
        if start == "nothing":
            teacher["clone_rounds"] = 0
    if version < 2:
        _flatten(made)
    return made
