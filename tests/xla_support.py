"""How XLA compiles in tests."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import wraps
from typing import Any

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


def optimizing(function: Callable[..., Any]) -> Callable[..., Any]:
    """`function`, compiled with all of XLA's optimisations where it is called first."""

    @wraps(function)
    def called(*args: Any, **kwargs: Any) -> Any:
        with optimized():
            return function(*args, **kwargs)

    return called
