"""Several processes that train as one, through JAX's own runtime. One process is the case of one."""

import os
import signal
import socket
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import jax
import numpy as np
from jax.experimental import multihost_utils

from ddgrasp.config import HostsConfig
from ddgrasp.errors import UserError

CONNECT_TIMEOUT_S = 120
_RETRY_S = 0.2
_BEFORE_JAX_S = 60
"""JAX, whose way of giving up is to abort the process, is let wait so much longer than we do."""


def connect(hosts: HostsConfig) -> None:
    """Joins the other processes, before anything asks JAX for its devices.

    UserError if it cannot; if not all of them come the process ends here, with one line and code 2.
    """
    if hosts.coordinator == "auto":
        _initialize("no cluster answers for it: give host:port, hosts.processes and hosts.process")
    elif hosts.coordinator:
        who = f"process {hosts.process} of {hosts.processes}"
        print(
            f"{who}: waiting for the others at {hosts.coordinator}, {CONNECT_TIMEOUT_S} s at most",
            file=sys.stderr,
        )
        if hosts.process > 0:  # JAX aborts the whole process when nobody answers
            _wait_until_it_listens(hosts.coordinator)
        _initialize(
            f"{who} cannot use it: start every process with the address of process 0",
            coordinator_address=hosts.coordinator,
            num_processes=hosts.processes,
            process_id=hosts.process,
        )


def leads() -> bool:
    """Whether this process writes logs, policies and manifests."""
    return jax.process_index() == 0


def wait_for_all(what: str) -> None:
    """Returns once every process has come here; `what` must be the same in all of them."""
    if jax.process_count() > 1:
        multihost_utils.sync_global_devices(what)


def from_leader(tree: Any) -> Any:
    """The leading process's `tree` of arrays, as NumPy arrays, in every process."""
    tree = jax.tree.map(np.asarray, tree)
    return multihost_utils.broadcast_one_to_all(tree) if jax.process_count() > 1 else tree


def _initialize(trouble: str, **arguments: Any) -> None:
    """`jax.distributed.initialize`; `trouble` explains a failure."""
    address = arguments.get("coordinator_address", "auto")
    try:
        with _endable(address, arguments.get("num_processes", "all")):
            jax.distributed.initialize(**arguments, initialization_timeout=CONNECT_TIMEOUT_S + _BEFORE_JAX_S)
    except (RuntimeError, ValueError) as error:
        reason = str(error).splitlines()[0]
        raise UserError(f"hosts.coordinator is {address!r}, and {trouble} ({reason}).") from None


@contextmanager
def _endable(address: str, processes: int | str) -> Iterator[None]:
    """Lets CONNECT_TIMEOUT_S, and Ctrl-C, end the process: inside of JAX, where the others are waited for,
    nothing can be raised."""

    def end() -> None:
        print(
            f"ddgrasp: hosts.coordinator is {address!r}, and not all processes ({processes}) came there in "
            f"{CONNECT_TIMEOUT_S} s: start each of them, with a hosts.process of its own.",
            file=sys.stderr,
            flush=True,
        )
        os._exit(2)

    late = threading.Timer(CONNECT_TIMEOUT_S, end)
    late.daemon = True
    late.start()
    handler = signal.getsignal(signal.SIGINT)
    ours = threading.current_thread() is threading.main_thread() and callable(handler)  # not one ignored
    if ours:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    try:
        yield
    finally:
        late.cancel()
        if ours:
            signal.signal(signal.SIGINT, handler)


def _wait_until_it_listens(address: str) -> None:
    """UserError unless something accepts connections at host:port within CONNECT_TIMEOUT_S."""
    host, _, port = address.rpartition(":")
    host = host.removeprefix("[").removesuffix("]")  # of an IPv6 address
    deadline = time.monotonic() + CONNECT_TIMEOUT_S
    while True:
        try:
            socket.create_connection((host, int(port)), timeout=CONNECT_TIMEOUT_S).close()
            return
        except UnicodeError:
            raise UserError(
                f"hosts.coordinator is {address!r}, and {host!r} can be no host's name: check the address."
            ) from None
        except OSError as error:
            if time.monotonic() > deadline:
                raise UserError(
                    f"hosts.coordinator is {address!r}, and nothing answered there for {CONNECT_TIMEOUT_S} s "
                    f"({error}): start process 0 as well, and check the address."
                ) from None
            time.sleep(_RETRY_S)
