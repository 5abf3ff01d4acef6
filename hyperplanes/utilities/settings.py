"""Dataclasses made of the plain values in a file, every entry checked: its name, its type and its range.

A whole number's range is declared where the field is: `depth: Annotated[int, range(1, 257)] = 8`.
"""

from __future__ import annotations

import math
import reprlib
from collections.abc import Callable, Mapping
from dataclasses import asdict, fields, is_dataclass
from types import NoneType
from typing import Any, Literal, TypeVar, get_args, get_origin, get_type_hints

from cattrs import Converter, IterableValidationError
from cattrs.errors import ClassValidationError, ForbiddenExtraKeysError
from cattrs.gen import make_dict_structure_fn, override

from hyperplanes.utilities.errors import nearest

__all__ = ["SettingsError", "choose_by_tag", "structure", "tagged"]

Made = TypeVar("Made")


class SettingsError(ValueError):
    """One entry that cannot be used.

    Args:
        path: of the entry, such as "network.depth"; empty where all of it is meant.
        problem: what is wrong with it.
    """

    def __init__(self, path: str, problem: str) -> None:
        self.path, self.problem = path, problem
        super().__init__(f"{path}: {problem}" if path else problem)


def structure(kind: type[Made], value: object) -> Made:
    """A dataclass of the entries of a mapping; entries that are missing keep their defaults.

    >>> from dataclasses import dataclass
    >>> from typing import Annotated
    >>> @dataclass(frozen=True)
    ... class Network:
    ...     depth: Annotated[int, range(1, 257)] = 8
    >>> structure(Network, {"depth": 3})
    Network(depth=3)
    >>> structure(Network, {"deth": 3})
    Traceback (most recent call last):
    hyperplanes.utilities.settings.SettingsError: deth: an unknown entry; did you mean depth?

    Args:
        kind: the dataclass; its fields may be dataclasses.
        value: what a file holds.

    Returns:
        The dataclass. A whole number stands for a real one, nothing else is converted. An unknown entry, one of another
        type, a number out of its range or not finite, or a value that the dataclass itself refuses is a SettingsError;
        the first of them counts.
    """
    try:
        return _CONVERTER.structure(value, kind)
    except Exception as error:  # cattrs wraps whatever a dataclass raises
        found = _first(error, kind, ())
        if found is None:
            raise
        raise found from None


def choose_by_tag(union: Any, tag: str, kinds: Mapping[str, type]) -> None:
    """Let an entry of that name say which dataclass of a union is meant.

    Args:
        union: of dataclasses, and of None where there may be none.
        tag: the entry.
        kinds: the dataclasses by what the entry may be.
    """

    def hook(value: Any, _: Any) -> Any:
        if value is None and NoneType in get_args(union):
            return None
        if not isinstance(value, Mapping):
            raise ValueError(f"{reprlib.repr(value)} instead of its entries")
        chosen = value.get(tag)
        if not isinstance(chosen, str) or chosen not in kinds:
            raise ValueError(f"{tag}: expected one of {', '.join(kinds)}, got {chosen!r}")
        return _CONVERTER.structure({name: entry for name, entry in value.items() if name != tag}, kinds[chosen])

    _CONVERTER.register_structure_hook_func(lambda kind: kind == union, hook)


def tagged(value: Any, tag: str, kinds: Mapping[str, type]) -> dict[str, Any] | None:
    """The entries of a dataclass with the one that `choose_by_tag` asks; None of None."""
    if value is None:
        return None
    return {tag: next(name for name, kind in kinds.items() if type(value) is kind), **asdict(value)}


def _first(error: BaseException, kind: Any, path: tuple[str, ...]) -> SettingsError | None:
    """The first cause of a failure, with the path of its entry; None where it is no matter of settings."""
    if isinstance(error, ClassValidationError):
        noted, others = error.group_exceptions()
        if noted:
            cause, note = noted[0]
            return _first(cause, note.type, (*path, note.name))
        return _first(others[0], kind, path)
    if isinstance(error, IterableValidationError):
        noted, others = error.group_exceptions()
        return _first(noted[0][0] if noted else others[0], kind, path)
    where = ".".join(path)
    if isinstance(error, ForbiddenExtraKeysError):
        name = str(sorted(error.extra_fields, key=str)[0])
        known = [each.name for each in fields(error.cl)] if is_dataclass(error.cl) else []
        return SettingsError(".".join([*path, name]), f"an unknown entry; {nearest(name, known)}")
    if isinstance(error, KeyError):
        return SettingsError(where, "a missing entry")
    if isinstance(error, ValueError | TypeError):
        return SettingsError(where, " ".join(str(error).split()))
    return None


def _exact(check: Callable[[Any], bool], name: str) -> Callable[[Any, Any], Any]:
    def hook(value: Any, _: Any) -> Any:
        if not check(value):
            raise ValueError(f"{reprlib.repr(value)} instead of {name}")
        return value

    return hook


def _number(value: Any, _: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise ValueError(f"{reprlib.repr(value)} instead of a number")
    return float(value)


def _in_range(allowed: range) -> Callable[[Any, Any], Any]:
    name = f"a whole number from {allowed[0]} to {allowed[-1]}"
    return _exact(lambda value: _is_whole(value) and value in allowed, name)


def _one_of(value: Any, kind: Any) -> Any:
    known = get_args(kind)
    if not any(type(value) is type(each) and value == each for each in known):
        raise ValueError(f"expected one of {', '.join(map(repr, known))}, got {reprlib.repr(value)}")
    return value


def _names(value: Any, _: Any) -> tuple[str, ...]:
    if not isinstance(value, list | tuple) or not all(isinstance(each, str) for each in value):
        raise ValueError(f"{reprlib.repr(value)} instead of a list of names")
    return tuple(value)


def _entries(kind: Any) -> Callable[[Any, Any], Any]:
    """A dataclass; what is no mapping is refused before its entries are looked for."""
    ranges: dict[str, Any] = {
        name: override(struct_hook=_in_range(note))
        for name, hint in get_type_hints(kind, include_extras=True).items()  # cattrs itself drops the notes
        for note in getattr(hint, "__metadata__", ())
        if isinstance(note, range)
    }
    make = make_dict_structure_fn(kind, _CONVERTER, _cattrs_forbid_extra_keys=True, **ranges)

    def hook(value: Any, given: Any) -> Any:
        if not isinstance(value, Mapping):
            raise ValueError(f"{reprlib.repr(value)} instead of its entries")
        return make(value, given)  # pyright: ignore[reportCallIssue]

    return hook


def _is_whole(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool)


_CONVERTER = Converter(forbid_extra_keys=True)
_CONVERTER.register_structure_hook_factory(is_dataclass, _entries)
_CONVERTER.register_structure_hook(int, _exact(_is_whole, "a whole number"))
_CONVERTER.register_structure_hook(bool, _exact(lambda value: isinstance(value, bool), "true or false"))
_CONVERTER.register_structure_hook(str, _exact(lambda value: isinstance(value, str), "a name"))
_CONVERTER.register_structure_hook(float, _number)
_CONVERTER.register_structure_hook_func(lambda kind: kind == tuple[str, ...], _names)
_CONVERTER.register_structure_hook_func(lambda kind: get_origin(kind) is Literal, _one_of)
