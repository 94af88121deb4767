"""Signals by which people and machines end a command."""

import contextlib
import os
import signal
import stat
from collections.abc import Iterator


def ending() -> list[signal.Signals]:
    """Those that end what runs: Ctrl-C, SIGTERM, and the end of the terminal, but for what runs under nohup
    and goes on without it."""
    hang_up = getattr(signal, "SIGHUP", None)  # Windows has none
    hangs_up = hang_up is not None and signal.getsignal(hang_up) is not signal.SIG_IGN
    return [signal.SIGTERM, signal.SIGINT, *([signal.SIGHUP] if hangs_up else [])]


@contextlib.contextmanager
def held_back(*numbers: signal.Signals) -> Iterator[None]:
    """Processes that the block starts never get these. This one does, once the block has ended, or at once
    where another of its threads takes them."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, numbers)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def forget_terminal(number: int) -> None:
    """After a hang-up what would be printed on the terminal goes nowhere: it would be an error in the midst
    of what saves the work. Does nothing for other signals, or where output goes to a file."""
    if number != getattr(signal, "SIGHUP", None):
        return
    for stream in (1, 2):
        with contextlib.suppress(OSError):
            if stat.S_ISCHR(os.fstat(stream).st_mode):
                os.dup2(os.open(os.devnull, os.O_WRONLY), stream)
