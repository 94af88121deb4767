"""How a configuration checks itself: bounds as part of a field's type, choices as Literal types.

A section's fields say what they may hold: `clean_share: Share = 0.2`, `sampler: Sampler = "ddim"`. `Section`
reads those types when a value is made, so no field goes unchecked, from Python and the command line alike.
"""

import dataclasses
import math
import types
import typing
from dataclasses import dataclass
from functools import cache
from numbers import Integral, Real
from types import NoneType
from typing import Annotated, Any, ClassVar, Literal

from ddgrasp.errors import UserError, unknown_name

_ONE_SIDED_FROM = 1000
"""An upper bound from here on only catches typing errors: it is named when it is exceeded, not before."""


@dataclass(frozen=True)
class Range:
    """Finite numbers from `least` to `most`."""

    least: float
    most: float
    above: bool = False
    """The least number itself is excluded."""
    multiple: int = 1
    """Whole numbers must be multiples of this."""

    def trouble(self, value: float) -> str:
        """What was expected instead of `value`, in words; empty if the value is fine."""
        if not isinstance(value, Integral) and not math.isfinite(value):  # a whole one may be beyond floats
            return "a finite number, " + self._both()
        if value < self.least or (self.above and value == self.least):
            return self._both() if self.most < _ONE_SIDED_FROM else self._lower()
        if value > self.most:
            return self._both() if self.most < _ONE_SIDED_FROM else f"at most {_plain(self.most)}"
        if self.multiple > 1 and value % self.multiple:
            return f"a multiple of {self.multiple}"
        return ""

    def _lower(self) -> str:
        return ("above " if self.above else "at least ") + _plain(self.least)

    def _both(self) -> str:
        if self.above:
            return f"above {_plain(self.least)}, up to {_plain(self.most)}"
        return f"{_plain(self.least)} to {_plain(self.most)}"


@dataclass(frozen=True)
class FreeText:
    """Any text: names, paths, addresses, which only the place where they are used can check."""


Text = Annotated[str, FreeText()]
Count = Annotated[int, Range(1, 1_000_000)]
"""How many there are."""
CountOrNone = Annotated[int, Range(0, 1_000_000)]
"""How many there are; 0 has a meaning of its own."""
Steps = Annotated[int, Range(1, 100_000_000)]
"""Repetitions of something quick."""
StepsOrNone = Annotated[int, Range(0, 100_000_000)]
"""The same; 0 leaves it out or has a meaning of its own."""
Batch = Annotated[int, Range(1, 65_536)]
"""Samples handled together."""
Width = Annotated[int, Range(1, 16_384)]
"""Channels or features of a layer."""
Pixels = Annotated[int, Range(1, 4096)]
"""Side of a picture."""
Share = Annotated[float, Range(0, 1)]
"""A share or a probability."""
Decay = Annotated[float, Range(0, 0.999999)]
"""Decay of a running average: 0 keeps the newest value alone."""
LearningRate = Annotated[float, Range(0, 1, above=True)]
"""An optimiser's step size."""
WeightDecay = Annotated[float, Range(0, 1)]
Weight = Annotated[float, Range(0, 1_000_000)]
"""Weight of a term in a sum."""
Seed = Annotated[int, Range(0, 2**31 - 1)]
"""Seed of random numbers."""


class Section:
    """A part of the configuration, a frozen dataclass, that checks its values when it is made.

    `class PictureConfig(Section, name="student.picture")`: the name is how errors and options call it.
    """

    section: ClassVar[str] = ""

    def __init_subclass__(cls, name: str = "") -> None:
        cls.section = name

    def __post_init__(self) -> None:
        for field, kind in kinds(type(self)).items():
            value = getattr(self, field)
            check_value(self.field_name(field), value, kind)
            object.__setattr__(self, field, _as_stated(value, kind))
        self.check()

    def check(self) -> None:
        """Raises UserError for values that do not fit each other; every one fits by itself."""

    def field_name(self, field: str) -> str:
        """`field` as errors and options call it, for example student.picture.height_px."""
        return f"{self.section}.{field}" if self.section else field

    def error(self, field: str, expected: str) -> UserError:
        """UserError about a field's value; `expected` says what it should be and why."""
        return UserError(f"{self.field_name(field)} is {getattr(self, field)!r}; expected {expected}.")


@cache
def kinds(section: type) -> dict[str, Any]:
    """Name -> type of a dataclass's fields, bounds included."""
    hints = typing.get_type_hints(section, include_extras=True)
    return {field.name: hints[field.name] for field in dataclasses.fields(section)}


def has_sections(value: Any, section: type) -> bool:
    """Whether `value`, as JSON has it, is a mapping, and so is every section of `section` that is there."""
    return isinstance(value, dict) and all(
        has_sections(value[name], typing.cast(type, kind))
        for name, kind in kinds(section).items()
        if name in value and dataclasses.is_dataclass(kind)
    )


def stated(kind: Any) -> Any:
    """What `kind` says of a value that is there: X of `X | None`, in both forms that Python has of it."""
    if typing.get_origin(kind) not in (typing.Union, types.UnionType):
        return kind
    return next(one for one in typing.get_args(kind) if one is not NoneType)


def check_value(name: str, value: Any, kind: Any) -> None:
    """UserError unless `value` is what the type `kind` of the field `name` allows."""
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if origin is Annotated:
        _check_annotated(name, value, *arguments)
    elif origin is Literal:
        _check_choice(name, value, arguments)
    elif origin is tuple:
        _check_tuple(name, value, arguments)
    elif kind is bool:
        if not isinstance(value, bool):
            raise UserError(f"{name} is {value!r}; expected True or False.")
    elif not dataclasses.is_dataclass(kind):
        raise TypeError(f"{name} has type {kind}, which states no bounds: see ddgrasp/config/checks.py")
    elif not isinstance(value, typing.cast(type, kind)):
        raise UserError(f"{name} is {value!r}; expected a {getattr(kind, '__name__', kind)}.")


def _as_stated(value: Any, kind: Any) -> Any:
    """A checked `value`, whole numbers as floats where the field holds floats: 3 and 3.0 are one setting, and
    have to have one hash."""
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if origin is Annotated and arguments[0] is float and isinstance(value, Integral):
        return float(value)
    if origin is tuple:
        of_items = arguments[:1] * len(value) if arguments[-1] is Ellipsis else arguments
        return tuple(_as_stated(item, of_item) for item, of_item in zip(value, of_items, strict=True))
    return value


def _check_annotated(name: str, value: Any, kind: type, *extras: Any) -> None:
    if kind is str:
        if not isinstance(value, str):
            raise UserError(f"{name} is {value!r}; expected text.")
        return
    _check_number(name, value, kind)
    for extra in extras:
        if isinstance(extra, Range) and (expected := extra.trouble(value)):
            raise UserError(f"{name} is {value!r}; expected {expected}.")


def _check_number(name: str, value: Any, kind: type) -> None:
    wanted, words = (Integral, "a whole number") if kind is int else (Real, "a number")
    if isinstance(value, (bool, NoneType)) or not isinstance(value, wanted):
        raise UserError(f"{name} is {value!r}; expected {words}.")


def _check_choice(name: str, value: Any, choices: tuple[Any, ...]) -> None:
    if any(value == choice and _is_of_kind(value, choice) for choice in choices):
        return
    if isinstance(value, str):
        raise unknown_name(name, value, [str(choice) for choice in choices])
    raise UserError(f"{name} is {value!r}; expected one of {', '.join(map(str, choices))}.")


def _is_of_kind(value: Any, choice: Any) -> bool:
    """Whether they are of one type, which 8.0 and 8, or True and 1, are not; integers may be NumPy's."""
    whole = isinstance(choice, int) and not isinstance(choice, bool)
    return isinstance(value, Integral if whole else type(choice)) and not (whole and isinstance(value, bool))


def _check_tuple(name: str, value: Any, kinds_of_items: tuple[Any, ...]) -> None:
    if not isinstance(value, tuple):
        raise UserError(f"{name} is {value!r}; expected a tuple.")
    if kinds_of_items[-1] is Ellipsis:
        if not value:
            raise UserError(f"{name} is empty; expected at least one{_of(kinds_of_items[0])}.")
        kinds_of_items = (kinds_of_items[0],) * len(value)
    if len(value) != len(kinds_of_items):
        raise UserError(f"{name} is {value!r}; expected {len(kinds_of_items)} values.")
    for item, kind in zip(value, kinds_of_items, strict=True):
        check_value(name, item, kind)


def _of(kind: Any) -> str:
    return f" of {', '.join(typing.get_args(kind))}" if typing.get_origin(kind) is Literal else ""


def _plain(number: float) -> str:
    return f"{number:g}" if abs(number) < 1e6 or number != int(number) else str(int(number))
