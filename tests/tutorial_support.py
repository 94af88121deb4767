"""The tutorials' commands and code, so that tests run what a reader runs."""

import re
import shlex
from pathlib import Path

TUTORIALS = Path(__file__).parents[1] / "docs" / "tutorials"


def small(page: str) -> list[list[str]]:
    """Commands of the section "Small first" of a tutorial, each as words without `.venv/bin/ddgrasp`."""
    section = (TUTORIALS / page).read_text().split("\n## Small first\n")[1].split("\n## ")[0]
    (block,) = re.findall(r"^```sh\n(.*?)^```", section, re.MULTILINE | re.DOTALL)
    lines = [line for line in block.splitlines() if line.startswith(".venv/bin/ddgrasp ")]
    return [shlex.split(line, comments=True)[1:] for line in lines]


def moved(command: list[str], places: dict[str, Path]) -> list[str]:
    """`command` with the folders of the page, the longest name first, elsewhere."""
    names = sorted(places, key=len, reverse=True)
    return [next((word.replace(n, str(places[n]), 1) for n in names if word.startswith(n)), word)
            for word in command]  # fmt: skip


def code(page: str) -> list[str]:
    """Python blocks of a tutorial, or of another page by its path from there, in order."""
    return re.findall(r"^```python\n(.*?)^```", (TUTORIALS / page).read_text(), re.MULTILINE | re.DOTALL)
