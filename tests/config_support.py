"""Configurations that no command accepts, for tests of what happens when numbers go wrong all the same."""

import copy
from typing import TypeVar

T = TypeVar("T")


def unchecked(config: T, **values) -> T:
    """A copy of a configuration dataclass with `values`, past its own checks."""
    made = copy.copy(config)
    for name, value in values.items():
        object.__setattr__(made, name, value)
    return made
