"""What every description of an object must keep to, a primitive's and a mesh's. JAX-free."""

import math
import re
from collections.abc import Iterable
from typing import Any, Protocol, TypeVar, runtime_checkable

from ddgrasp.errors import UserError

MOST_KG = 3.0
"""Payload of a Panda and of an FR3, by their datasheets."""
_NAME = re.compile(r"[A-Za-z0-9][\w.-]*", re.ASCII)


@runtime_checkable
class Named(Protocol):
    """What has a name."""

    @property
    def name(self) -> str:
        """The name."""
        ...


Thing = TypeVar("Thing", bound=Named)


def named(specs: Iterable[Thing]) -> dict[str, Thing]:
    """Name -> spec, each of which has a `name`. Raises UserError for a name that two have."""
    table: dict[str, Thing] = {}
    for spec in specs:
        if table.setdefault(spec.name, spec) is not spec:
            raise UserError(f"Two objects are called {spec.name!r}: give one of them another name.")
    return table


def check_thing(name: str, mass_kg: float, friction: float, symmetry: int) -> None:
    """UserError for what no object has: a name that is no file's, no mass or friction, more mass than an arm
    lifts, a `symmetry` of grasps that no parallel hand has."""
    if not _NAME.fullmatch(name):
        raise UserError(
            f"An object is called {name!r}, and files after it; expected letters of ASCII, digits, '_', "
            "'-' and '.'."
        )
    if not 0.0 < mass_kg <= MOST_KG:
        raise UserError(
            f"{name}: mass_kg is {mass_kg:g}; expected more than 0, at most {MOST_KG:g}, which an arm lifts."
        )
    if not 0.0 < friction < math.inf:
        raise UserError(f"{name}: friction is {friction:g}; expected a number above 0.")
    check_symmetry(name, symmetry)


def check_rgb(name: str, rgb: Any) -> None:
    """UserError for a colour that is not three numbers of 0 to 1."""
    try:
        red, green, blue = (float(value) for value in rgb)
    except (TypeError, ValueError):
        red = green = blue = math.nan
    if not all(0.0 <= value <= 1.0 for value in (red, green, blue)):
        raise UserError(f"{name}: rgb is {rgb!r}; expected three numbers of 0 to 1.")


def check_symmetry(name: str, symmetry: int) -> None:
    """UserError for a `grasp_symmetry` that no parallel hand has."""
    if symmetry < 0 or symmetry % 2:
        raise UserError(
            f"{name}: grasp_symmetry is {symmetry}; expected 0 or an even number: the hand turned by half a "
            "turn grasps the same way, so that an object without symmetry has 2."
        )
