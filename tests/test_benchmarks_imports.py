"""Every benchmark imports what there is: a name that moved is found here, not by who measures."""

import importlib
import os
from pathlib import Path
from unittest.mock import patch

import mujoco  # noqa: F401  (it reads MUJOCO_GL once, which benchmarks.world sets)
import pytest

FOLDER = Path(__file__).parents[1] / "benchmarks"
MODULES = sorted(file.stem for file in FOLDER.glob("[!_]*.py"))
OURS = {path.name for path in FOLDER.parent.iterdir() if (path / "__init__.py").exists()}


@pytest.mark.parametrize("name", MODULES)
def test_it_is_imported(name):
    with patch.dict(os.environ):
        try:
            module = importlib.import_module(f"benchmarks.{name}")
        except ModuleNotFoundError as error:
            if str(error.name).partition(".")[0] in OURS:
                raise
            pytest.skip(f"{error.name} is not installed")
    assert module.__doc__
