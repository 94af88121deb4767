"""Float32 where a number is a place: GPUs and TPUs multiply matrices in less by default."""

from collections.abc import Callable
from functools import wraps
from typing import ParamSpec, TypeVar

import jax

_P = ParamSpec("_P")
_T = TypeVar("_T")


def exact(function: Callable[_P, _T]) -> Callable[_P, _T]:
    """`function`, in which products of float32 matrices are traced to be computed in float32.

    By default NVIDIA GPUs round their factors to the 10 bits of TF32 and TPUs to the 7 of bfloat16. A network
    does not mind, geometry and physics do (docs/accelerators.md has what it cost).
    """

    @wraps(function)
    def in_float32(*args: _P.args, **kwargs: _P.kwargs) -> _T:
        with jax.default_matmul_precision("highest"):
            return function(*args, **kwargs)

    return in_float32
