"""Arguments of public functions that are of another type than their annotation says: one line, where they enter."""

from __future__ import annotations

import inspect
import types
from collections.abc import Callable
from functools import cache, wraps
from numbers import Integral, Real
from typing import Any, ParamSpec, TypeVar, Union, get_args, get_origin, get_type_hints

from torch import Tensor

__all__ = ["checked", "kind_of"]

P = ParamSpec("P")
R = TypeVar("R")


def checked(function: Callable[P, R]) -> Callable[P, R]:
    """A decorator: arguments of another class than annotated are a ValueError that names the argument.

    Looked at are annotations that are classes, unions of them, and jaxtyping's arrays, of which the kind of numbers and
    the number of dimensions count; all others are taken as they come.

    Args:
        function: with annotations that its module can resolve.
    """
    signature = inspect.signature(function)

    @cache
    def hints() -> dict[str, Any]:
        found = get_type_hints(function)
        return {name: hint for name, hint in found.items() if name != "return" and _is_checkable(hint)}

    @wraps(function)
    def called(*positional: P.args, **named: P.kwargs) -> R:
        bound = signature.bind(*positional, **named)
        for name, value in bound.arguments.items():
            hint = hints().get(name, Any)
            if hint is not Any and not _fits(value, hint):
                raise ValueError(f"{name}: expected {_shown(hint)}, got {kind_of(value)}")
        return function(*positional, **named)

    return called


def kind_of(value: object) -> str:
    """What a value is, for a message.

    >>> kind_of(None), kind_of([1])
    ('None', 'a list')
    """
    if isinstance(value, Tensor):
        return f"a tensor of {str(value.dtype).removeprefix('torch.')}, shape {tuple(value.shape)}"
    if value is None or isinstance(value, bool | int | float | str):
        return repr(value)[:60]
    return f"a {type(value).__module__}.{type(value).__name__}".replace("builtins.", "")


def _parts(hint: Any) -> tuple[Any, ...]:
    return get_args(hint) if get_origin(hint) in (Union, types.UnionType) else (hint,)


def _is_array(hint: Any) -> bool:
    return hasattr(hint, "array_type") and hasattr(hint, "dims")


def _is_checkable(hint: Any) -> bool:
    return all(_is_array(part) or isinstance(part, type) for part in _parts(hint))


def _fits(value: object, hint: Any) -> bool:
    return any(_fits_one(value, part) for part in _parts(hint))


def _fits_one(value: object, hint: Any) -> bool:
    if _is_array(hint):
        if not isinstance(value, hint.array_type):
            return False
        kinds, dimensions = hint.dtypes, hint.dims
        name = str(getattr(value, "dtype", "")).removeprefix("torch.")
        named = not isinstance(kinds, list | tuple) or name in kinds
        variadic = any("Variadic" in type(each).__name__ for each in dimensions)
        return named and (variadic or len(dimensions) == getattr(value, "ndim", -1))
    if hint is float:
        return (isinstance(value, Real) and not isinstance(value, bool)) or isinstance(value, Tensor)
    if hint is int:
        return isinstance(value, Integral) and not isinstance(value, bool)
    try:
        return isinstance(value, hint)
    except TypeError:  # a protocol that cannot be asked
        return True


def _shown(hint: Any) -> str:
    names = [
        f"a tensor ({part.dim_str.strip()})" if _is_array(part) else "None" if part is type(None) else part.__name__
        for part in _parts(hint)
    ]
    return " or ".join(names)
