"""What a stage will need of memory and disk, told or refused before it starts."""

import contextlib
import shutil
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import psutil
from jax.extend import core

from ddgrasp import machine
from ddgrasp.errors import UserError
from learning.programs import Program


@dataclass(frozen=True)
class Need:
    """Bytes that a stage takes at its peak."""

    stage: str
    device: int
    """On each accelerator; on the host where there is none."""
    host: int
    """Arrays of its own there."""
    disk: int = 0
    """Scratch files that it removes in the end."""
    remedy: str = ""
    """What to lower for less memory."""
    scratch: str = ""
    """Folder in the stage's own where they lie, if an attempt that goes on finds them."""
    elsewhere: str = "work on another disk (--out)"
    """What to do instead of making room on the disk."""

    def __str__(self) -> str:
        parts = [f"{_readable(self.device)} for its programs", f"{_readable(self.host)} of arrays"]
        if self.disk:
            parts.append(f"{_readable(self.disk)} of disk for a time")
        return f"{self.stage}: about {', '.join(parts)}"


def _readable(count: int) -> str:
    return f"{count / 1e9:.1f} GB" if count >= 1e8 else f"{count / 1e6:.0f} MB"


def check(need: Need, directory: Path) -> None:
    """UserError if devices, host or the disk of the run `directory` have less than `need`; of disk, than is
    still to be written where the stage has begun."""
    for place, wanted, free, remedy in _places(need, directory):
        if wanted > free:
            raise UserError(
                f"Stage {need.stage} needs about {wanted / 1e9:.1f} GB {place}, which has "
                f"{free / 1e9:.1f} GB for it: {remedy}."
            )


def _places(need: Need, directory: Path) -> Iterator[tuple[str, int, int, str]]:
    limit, lower = device_limit(jax.local_devices()[0]), f"lower {need.remedy}"
    if limit is None:
        yield "of memory on the host", need.host + need.device * jax.local_device_count(), host_bytes(), lower
    else:
        yield "of memory on the device", need.device, limit, lower
        yield "of memory on the host", need.host, host_bytes(), lower
    there = next(path for path in (directory.absolute(), *directory.absolute().parents) if path.exists())
    written = _bytes_below(directory / need.stage / need.scratch) if need.scratch else 0
    free = shutil.disk_usage(there).free
    yield f"of disk in {directory}", need.disk - written, free, f"free some, or {need.elsewhere}"


def _bytes_below(folder: Path) -> int:
    total = 0
    for path in folder.rglob("*"):
        with contextlib.suppress(FileNotFoundError):  # another process may be at work
            total += path.stat().st_size
    return total


def device_limit(device: Any) -> int | None:
    """Bytes that JAX may take of an accelerator; None where the device's memory is the host's."""
    stats = device.memory_stats() if device.platform != "cpu" else None
    return stats.get("bytes_limit") if stats else None


def host_bytes() -> int:
    """Memory that this process may still take: the machine's, or what is left of a container's or a job's."""
    return min([psutil.virtual_memory().available, *_left()])


def _left() -> Iterator[int]:
    """Bytes left by every limit of a control group, of version 2 and 1."""
    for folder in machine.control_groups("memory"):
        for limit, used, cache in (
            ("max", "current", "inactive_file "),
            ("limit_in_bytes", "usage_in_bytes", "total_inactive_file "),
        ):
            with contextlib.suppress(OSError, ValueError):  # no such file; "max"
                most, taken = (int((folder / f"memory.{name}").read_text()) for name in (limit, used))
                yield most - taken + _counted(folder / "memory.stat", cache)


def _counted(stat: Path, name: str) -> int:
    """Bytes of `name`, here of files: they count as taken, and are given up when memory is asked for."""
    return sum(int(line.split()[1]) for line in stat.read_text().splitlines() if line.startswith(name))


def nbytes(tree: Any) -> int:
    """Bytes of all arrays, or shapes that stand for them, in a pytree."""
    return sum(x.size * x.dtype.itemsize for x in jax.tree.leaves(tree))


def compiled_bytes(compiled: jax.stages.Compiled) -> int | None:
    """Bytes that a program takes by XLA's own analysis, arguments and results included; None without one."""
    if (stats := compiled.memory_analysis()) is None:
        return None
    held = stats.argument_size_in_bytes + stats.output_size_in_bytes - stats.alias_size_in_bytes
    return held + stats.temp_size_in_bytes


def traced_bytes(program: Program) -> int:
    """Bytes that a program takes, before anything is compiled.

    The most that is alive at once if its operations run in the order written, each into an array of its own;
    arguments stay. What the compiler fuses takes less: measured against `compiled_bytes` by the tests.
    """
    jitted, arguments = program
    return _peak(jitted.trace(*arguments).jaxpr.jaxpr)


def _peak(jaxpr: core.Jaxpr) -> int:
    uses = Counter(var for eqn in jaxpr.eqns for var in eqn.invars if isinstance(var, core.Var))
    uses.update(var for var in jaxpr.outvars if isinstance(var, core.Var))
    total = peak = sum(map(_size, [*jaxpr.invars, *jaxpr.constvars]))
    held = {*jaxpr.invars, *jaxpr.constvars}
    for eqn in jaxpr.eqns:
        made = sum(map(_size, eqn.outvars))
        peak = max(peak, total + max(made, *map(_own, _inner(eqn)), 0))
        total += made
        uses.subtract(var for var in eqn.invars if isinstance(var, core.Var))
        for var in _distinct(eqn) - held:
            if uses[var] <= 0:
                total -= _size(var)
                held.add(var)
    return peak


def _distinct(eqn: core.JaxprEqn) -> set[core.Var]:
    return {var for var in (*eqn.invars, *eqn.outvars) if isinstance(var, core.Var)}


def _own(jaxpr: core.Jaxpr) -> int:
    """What an inner program takes beside its arguments."""
    return _peak(jaxpr) - sum(map(_size, [*jaxpr.invars, *jaxpr.constvars]))


def _inner(eqn: core.JaxprEqn) -> Iterator[core.Jaxpr]:
    for value in eqn.params.values():
        for part in value if isinstance(value, (tuple, list)) else (value,):
            if isinstance(part, core.ClosedJaxpr):
                yield part.jaxpr
            elif isinstance(part, core.Jaxpr):
                yield part


def _size(var: Any) -> int:
    aval = var.aval
    dtype = getattr(aval, "dtype", None)
    return aval.size * dtype.itemsize if dtype is not None else 0
