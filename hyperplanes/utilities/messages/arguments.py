"""One-line errors for arguments of public functions whose type differs from the annotation."""

from __future__ import annotations

import inspect
import sys
import types
from collections.abc import Callable
from functools import cache, wraps
from numbers import Integral, Real
from typing import (
    TYPE_CHECKING,
    Annotated,
    Any,
    Literal,
    ParamSpec,
    TypeGuard,
    TypeVar,
    Union,
    get_args,
    get_origin,
    get_type_hints,
)

if TYPE_CHECKING:
    from torch import Tensor

__all__ = ["checked", "checked_fields", "kind_of", "mismatch"]

P = ParamSpec("P")
R = TypeVar("R")


def checked(function: Callable[P, R]) -> Callable[P, R]:
    """A decorator: an argument of another type than annotated raises a ValueError that names it.

    It checks annotations that are classes, generics such as `Sequence[str]` (the class alone), tuples with their
    elements, `Callable`, `Literal`, `Annotated[int, range(...)]`, unions of these, and jaxtyping's arrays (kind of
    numbers, number of dimensions and fixed sizes); it ignores all others. A class passes for a `Callable` only if its
    instances are of the returned type.

    Args:
        function: its annotations must be resolvable in its module.
    """
    return _checking(function, function)


def checked_fields(settings: type[R]) -> type[R]:
    """A decorator for dataclasses that checks fields as `checked` checks arguments.

    >>> from dataclasses import dataclass
    >>> @checked_fields
    ... @dataclass(frozen=True)
    ... class Network:
    ...     depth: Annotated[int, range(1, 257)] = 8
    >>> Network(depth=0)
    Traceback (most recent call last):
    ValueError: depth: expected a whole number from 1 to 256, got 0
    """
    setattr(settings, "__init__", _checking(settings.__init__, settings))  # noqa: B010 - no assignment to a method
    return settings


def _checking(function: Callable[P, R], annotated: Any) -> Callable[P, R]:
    """The function with its arguments checked first, by its own annotations or those of a class."""
    signature = inspect.signature(function)
    names = list(signature.parameters)
    several = any("VAR" in each.kind.name for each in signature.parameters.values())

    @cache
    def hints() -> dict[str, Any]:
        found = get_type_hints(annotated, include_extras=True)
        return {name: hint for name, hint in found.items() if name != "return" and _is_checkable(hint)}

    @wraps(function)
    def called(*positional: P.args, **named: P.kwargs) -> R:
        if several:
            given = signature.bind(*positional, **named).arguments
        else:  # the same, much faster
            given = dict(zip(names, positional, strict=False)) | named
        looked_at = hints()
        for name, value in given.items():
            hint = looked_at.get(name, Any)
            if hint is not Any and (problem := mismatch(value, hint)):
                held = getattr(value, name, None)  # such as the cameras of views
                remedy = f"; pass its .{name}" if held is not None and _fits(held, hint) else ""
                raise ValueError(f"{name}: {problem}{remedy}")
        return function(*positional, **named)

    return called


def mismatch(value: object, hint: Any) -> str | None:
    """What was expected and found if a value does not have the type of an annotation; None if it does.

    >>> mismatch((3, "4"), tuple[int, ...])
    "expected a tuple of int, got a tuple of 3, '4'"
    """
    return None if _fits(value, hint) else f"expected {_shown(hint)}, got {kind_of(value)}"


def kind_of(value: object) -> str:
    """A value's kind, for a message.

    >>> kind_of(None), kind_of([1]), kind_of((1.5, [2]))
    ('None', 'a list', 'a tuple of 1.5, a list')
    """
    if isinstance(value, tuple) and value:
        return f"a tuple of {', '.join([*map(kind_of, value[:4]), *(['...'] if len(value) > 4 else [])])}"
    if _is_tensor(value):
        return f"a tensor of {str(value.dtype).removeprefix('torch.')}, shape {tuple(value.shape)}"
    if value is None or isinstance(value, bool | int | float | str):
        return repr(value)[:60]
    if isinstance(value, type):
        return f"the class {value.__name__}"
    return f"a {type(value).__module__}.{type(value).__name__}".replace("builtins.", "")


def _parts(hint: Any) -> tuple[Any, ...]:
    return get_args(hint) if get_origin(hint) in (Union, types.UnionType) else (hint,)


_in_any_order = cache(_parts)  # `str | Path` equals `Path | str`; messages keep the order as written


@cache
def _generic(hint: Any) -> tuple[Any, tuple[Any, ...]]:
    return get_origin(hint), get_args(hint)


@cache
def _is_array(hint: Any) -> bool:
    return hasattr(hint, "array_type") and hasattr(hint, "dims")


@cache
def _range(hint: Any) -> range | None:
    """The range of an annotated integer, if any."""
    if get_origin(hint) is not Annotated:
        return None
    return next((note for note in get_args(hint)[1:] if isinstance(note, range)), None)


def _is_checkable(hint: Any) -> bool:
    return all(
        _is_array(part) or isinstance(part, type) or _range(part) is not None or isinstance(get_origin(part), type)
        or get_origin(part) is Literal
        for part in _parts(hint)
    )  # fmt: skip


def _fits(value: object, hint: Any) -> bool:
    if isinstance(value, str) and _takes_devices(hint):
        return _is_device(value)
    return any(_fits_one(value, part) for part in _in_any_order(hint))


def _is_tensor(value: object) -> TypeGuard[Tensor]:
    torch = sys.modules.get("torch")  # importing it takes two seconds, and without it there are no tensors
    return torch is not None and isinstance(value, torch.Tensor)


def _takes_devices(hint: Any) -> bool:
    torch = sys.modules.get("torch")
    return torch is not None and torch.device in _in_any_order(hint)


def _is_device(name: str) -> bool:
    import torch

    try:
        torch.device(name)
    except RuntimeError:
        return False
    return True


def _fits_one(value: object, hint: Any) -> bool:
    if _is_array(hint):
        if not isinstance(value, hint.array_type):
            return False
        kinds, dimensions = hint.dtypes, hint.dims
        name = str(getattr(value, "dtype", "")).removeprefix("torch.")
        named = not isinstance(kinds, list | tuple) or name in kinds
        return named and _has_shape(tuple(getattr(value, "shape", ())), dimensions)
    if (allowed := _range(hint)) is not None:
        return _fits_one(value, int) and value in allowed
    if hint is float:
        number = isinstance(value, Real) and not isinstance(value, bool)
        number = number and (not isinstance(value, Integral) or abs(int(value)) < 2**63)
        return number or (_is_tensor(value) and value.numel() == 1)
    if hint is int:
        return isinstance(value, Integral) and not isinstance(value, bool) and abs(int(value)) < 2**63  # as in tensors
    origin, arguments = _generic(hint)
    if origin is Literal:
        return value in arguments
    if origin is Callable and isinstance(value, type):
        returned = get_origin(arguments[-1]) or arguments[-1]
        return isinstance(returned, type) and issubclass(value, returned)
    if origin is tuple:
        if not isinstance(value, tuple):
            return False
        parts = arguments[:1] * len(value) if Ellipsis in arguments else arguments
        return len(value) == len(parts) and all(map(_fits, value, parts))
    try:
        return isinstance(value, origin or hint)
    except TypeError:  # a protocol that is not runtime-checkable
        return True


def _has_shape(shape: tuple[int, ...], dimensions: tuple[Any, ...]) -> bool:
    """Whether a shape has jaxtyping's number of dimensions and its fixed sizes.

    A variadic dimension, at most one, stands for any number of dimensions.
    """
    free = next((at for at, each in enumerate(dimensions) if "Variadic" in type(each).__name__), None)
    if free is not None:
        others = (None,) * (len(shape) - len(dimensions) + 1)
        dimensions = (*dimensions[:free], *others, *dimensions[free + 1 :])
    return len(shape) == len(dimensions) and all(
        getattr(each, "size", size) == size for size, each in zip(shape, dimensions, strict=True)
    )


def _shown(hint: Any) -> str:
    if _takes_devices(hint):
        return "a device such as 'cpu' or 'cuda:0'"
    return " or ".join(_shown_one(part) for part in _parts(hint))


def _shown_one(part: Any) -> str:
    if _is_array(part):
        return f"a tensor ({part.dim_str.strip()})"
    if (allowed := _range(part)) is not None:
        return f"a whole number from {allowed[0]} to {allowed[-1]}"
    if get_origin(part) is Literal:
        return f"one of {', '.join(map(repr, get_args(part)))}"
    if get_origin(part) is tuple:
        parts = get_args(part)
        return f"a tuple of {_shown(parts[0])}" if Ellipsis in parts else f"a tuple of {len(parts)} numbers"
    return "None" if part is type(None) else getattr(get_origin(part) or part, "__name__", str(part))
