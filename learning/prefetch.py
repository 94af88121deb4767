"""Batches made ahead of the step that takes them, so that a device does not wait for files."""

from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from types import TracebackType
from typing import Generic, TypeVar

T = TypeVar("T")

AHEAD = 2
"""Batches waiting: one would do, were all equally quick to make."""


class Prefetched(Generic[T]):
    """`make(step)` for steps asked for in order, made by a thread up to AHEAD steps before.

    A context manager, which ends the thread.

    `make` is called for one step after the other, never for two at once; what it raises is raised by the call
    for its step.

    Args:
      make: step number -> batch. Must be a function of the step alone, or of the calls before it.
      end: no step from here on is made.
    """

    def __init__(self, make: Callable[[int], T], end: int):
        self._make, self._end = make, end
        self._waiting: deque[tuple[int, Future[T]]] = deque()
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="prefetch")

    def __enter__(self) -> "Prefetched[T]":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._thread.shutdown(wait=True, cancel_futures=True)

    def __call__(self, step: int) -> T:
        """The batch of `step`, the one after the last call's; the first call may name any."""
        following = self._waiting[-1][0] + 1 if self._waiting else step
        for ahead in range(following, min(step + AHEAD + 1, self._end)):
            self._waiting.append((ahead, self._thread.submit(self._make, ahead)))
        number, batch = self._waiting.popleft()
        if number != step:
            raise ValueError(f"step {step} was asked for, {number} is next")
        return batch.result()
