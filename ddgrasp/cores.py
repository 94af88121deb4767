"""How many cores there are to work with."""

import os


def available() -> int:
    """Cores that this process may use: fewer than the machine's where it was pinned to some (taskset,
    Slurm, a container's cpuset)."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
