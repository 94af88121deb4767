"""What Ctrl-C, SIGTERM and a closed terminal do to a session with an arm."""

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from typing import Any

from ddgrasp.signals import ending

_late: list[int] = []
"""Signals that came while a session ended."""


def ended_late() -> bool:
    """Whether a signal came while the last session was ending anyway: it has changed nothing yet."""
    return bool(_late)


def note(number: int) -> None:
    """A signal that ended what could be ended."""
    _late.append(number)


def terminable() -> AbstractContextManager[None]:
    """The first SIGTERM, Ctrl-C or hang-up is KeyboardInterrupt; a second one does not cut stopping short."""
    _late.clear()

    def interrupt(signum: int, frame: Any) -> None:
        for number in ending():
            signal.signal(number, signal.SIG_IGN)
        raise KeyboardInterrupt

    return _handled_by(interrupt)


def unbroken() -> AbstractContextManager[None]:
    """Ctrl-C, SIGTERM and hang-ups change `ended_late` alone: what ends anyway, as stopping an arm, comes to
    its end."""
    return _handled_by(lambda signum, frame: note(signum))


@contextmanager
def _handled_by(handler: Callable[[int, Any], Any]) -> Iterator[None]:
    if threading.current_thread() is not threading.main_thread():  # signals are someone else's
        yield
        return
    numbers = ending()
    previous = [signal.signal(number, handler) for number in numbers]
    try:
        yield
    finally:
        for number, before in zip(numbers, previous, strict=True):
            signal.signal(number, before)
