"""Turns what tyro prints about a command line that it cannot read, a box of several lines, into one line."""

import contextlib
import io
import re
import sys
from collections.abc import Callable, Sequence
from dataclasses import fields
from typing import TypeVar

from ddgrasp.config import Config
from ddgrasp.errors import UserError, unknown_name
from ddgrasp.presets import PRESETS

T = TypeVar("T")

HELP_ALL = "--help-all"
"""Asks for the values of the run's configuration too, of which there are hundreds."""

_SECTION = re.compile(r"^(?:╭─ | )(?:(?P<name>\S+) )?options(?: ─+╮)?\s*$")
"""First line of a section of help, with a frame or, on a terminal without UTF-8, without one."""
_OF_A_RUN = {field.name for field in fields(Config)}
"""Sections that help shows with HELP_ALL alone."""
_COLOUR = re.compile(r"\x1b\[[0-9;]*m")
_RULE = re.compile(r"^[─-]{4,}$")
_CHOICE = re.compile(r"invalid choice '(?P<value>.*)' for argument '-*(?P<option>\S+)'\. Expected one of \(")
_NUMBER = re.compile(
    r"Error parsing (?P<option>\S+): ((?P<int>invalid literal for int\(\) with base 10)|"
    r"could not convert string to float): (?P<value>.*)"
)


def parsed(parse: Callable[[], T], command: str, whole: bool, unread: Sequence[str] = ()) -> T:
    """What `parse`, a call of tyro, returns; UserError in one line for options that it refuses.

    Help is printed, without the sections of the run's configuration unless the `whole` is asked for, and ends
    with SystemExit(0). It does not show the options `unread`.
    """
    told = io.StringIO()
    helped = io.TextIOWrapper(io.BytesIO(), sys.stdout.encoding, "backslashreplace", newline="")
    try:
        with contextlib.redirect_stderr(told), contextlib.redirect_stdout(helped):
            return parse()
    except SystemExit as stop:
        if stop.code != 2:
            helped.seek(0)
            text = _without(unread, helped.read())
            sys.stdout.write(
                "\n".join([text.rstrip("\n"), *_presets(text), ""]) if whole else shortened(text, command)
            )
            sys.stderr.write(told.getvalue())
            raise
    raise refused(told.getvalue(), command)


def shortened(text: str, command: str) -> str:
    """Help `text` without the sections of the configuration; says which there are and how to see them."""
    kept, hidden, hiding = [], {}, False
    for line in text.splitlines():
        if (match := _SECTION.match(_COLOUR.sub("", line))) is not None:
            section = (match["name"] or "").split(".")[0]
            hiding = section in _OF_A_RUN
            hidden |= {section: None} if hiding else {}
        if not hiding:
            kept.append(line.rstrip())
    more = [f"Every value of the run ({', '.join(hidden)}): {command} {HELP_ALL}"] if hidden else []
    return "\n".join([*kept, *_presets(text), *more]) + "\n"


def _presets(text: str) -> list[str]:
    """The line that names the presets, for help `text` of a command that takes one."""
    return [f"Presets: {', '.join(PRESETS)} (ddgrasp --help says more)"] if " --preset " in text else []


def _without(options: Sequence[str], text: str) -> str:
    """Help `text` without the lines of `options`."""
    for option in options:
        text = re.sub(rf"^[│ ] {option}[ ,].*\n(?:[│ ] {{3,}}.*\n)*", "", text, flags=re.MULTILINE)
    return text


def refused(box: str, command: str) -> UserError:
    """The error that tyro's `box` tells, for the options of `command`."""
    trouble, *more = _blocks(box)
    if (choice := _CHOICE.search(trouble)) is not None:
        known = re.findall(r"'([^']*)'", trouble[choice.end() :])
        field = choice["option"].replace("-", "_")
        if all(name.isdigit() for name in known):
            return UserError(f"{field} is {choice['value']}; expected one of {', '.join(known)}.")
        return unknown_name(field, choice["value"], known)
    if (number := _NUMBER.search(trouble)) is not None:
        kind = "a whole number" if number["int"] else "a number"
        return UserError(f"{number['option']} is {number['value']}; expected {kind}.")
    nearest = [re.search(r"--[^\s,]+", block) for block in more if block.startswith("Perhaps you meant")]
    hint = f" Did you mean {nearest[0].group()}?" if nearest and nearest[0] else ""
    of_section = re.search(r"--[\w-]+\.\w", f"{trouble}{hint}")
    return UserError(
        f"{trouble.rstrip('.')}.{hint} Options: {command} {HELP_ALL if of_section else '--help'}."
    )


def _blocks(box: str) -> list[str]:
    """What stands between the rules of the box, each part on one line, without the title.

    On a terminal without UTF-8 the box has no frame, and a rule below its title.
    """
    lines = [line.strip().strip("│").strip() for line in _COLOUR.sub("", box).splitlines()]
    blocks: list[list[str]] = [[]]
    for line in lines:
        if _RULE.match(line):
            blocks.append([])
        elif line and line[0] not in "╭╰":
            blocks[-1].append(line)
    parts = [" ".join(block) for block in blocks]
    return parts if "╭" in box else parts[1:]
