"""Training frames in an accelerator's memory, where a batch of them is gathered without the host."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Int, UInt16

from ddgrasp.config import Config
from demos.row_reader import RowReader
from learning.memory import device_limit
from learning.prefetch import AHEAD
from student_jax import memory
from student_jax.data import Window

PART_ELEMENTS = 2**31 - 1
"""The most that one array on the device holds, so that 32 bits count them."""
ROOM_SHARE = 0.8
"""The rest is for what the estimate of a training step misses (docs/accelerators.md)."""
BLOCK = 256
"""Frames that go there at a time."""


class DepthOnDevice:
    """A copy of the first `count` of `stored` on the default device; a `DepthRows`.

    With `window`, of which `stored` has the pictures, they are read whole, invalid around it.
    """

    def __init__(self, stored: RowReader, count: int, window: Window | None = None):
        _, height, width = stored.shape
        self._rows = max(1, min(count, PART_ELEMENTS // (height * width)))
        self._parts = tuple(
            _copied(stored, first, min(first + self._rows, count)) for first in range(0, count, self._rows)
        )
        self._margins = ((0, 0), (0, 0)) if window is None else window.margins

    def read(self, index: Int[np.ndarray, " n"]) -> UInt16[Array, "n H W"]:
        """See `DepthRows`."""
        return gathered(self._rows, self._margins, self._parts, jnp.asarray(index, jnp.int32))


def room_bytes(config: Config) -> int:
    """What frames may take of an accelerator: ROOM_SHARE of what is left beside training.

    0 where its memory is the host's.
    """
    device = jax.local_devices()[0]
    limit = device_limit(device)
    if limit is None:
        return 0
    taken = device.memory_stats().get("bytes_in_use", 0)
    training = memory.training_bytes(config) + (AHEAD + 1) * memory.batch_bytes(config)
    return max(0, int(ROOM_SHARE * (limit - taken - training)))


def _copied(stored: RowReader, first: int, last: int) -> Array:
    """Pictures first..last, a block at a time: neither host nor device holds them twice."""
    part = jnp.zeros((last - first, *stored.shape[1:]), jnp.uint16)
    size = min(BLOCK, last - first)
    for start in range(0, last - first, size):
        start = min(start, last - first - size)  # one size, compiled once
        part = put(part, stored.read(first + start + np.arange(size)), start)
    return part


@partial(jax.jit, donate_argnums=0)
def put(part: UInt16[Array, "N H W"], block: UInt16[Array, "B H W"], start: int) -> UInt16[Array, "N H W"]:
    """`part` with `block` from picture `start` on."""
    return jax.lax.dynamic_update_slice(part, block, (start, 0, 0))


@partial(jax.jit, static_argnums=(0, 1))
def gathered(
    rows: int,
    margins: tuple[tuple[int, int], tuple[int, int]],
    parts: tuple[UInt16[Array, "N h w"], ...],
    index: Int[Array, " n"],
) -> UInt16[Array, "n H W"]:
    """Pictures `index` of all `parts`, of which each but the last has so many `rows`; `margins` around them
    are invalid."""
    made = parts[0][jnp.clip(index, 0, len(parts[0]) - 1)]
    for number, part in enumerate(parts[1:], 1):
        within = jnp.clip(index - number * rows, 0, len(part) - 1)
        made = jnp.where((index >= number * rows)[:, None, None], part[within], made)
    return jnp.pad(made, ((0, 0), *margins))
