"""Jitted functions with the shapes that they are called with: to trace or lower without running them."""

from typing import Any

import jax
import jax.numpy as jnp

Program = tuple[Any, tuple[Any, ...]]
"""A jitted function, and its arguments: shapes, and values where they are static."""


def shape(*sizes: int, dtype: Any = jnp.float32) -> Any:
    """Stands for an array: a jax.ShapeDtypeStruct."""
    return jax.ShapeDtypeStruct(sizes, dtype)


def key() -> Any:
    """Stands for a key of jax.random."""
    return jax.eval_shape(lambda: jax.random.key(0))


def key_data() -> Any:
    """Stands for a key's words."""
    return jax.eval_shape(lambda: jax.random.key_data(jax.random.key(0)))
