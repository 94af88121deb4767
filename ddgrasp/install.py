"""How what an installation lacks is installed: the command, for the Python that runs this."""

import os
import sys
from pathlib import Path

PROJECT = "ddgrasp"


def pip_install(extras: str) -> str:
    """The command that brings an extra of this project, or several with commas between.

    It names the Python of a virtual environment that is not active, which a bare `pip` would pass by.
    """
    return f"{_pip()} install '{PROJECT}[{extras}]'"


def _pip() -> str:
    active = Path(os.environ.get("VIRTUAL_ENV", sys.base_prefix)) == Path(sys.prefix)
    if active:
        return "pip"
    python = Path(sys.executable)
    here = Path.cwd()
    return f"{python.relative_to(here) if python.is_relative_to(here) else python} -m pip"
