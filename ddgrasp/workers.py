"""Work spread over fresh processes, which leave Ctrl-C to the one that began them and go when it has gone."""

import atexit
import contextlib
import multiprocessing
import os
import pickle
import signal
import sys
import threading
import time
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import get_context
from typing import Any, Protocol, TypeVar

from ddgrasp import machine
from ddgrasp.errors import Trouble, UserError
from ddgrasp.signals import held_back

Item = TypeVar("Item")
Result = TypeVar("Result")
_Item = TypeVar("_Item", contravariant=True)
_Result = TypeVar("_Result", covariant=True)


class Worker(Protocol[_Item, _Result]):
    """Does one piece of work after the other."""

    def run(self, item: _Item, /) -> _Result:
        """One piece."""
        ...

    def close(self) -> None:
        """Lets go of everything."""
        ...


def worth(pieces: int, items: int) -> int:
    """Processes for work that has so many pieces of which each is worth a process, in so many `items`: at
    most one a core, and 0 where there would be one alone, for which `spread` needs no other process."""
    count = min(machine.cores(), pieces, items)
    return count if count > 1 else 0


def spread(
    make: Callable[[], Worker[Item, Result]],
    items: Sequence[Item],
    workers: int,
    remedy: str = "pinned to fewer cores (taskset) it needs less",
) -> Generator[Result, None, None]:
    """Results of `items` as they come, from `workers` fresh processes (0: all in this one, in their order).

    In a daemonic process, as a worker of multiprocessing's pool, all are made in this one: it may have none.
    The script that runs is not run again in the others, unless what is sent there is of it. After Ctrl-C or a
    UserError those that run come to their end, and their results still come, before it goes on.

    Args:
        make: called once in every process, for what does the work there; is sent there, as items are. If it,
            or an item, is of the script that runs, that needs its `if __name__ == "__main__"`.
        remedy: what needs less memory, for whoever reads that a process was killed.

    Raises UserError if a process was killed, and whatever `make` and the worker raise.
    """
    if not items:
        return
    if workers == 0 or multiprocessing.current_process().daemon:
        yield from _here(make, items)
        return
    executor = ProcessPoolExecutor(
        min(workers, len(items)),
        mp_context=get_context("spawn"),
        initializer=_start,
        initargs=(make, os.getpid()),
    )
    waiting: set[Future] = set()
    of_script = _is_of_script((make, items[0]))
    hidden = contextlib.nullcontext() if of_script else _script_hidden()
    try:
        with held_back(signal.SIGINT, signal.SIGHUP), hidden:  # workers leave them to this process
            # multiprocessing's tracker, whose start would let them through, came with the executor
            waiting |= {executor.submit(_run, item) for item in items}
        for future in as_completed(waiting):
            waiting.discard(future)  # a result may be megabytes
            yield future.result()
    except BrokenProcessPool:
        if of_script:
            raise Trouble(
                "workers did not start, or were killed. What is sent to them is of the script or notebook "
                'that runs: put it into a module, or the script\'s work under `if __name__ == "__main__":`. '
                f"If it is there, memory was short: {remedy}."
            ) from None
        raise Trouble(
            "a worker was killed, often for want of memory: what is finished is kept, and the same command "
            f"(with --resume where it has one) goes on; {remedy}."
        ) from None
    except (UserError, KeyboardInterrupt):  # those that run come to their end, and are kept
        signal.setitimer(signal.ITIMER_REAL, 0)  # a stage's interrupt comes again until it has surfaced
        executor.shutdown(wait=True, cancel_futures=True)
        yield from (future.result() for future in waiting if _has_ended_well(future))
        raise
    finally:
        executor.shutdown(wait=True, cancel_futures=True)


def _is_of_script(sent: Any) -> bool:
    """Whether a part of it is of the script that runs, by its name as it is sent; arrays, which may be
    gigabytes, are not copied for that."""
    return b"__main__" in pickle.dumps(sent, protocol=5, buffer_callback=lambda _: None)


_hiding = threading.Lock()


@contextlib.contextmanager
def _script_hidden() -> Iterator[None]:
    """Processes that the block starts do not run the script that this one was started with, as
    multiprocessing has them do: nothing of it is used there, and one that has no `if __name__ == "__main__"`
    would begin its own work in each of them."""
    script = sys.modules["__main__"]
    with _hiding:
        kept = {name: vars(script).pop(name) for name in ("__file__", "__spec__") if name in vars(script)}
        script.__spec__ = None
        try:
            yield
        finally:
            vars(script).update(kept)


def _here(make: Callable[[], Worker[Item, Result]], items: Sequence[Item]) -> Generator[Result, None, None]:
    worker = make()
    try:
        for item in items:
            yield worker.run(item)
    finally:
        worker.close()


def _has_ended_well(future: Future) -> bool:
    return future.done() and not future.cancelled() and future.exception() is None


# --- in a process of its own -------------------------------------------------------------------

_worker: Worker[Any, Any] | None = None
_make: Callable[[], Worker[Any, Any]]


def _start(make: Callable[[], Worker[Any, Any]], parent: int) -> None:
    """Go when the parent has gone, and leave the other cores to the other workers."""
    import cv2

    global _make
    cv2.setNumThreads(1)
    threading.Thread(target=_leave_with, args=(parent,), daemon=True).start()
    _make = make


def _leave_with(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(1.0)
    os._exit(1)


def _run(item: Any) -> Any:
    # The worker is made here, not in the initialiser, so that its errors reach the parent as they are.
    global _worker
    if _worker is None:
        _worker = _make()
        atexit.register(_worker.close)
    return _worker.run(item)
