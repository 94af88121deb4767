"""What Ctrl-C, SIGTERM and a closed terminal do to a session with an arm."""

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager


def _ending() -> list[signal.Signals]:
    """Signals that end a session; what runs under nohup goes on without its terminal."""
    hangs_up = signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN
    return [signal.SIGTERM, signal.SIGINT, *([signal.SIGHUP] if hangs_up else [])]


@contextmanager
def terminable() -> Iterator[None]:
    """The first SIGTERM, Ctrl-C or hang-up is KeyboardInterrupt; a second one does not cut stopping short."""
    if threading.current_thread() is not threading.main_thread():  # signals are someone else's
        yield
        return
    ending = _ending()

    def interrupt(signum, frame):
        for number in ending:
            signal.signal(number, signal.SIG_IGN)
        raise KeyboardInterrupt

    previous = [signal.signal(number, interrupt) for number in ending]
    try:
        yield
    finally:
        for number, handler in zip(ending, previous, strict=True):
            signal.signal(number, handler)


@contextmanager
def unbroken() -> Iterator[None]:
    """Ctrl-C, SIGTERM and hang-ups change nothing: what ends anyway, as stopping an arm, comes to its end."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    ending = _ending()
    previous = [signal.signal(number, signal.SIG_IGN) for number in ending]
    try:
        yield
    finally:
        for number, handler in zip(ending, previous, strict=True):
            signal.signal(number, handler)
