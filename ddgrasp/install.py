"""How what an installation lacks is installed: the command, for the Python that runs this."""

import os
import platform
import sys
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path

from ddgrasp.errors import UserError

PROJECT = "ddgrasp"
FR3 = ("franky_sim", "franky", "trimesh")
"""Modules of the extra [fr3] that the FR3 rig takes: its arm, the arm's driver, its objects."""
_OF_X86 = FR3[:2]


def check_fr3(what: str, needed: Sequence[str] = FR3) -> None:
    """UserError unless all that `what`, the FR3 rig or a part of it, takes is installed."""
    missing = lacks_fr3(needed)
    if set(missing) & set(_OF_X86) and (sys.platform, platform.machine()) != ("linux", "x86_64"):
        raise UserError(f"{what} needs {' and '.join(missing)}, which have builds for x86-64 Linux alone.")
    if missing:
        raise UserError(f"{what} needs {' and '.join(missing)}: {pip_install('fr3')}.")


def lacks_fr3(needed: Sequence[str] = FR3) -> list[str]:
    """What of the modules of FR3 that are `needed` is not installed."""
    return [module for module in needed if find_spec(module) is None]


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
