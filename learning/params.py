"""Parameter files: a pytree of arrays as msgpack behind a checksum, written atomically.

They hold what a finished network is used by; `learning/checkpoints.py` holds what training goes on from.
"""

import hashlib
from pathlib import Path
from typing import Any

import jax
import numpy as np
from flax import serialization

from ddgrasp.errors import UserError
from ddgrasp.files import atomic_write_bytes

Params = Any
"""Nested dict of arrays."""

_MAGIC = b"DDGRASP-PARAMS-1\n"


def save_params(path: Path | str, pytree: Any) -> None:
    """Writes a pytree of arrays (nested dicts, Flax or Brax parameters) as checksummed msgpack."""
    state = jax.tree.map(np.asarray, serialization.to_state_dict(pytree))
    payload = serialization.msgpack_serialize(state)
    atomic_write_bytes(path, _MAGIC + hashlib.sha256(payload).digest() + payload)


def load_params(path: Path | str, target: Any = None) -> Any:
    """What `save_params` wrote: nested dicts of NumPy arrays, or shaped like `target` if one is given.

    Raises UserError if the file is absent, not ours, damaged, or does not fit `target`.
    """
    path = Path(path)
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        raise UserError(f"Parameter file {path} does not exist.") from None
    if not data.startswith(_MAGIC):
        raise UserError(f"{path} is no parameter file of this project: expected one written by save_params.")
    digest, payload = data[len(_MAGIC) :][:32], data[len(_MAGIC) + 32 :]
    if hashlib.sha256(payload).digest() != digest:
        raise UserError(f"Parameter file {path} is damaged or truncated: make it again, or restore a copy.")
    state: Any = serialization.msgpack_restore(payload)
    if target is None:
        return state
    try:
        restored = serialization.from_state_dict(target, state)
        if more := _names(state) - _names(serialization.to_state_dict(target)):  # which Flax drops
            raise ValueError(f"{min(more)} is in the file, not in the network")
        if difference := _shape_difference(restored, target):
            raise ValueError(difference)
    except (ValueError, KeyError) as error:
        reason = str(error).splitlines()[0]
        raise UserError(f"{path} does not fit this configuration's network ({reason}).") from None
    return restored


def _names(state: Any) -> set[str]:
    """The path of every array in nested dicts."""
    return {jax.tree_util.keystr(path) for path, _ in jax.tree_util.tree_leaves_with_path(state)}


def _shape_difference(given: Any, wanted: Any) -> str:
    """The first array of two trees of the same structure whose shapes differ, in words; empty if none."""
    pairs = zip(
        jax.tree_util.tree_leaves_with_path(given), jax.tree_util.tree_leaves_with_path(wanted), strict=True
    )
    for (path, here), (_, there) in pairs:
        if np.shape(here) != np.shape(there):
            return f"{jax.tree_util.keystr(path)} is {np.shape(here)}, the network's {np.shape(there)}"
    return ""
