"""How XLA compiles in tests."""

from collections.abc import Iterator
from contextlib import contextmanager

import jax

_FLAG = "jax_disable_most_optimizations"


@contextmanager
def optimized() -> Iterator[None]:
    """Programs compiled in here have all of XLA's optimisations, which `conftest` leaves out: worth it where
    steps take longer than their compilation."""
    before = jax.config.values[_FLAG]
    jax.config.update(_FLAG, False)
    try:
        yield
    finally:
        jax.config.update(_FLAG, before)
