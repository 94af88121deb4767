"""Every command that a page shows is one that the command line takes."""

import re
import shlex
from functools import cache
from pathlib import Path

import pytest

from app.commands import COMMANDS, parse
from ddgrasp.errors import UserError
from ddgrasp.stages import MADE_BY, STAGES

ROOT = Path(__file__).parents[1]
FILES = (ROOT / "README.md", ROOT / "CONTRIBUTING.md", *(ROOT / "pretrained").rglob("README.md"))
PAGES = sorted(str(page.relative_to(ROOT)) for page in (*FILES, *(ROOT / "docs").rglob("*.md")))
_INCOMPLETE = ("required", "Missing value", "expected 1 argument", "not enough")
"""What the parser says of a command in running text that names only the options it is about."""


def shown(page: str) -> tuple[list[str], list[str]]:
    """(commands in fenced blocks, commands in running text) of a page, without `ddgrasp`."""
    text = (ROOT / page).read_text()
    blocks = re.findall(r"^```sh\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
    lines = [line for block in blocks for line in expanded(block.replace("\\\n", " ")).splitlines()]
    fenced = [match[1] for line in lines if (match := re.search(r"(?:^|\s|/)ddgrasp (.*)", line))]
    prose = re.sub(r"^```.*?^```", "", text, flags=re.MULTILINE | re.DOTALL)
    return fenced, re.findall(r"`(?:\.venv/bin/)?ddgrasp ([^`]*)`", prose)


def expanded(block: str) -> str:
    """A shell block with the variables that it sets (`NAME="..."`) put in where it uses them."""
    while match := re.search(r'^([A-Z_]+)="(.*)"\n', block, re.MULTILINE):
        block = block.replace(match[0], "").replace(f"${match[1]}", match[2])
    return block


def named(words: list[str]) -> str:
    """The command that `words` begin with; empty if none does."""
    names = (" ".join(words[:length]) for length in (2, 1) if length <= len(words))
    return next((name for name in names if name in COMMANDS), "")


@cache
def refusal(command: str) -> str:
    """Why the command line does not take `command`; empty if it does."""
    words = [word for word in shlex.split(command, comments=True) if word != "..."]
    if words in (["--help"], ["--version"], *([name.split()[0]] for name in COMMANDS)):
        return ""  # the last ones are groups: `ddgrasp teacher` lists its commands
    if not (name := named(words)):
        return f"unknown command {command!r}"
    try:
        parse(name, words[len(name.split()) :])
    except UserError as error:
        return str(error)
    return ""


@pytest.mark.parametrize("page", PAGES)
def test_commands_on_a_page_can_be_given(page: str):
    fenced, prose = shown(page)
    wrong = {command: why for command in fenced if (why := refusal(command))}
    for command in prose:
        only_named = "--" not in command and named(command.split())
        why = "" if only_named else refusal(command)
        if why and not any(words in why for words in _INCOMPLETE):
            wrong[command] = why
    assert wrong == {}


def test_the_pages_commands_are_found():
    """Fences of another spelling would be looked past."""
    found = [command for page in PAGES for command in shown(page)[0]]
    assert len(found) > 100


def test_a_command_that_does_not_exist_is_found():
    assert "unknown command" in refusal("ddg paint")
    assert "--bogus" in refusal("run --bogus 3")
    assert "Unknown preset" in refusal("run --preset huge")
    assert refusal("run --preset debug --out runs/x  # a comment") == ""


def test_variables_that_a_block_sets_are_put_in_where_it_uses_them():
    block = 'A="--preset debug"\nB="$A --out runs/x"\nddgrasp run $B'
    assert expanded(block) == "ddgrasp run --preset debug --out runs/x"


def test_the_table_of_what_they_leave_has_every_command():
    page = (ROOT / "docs" / "commands.md").read_text()
    table = page.split("## What each reads and leaves")[1].split("\n## ")[0]
    assert COMMANDS.keys() <= set(re.findall(r"`([a-z0-9 ]+)`", table))


def test_every_stage_of_a_run_has_the_command_that_errors_name():
    assert MADE_BY.keys() == {stage.name for stage in STAGES} - {"deploy"}
    assert {name: COMMANDS[command].stage for name, command in MADE_BY.items()} == {n: n for n in MADE_BY}
