"""What is wrong with the words of a command line that the parser would take."""

import itertools
import typing
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated

import tyro

from ddgrasp.config.checks import kinds, stated
from ddgrasp.errors import UserError


def check_words(command: type, args: Sequence[str]) -> None:
    """UserError for words that no `command` can use: what is no text, an empty path (which would mean the
    current folder), an object's name without its option."""
    options, positionals = _paths(command)
    for before, word in zip(("", *args), args, strict=False):
        if any("\ud800" <= letter <= "\udfff" for letter in word):
            raise UserError(f"{word!r} is no UTF-8: give another name, or set LC_ALL=C.UTF-8 if it is.")
        name = (word[:-1] if word.endswith("=") else before).replace("_", "-")
        if (not word or word.endswith("=")) and name in options:
            raise UserError(f"{name} is empty: give a path; . is the current folder.")
        if positionals and not word and not before.startswith("--"):
            raise UserError(f"{positionals[0]} is empty: give a path; . is the current folder.")
    given = " ".join(itertools.takewhile(lambda word: not word.startswith("-"), args))
    if given.endswith(".onnx") and not positionals and "--policy" in options:
        raise UserError(f"{given!r} stands without an option: a policy is given by --policy {given}.")
    if given and not positionals and "objects" in kinds(command):
        raise UserError(f"{given!r} stands without an option: objects are given by --objects {given}.")


def _paths(command: type) -> tuple[list[str], list[str]]:
    """Options of `command` that take a path, and what help calls the paths that stand without one."""
    options, positionals = [], []
    for name, positional in _named_paths(command):
        (positionals if positional else options).append(name)
    return options, positionals


def _named_paths(command: type) -> Iterator[tuple[str, bool]]:
    """(name, whether it stands without an option) of each."""
    for field, kind in kinds(command).items():
        kind, *marks = typing.get_args(kind) if typing.get_origin(kind) is Annotated else (kind,)
        if Path not in (stated(kind), *typing.get_args(kind)):
            continue
        name = next((mark.name for mark in marks if getattr(mark, "name", None)), field).replace("_", "-")
        positional = tyro.conf.Positional in marks
        yield (name.upper() if positional else f"--{name}"), positional
