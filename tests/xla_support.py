"""How XLA compiles in tests."""

from collections.abc import Iterator
from contextlib import contextmanager

import jax


@contextmanager
def optimized() -> Iterator[None]:
    """Programs compiled in here have all of XLA's optimisations, which `conftest` leaves out: worth it where
    steps take longer than their compilation."""
    before = jax.config.jax_disable_most_optimizations  # pyright: ignore[reportAttributeAccessIssue]
    jax.config.update("jax_disable_most_optimizations", False)
    try:
        yield
    finally:
        jax.config.update("jax_disable_most_optimizations", before)
