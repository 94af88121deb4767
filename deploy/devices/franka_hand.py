"""The Franka Hand, asked and told in threads of its own."""

import threading
from collections.abc import Callable
from typing import Any

from ddgrasp import contract

GRASP_ANY_WIDTH_M = 1.5 * contract.GRIPPER_MAX_WIDTH_M
"""franky's outer tolerance: a grasp of any width counts, as in simulation. More than the whole opening, since
fingers that something presses apart report a little more than that."""
WIDTH_PERIOD_S = 0.03
THREADS = "Franka Hand"
END_S = 2.0
"""Longest wait for the end of a command, and for that of one that was aborted."""


class HandError(Exception):
    """The hand has failed; the arm, which has a connection of its own, need not have."""


class FrankaHand:
    """Opens and closes while the arm moves.

    The gripper answers over the network, and a command waits for the end of the one before: both take too
    long for a control period.
    """

    def __init__(self, gripper: Any, errors: tuple[type[Exception], ...], force_n: float):
        """`errors` are what the gripper may raise. Raises HandError if it does not say how wide it is."""
        self._gripper, self._errors, self._force_n = gripper, errors, force_n
        try:
            self._width_m = float(gripper.width)
        except errors as error:
            raise HandError(str(error)) from error
        self._wish: bool | None = None
        self._busy = False
        self._aborting: threading.Thread | None = None
        self._lock = threading.Lock()
        """Held while a command begins or ends, and while one is called off."""
        self._changed, self._stopping = threading.Event(), threading.Event()
        self._error: Exception | None = None
        self._acting = threading.Thread(target=self._guard, args=(self._act,), name=THREADS, daemon=True)
        self._acting.start()
        threading.Thread(target=self._guard, args=(self._watch,), name=THREADS, daemon=True).start()

    def width_m(self) -> float:
        """As the gripper last reported it. Raises HandError, of what stopped it."""
        if self._error is not None:
            raise HandError(str(self._error)) from self._error
        return self._width_m

    def set(self, close: bool) -> None:
        """Close or open. A motion that is not wished any more is stopped; the newest wish counts."""
        if close == self._wish:
            return
        with self._lock:
            self._wish = close
            self._changed.set()
            if self._busy:
                self._abort()

    def stop(self, connected: bool = True) -> None:
        """End both threads, after what they are at; the gripper keeps its grip.

        A command whose gripper goes away never returns: libfranka asks the closed socket again and again. So
        one that lasts is aborted, not left behind. Where the connection has gone already (not `connected`)
        nothing can be done.
        """
        self._stopping.set()
        self._changed.set()
        if not connected:
            return
        self._acting.join(END_S)
        if self._acting.is_alive():
            with self._lock:
                self._abort()
            self._acting.join(END_S)

    def _abort(self) -> None:
        """Stops the command that runs; once is enough, since none begins before that is through."""
        if self._aborting is not None and self._aborting.is_alive():
            return
        self._aborting = threading.Thread(target=self._guard_once, args=(self._gripper.stop,), daemon=True)
        self._aborting.start()

    def _guard(self, work: Callable[[], None]) -> None:
        while not self._stopping.is_set() and self._error is None:
            self._guard_once(work)

    def _guard_once(self, work: Callable[[], Any]) -> None:
        try:
            work()
        except (*self._errors, RuntimeError) as error:
            if self._error is None and not self._stopping.is_set():
                self._error = error

    def _watch(self) -> None:
        self._width_m = float(self._gripper.width)
        self._stopping.wait(WIDTH_PERIOD_S)

    def _act(self) -> None:
        self._changed.wait()
        if not self._stopping.is_set():
            self._await_abort()
        with self._lock:
            self._changed.clear()
            if self._stopping.is_set():
                return
            self._busy, close = True, self._wish
        try:
            if close:
                self._gripper.grasp(
                    0.0, contract.GRIPPER_SPEED_M_S, self._force_n, epsilon_outer=GRASP_ANY_WIDTH_M
                )
            elif not any(self._opened() or self._changed.is_set() for _ in range(2)):
                raise RuntimeError(f"told to open, twice, the hand stands at {1e3 * self._width_m:.0f} mm")
        except self._errors:
            if not self._changed.is_set():  # not stopped by `set`: the gripper's own trouble
                raise
        finally:
            with self._lock:
                self._busy = False

    def _opened(self) -> bool:
        """Whether the gripper, told to open, says that it has: fingers that are stuck raise nothing."""
        return self._gripper.open(contract.GRIPPER_SPEED_M_S) is not False

    def _await_abort(self) -> None:
        """A late `stop` must not meet the next command. Raises RuntimeError if it never ends."""
        if self._aborting is not None:
            self._aborting.join(END_S)
            if self._aborting.is_alive():
                raise RuntimeError(f"the gripper did not answer a stop within {END_S:g} s")
