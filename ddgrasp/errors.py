"""Errors a person can act on."""

import difflib
from collections.abc import Iterable, Mapping
from typing import TypeVar

T = TypeVar("T")


class UserError(Exception):
    """Wrong input: one line that names the value, what was expected and the remedy.

    The command line prints the message alone, without a traceback, and exits with 2.
    """


class Trouble(UserError):
    """What went wrong with right input, as a device that failed: the command line exits with 1."""


def unknown_name(kind: str, name: str, known: Iterable[str]) -> UserError:
    """Error for a name that is not in `known`; suggests the nearest right one."""
    known = sorted(known)
    near = difflib.get_close_matches(name, known, n=1)
    hint = f" Did you mean {near[0]!r}?" if near else ""
    return UserError(f"Unknown {kind} {name!r}.{hint} Known: {', '.join(known)}.")


def looked_up(kind: str, name: str, table: Mapping[str, T]) -> T:
    """What `table` has for `name`; UserError with the nearest right name if it has nothing."""
    if name not in table:
        raise unknown_name(kind, name, table)
    return table[name]
