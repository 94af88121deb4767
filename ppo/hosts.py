"""Several processes that train as one, through JAX's own runtime. One process is the case of one."""

from typing import Any

import jax
import numpy as np
from jax.experimental import multihost_utils

from ddgrasp.config import HostsConfig
from ddgrasp.errors import UserError

CONNECT_TIMEOUT_S = 120


def connect(hosts: HostsConfig) -> None:
    """Joins the other processes, before anything asks JAX for its devices; UserError if they do not come."""
    if not hosts.coordinator:
        return
    named = {
        "coordinator_address": hosts.coordinator,
        "num_processes": hosts.processes,
        "process_id": hosts.process,
    }
    arguments: dict[str, Any] = {} if hosts.coordinator == "auto" else named
    try:
        jax.distributed.initialize(**arguments, initialization_timeout=CONNECT_TIMEOUT_S)
    except (RuntimeError, ValueError) as error:
        raise UserError(
            f"hosts.coordinator {hosts.coordinator!r}: no connection as process {hosts.process} of "
            f"{hosts.processes} within {CONNECT_TIMEOUT_S} s ({str(error).splitlines()[0]}). Start all of "
            "them, with the same address."
        ) from None


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
