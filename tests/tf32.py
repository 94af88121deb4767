"""Products as NVIDIA GPUs make them by default, on a CPU: float32 factors rounded to TF32's 10 bits."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import jax
import jax.numpy as jnp
from jax._src.interpreters.mlir import _platform_specific_lowerings  # a rule is read nowhere else
from jax.extend.core.primitives import conv_general_dilated_p, dot_general_p
from jax.interpreters import mlir

_DROPPED_BITS = 13
"""float32 has a mantissa of 23 (NVIDIA, A100 white paper)."""
_HIGHEST = jax.lax.Precision.HIGHEST


@contextmanager
def by_default() -> Iterator[None]:
    """Inside, products compiled for the CPU are in TF32 unless they ask for the highest precision."""
    products = (dot_general_p, conv_general_dilated_p)
    exact = {product: _platform_specific_lowerings["cpu"][product].rule for product in products}
    jax.clear_caches()
    for product in products:
        mlir.register_lowering(product, _in_tf32(product, exact[product]), "cpu")
    try:
        yield
    finally:
        for product in products:
            mlir.register_lowering(product, exact[product], "cpu")
        jax.clear_caches()


def rounded(x: jax.Array) -> jax.Array:
    """The TF32 number next to each float32 `x`; other types as they are."""
    if x.dtype != jnp.float32:
        return x
    bits = jax.lax.bitcast_convert_type(x, jnp.uint32) + jnp.uint32(1 << (_DROPPED_BITS - 1))
    return jax.lax.bitcast_convert_type(bits >> _DROPPED_BITS << _DROPPED_BITS, jnp.float32)


def _in_tf32(product: Any, exact: Any) -> Any:
    def multiply(lhs: jax.Array, rhs: jax.Array, **params: Any) -> jax.Array:
        return product.bind(rounded(lhs), rounded(rhs), **params | {"precision": (_HIGHEST, _HIGHEST)})

    lower_rounded = mlir.lower_fun(multiply, multiple_results=False)

    def rule(context: Any, lhs: Any, rhs: Any, **params: Any) -> Any:
        asked = params["precision"]
        asks_for_all = asked is not None and all(one == _HIGHEST for one in asked)
        return (exact if asks_for_all else lower_rounded)(context, lhs, rhs, **params)

    return rule
