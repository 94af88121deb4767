"""What checks annotations in tests: beartype, and jaxtyping's shapes where there are any, put onto every
function of some packages by jaxtyping's import hook (conftest.py).

The hook's own decorator checks arguments twice and binds them by `inspect` in every call, whatever they are:
17 of 66 s of CPU time in five files with 209 tests (two AMD EPYC cores, 2026-11-29).
"""

import functools
import inspect
from collections.abc import Callable, Iterator, Sequence
from types import SimpleNamespace
from typing import Any, ForwardRef, Literal, TypeVar, get_args, get_origin, get_type_hints

import jaxtyping
from beartype import BeartypeConf, beartype

Function = TypeVar("Function", bound=Callable)

_CONF = BeartypeConf(is_pep484_tower=True, violation_type=jaxtyping.TypeCheckError)
"""A whole number is a `float`, as for pyright."""
_jaxtyped = jaxtyping.jaxtyped


def install(packages: Sequence[str]) -> None:
    """From now on calls of functions in `packages`, once those are imported, are checked."""
    jaxtyping.jaxtyped = _decorated
    jaxtyping.install_import_hook(packages, "typecheck_support.checked")


def checked(function: Function) -> Function:
    """`function`, which raises if an argument or its result is not what it is annotated with.

    A dataclass's own `__init__` is left alone: JAX builds pytrees of placeholders and of shapes by it.
    """
    generated = function.__name__ == "__init__" and function.__code__.co_filename == "<string>"
    return function if generated else beartype(conf=_CONF)(function)


def checks(function: Callable[..., Any]) -> Callable[..., Any]:
    """`function`, checked as every one in the packages is."""
    return _decorated(function, typechecker="")


def _decorated(of: Any = None, *, typechecker: Any) -> Any:
    """In the place of `jaxtyping.jaxtyped`: what it is put onto, checked alike."""
    if of is None:
        return functools.partial(_decorated, typechecker=typechecker)
    if not inspect.isfunction(of):
        return _jaxtyped(of, typechecker=typechecker)
    if not of.__annotations__:
        return of
    of.__annotations__ = {name: _read(hint, of.__globals__) for name, hint in of.__annotations__.items()}
    shapes = [shape for hint in of.__annotations__.values() for shape in _shapes(hint)]
    if not shapes:
        return checked(of)
    if any("{" in shape for shape in shapes):  # a length that another argument says
        return _jaxtyped(checked(of), typechecker=None)
    return _within_a_scope(checked(of))


def _within_a_scope(function: Callable[..., Any]) -> Callable[..., Any]:
    """`function`, in each call of which a length's name stands for one number."""

    @functools.wraps(function)
    def called(*args: Any, **kwargs: Any) -> Any:
        with _jaxtyped("context"):
            return function(*args, **kwargs)

    return called


def _read(hint: Any, names: dict[str, Any]) -> Any:
    """An annotation whose quoted parts are read; Any, as by jaxtyping, where one names nothing yet."""
    if not _is_quoted(hint):
        return hint
    try:
        return get_type_hints(SimpleNamespace(__annotations__={"it": hint}), names, include_extras=True)["it"]
    except Exception:
        return Any


def _is_quoted(hint: Any) -> bool:
    return isinstance(hint, str | ForwardRef) or any(map(_is_quoted, _parts(hint)))


def _shapes(hint: Any) -> Iterator[str]:
    if isinstance(hint, type) and issubclass(hint, jaxtyping.AbstractArray):
        yield hint.dim_str
    for part in _parts(hint):
        yield from _shapes(part)


def _parts(hint: Any) -> Sequence[Any]:
    """A Callable's arguments are a list, a Literal's values no annotations."""
    if isinstance(hint, list):
        return hint
    return () if get_origin(hint) is Literal else get_args(hint)
