"""What checks annotations in tests: beartype, by way of jaxtyping's import hook (conftest.py)."""

from collections.abc import Callable
from typing import TypeVar

from beartype import BeartypeConf, beartype

Function = TypeVar("Function", bound=Callable)
_check = beartype(conf=BeartypeConf(is_pep484_tower=True))
"""As for a static checker, a whole number is a float."""


def checked(function: Function) -> Function:
    """`function`, which raises if an argument or its result is not what it is annotated with.

    A dataclass's own `__init__` is left alone: JAX builds pytrees of placeholders and of shapes by it.
    """
    generated = function.__name__ == "__init__" and function.__code__.co_filename == "<string>"
    return function if generated else _check(function)
