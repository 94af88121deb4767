"""Array types for functions that take NumPy and JAX arrays alike. JAX-free.

Shapes and kinds of numbers are written with jaxtyping, `Float[AnyArray, "*batch 4"]`. Nothing is checked at
run time; the tests check every call (tests/conftest.py).
"""

from typing import Any, TypeAlias

AnyArray: TypeAlias = Any
"""A NumPy or a JAX array; functions of it return the same kind, which `Any` lets a type checker believe."""
