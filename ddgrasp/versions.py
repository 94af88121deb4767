"""Which code this is, and with which libraries."""

import contextlib
import functools
import importlib.metadata
import platform
import subprocess
from pathlib import Path

from ddgrasp.shipped import PRETRAINED

_LIBRARIES = ("jax", "mujoco", "mujoco-mjx", "brax", "flax", "optax", "onnxruntime", "numpy")


def library_versions() -> dict[str, str]:
    """Versions of Python, this project and the libraries that matter, without importing them; of a clone its
    commit besides."""
    versions = {"python": platform.python_version()}
    for name in ("ddgrasp", *_LIBRARIES):
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            versions[name] = importlib.metadata.version(name)
    return versions | ({"commit": commit()} if commit() else {})


def project_version() -> str:
    """This project's version in one line, "" where it is not installed; of a clone with its commit."""
    versions = library_versions()
    installed = versions.get("ddgrasp", "")
    return f"{installed} at {versions['commit']}" if "commit" in versions else installed


@functools.cache
def commit(root: Path = PRETRAINED.parent) -> str:
    """Commit of the clone `root` with "-dirty" if tracked files differ from it; "" where nothing says.

    An installed version says less: it is of the day of installation, whatever was pulled since.
    """
    if not (root / ".git").exists():
        return ""
    command = ["git", "-C", str(root), "describe", "--always", "--dirty", "--exclude=*", "--abbrev=9"]
    with contextlib.suppress(OSError, subprocess.SubprocessError):
        return subprocess.run(command, capture_output=True, check=True, text=True, timeout=10).stdout.strip()
    return ""
