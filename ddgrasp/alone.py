"""One process at a time at work in a folder: the lock is on the folder itself and leaves no file."""

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from ddgrasp.errors import UserError

_held: set[int] = set()
"""Descriptors of the folders in which this process is at work."""


@contextmanager
def alone_in(directory: Path) -> Iterator[None]:
    """Keeps other processes from working in `directory` while this lasts; whoever reads is not kept out.

    Ends with the process, however that ends, whatever processes it has begun. Where a file system knows no
    locks on folders, nobody is kept out. UserError if another process is at work there.
    """
    descriptor = os.open(directory, os.O_RDONLY)  # closed in programs that are started, as all are in Python
    _held.add(descriptor)
    try:
        _lock(descriptor, directory)
        yield
    finally:
        if descriptor in _held:  # not in a fork, which has let go of it
            _held.remove(descriptor)
            os.close(descriptor)


def _lock(descriptor: int, directory: Path) -> None:
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise UserError(
            f"another process is at work in {directory}: wait for it, or choose another --out."
        ) from None
    except OSError:  # no such locks, as on NFS
        return


def _let_go() -> None:
    """A fork shares its parent's locks until it closes them, also after the parent has died."""
    for descriptor in _held:
        os.close(descriptor)
    _held.clear()


os.register_at_fork(after_in_child=_let_go)
