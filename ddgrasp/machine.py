"""What this process runs on: how much of the machine it may use, and what a figure was measured on."""

import contextlib
import math
import os
import platform
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

_CGROUP, _OWN_CGROUPS, _CPUINFO = Path("/sys/fs/cgroup"), Path("/proc/self/cgroup"), Path("/proc/cpuinfo")


def cores() -> int:
    """Cores that this process may use: fewer than the machine's where it was pinned to some (taskset,
    Slurm, a container's cpuset) or has a share of their time (`docker --cpus`, a Kubernetes limit)."""
    pinned = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(1, min([pinned, *(math.ceil(share) for share in _cpu_shares())]))


def _cpu_shares() -> Iterator[float]:
    """Cores' worth of time by every limit that there is."""
    for folder in control_groups("cpu"):
        with contextlib.suppress(OSError, ValueError, ZeroDivisionError):  # no such file; "max"
            quota, period = (folder / "cpu.max").read_text().split()
            yield int(quota) / int(period)
        with contextlib.suppress(OSError, ValueError, ZeroDivisionError):
            quota, period = (int((folder / f"cpu.cfs_{name}_us").read_text()) for name in ("quota", "period"))
            if quota > 0:  # -1: no limit
                yield quota / period


def control_groups(controller: str) -> list[Path]:
    """Folders of Linux's control groups that limit this process: its own and those above it, of version 2
    and of version 1's `controller`. A container sees its own as the root. None of their files need be there.
    """
    try:
        lines = [line.split(":", 2) for line in _OWN_CGROUPS.read_text().splitlines()]
    except OSError:
        lines = []
    of_version_1 = {name: path for _, names, path in lines for name in names.split(",") if name}
    places = [
        (_CGROUP, next((path for _, names, path in lines if not names), "/")),
        (_CGROUP / controller, of_version_1.get(controller, "/")),
    ]
    return [folder for root, path in places for folder in _upwards(root, root / path.lstrip("/"))]


def _upwards(root: Path, folder: Path) -> list[Path]:
    return [there for there in (folder, *folder.parents) if there.is_relative_to(root)]


def describe() -> dict[str, Any]:
    """Processor, cores that this process may use, operating system, and JAX's accelerators where it has
    been asked for its devices by now."""
    return {
        "processor": _processor(),
        "cores": cores(),
        "system": f"{platform.system()} {platform.machine()}",
        "accelerators": _accelerators(),
    }


def _processor() -> str:
    try:
        lines = _CPUINFO.read_text().splitlines()
    except OSError:
        lines = []
    names = [line.split(":", 1)[1].strip() for line in lines if "model name" in line]
    if sys.platform == "darwin":  # where platform says "arm"
        command = ["/usr/sbin/sysctl", "-n", "machdep.cpu.brand_string"]
        names = [subprocess.run(command, capture_output=True, text=True, check=False).stdout.strip()]
    return next(filter(None, names), "") or platform.processor() or platform.machine()


def _accelerators() -> list[str]:
    bridge = sys.modules.get("jax._src.xla_bridge")
    if bridge is None or not getattr(bridge, "backends_are_initialized", lambda: False)():
        return []
    import jax

    return [device.device_kind for device in jax.devices() if device.platform != "cpu"]
