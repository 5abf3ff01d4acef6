"""Dataclasses from the plain values of a file, with checks of every entry's name, type and range.

The range of an integer is declared with the field: `depth: Annotated[int, range(1, 257)] = 8`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import MISSING, asdict, fields, is_dataclass
from types import NoneType
from typing import Any, TypeVar, get_args, get_origin, get_type_hints

from hyperplanes.utilities.messages.arguments import kind_of, mismatch
from hyperplanes.utilities.messages.errors import nearest

__all__ = ["SettingsError", "choose_by_tag", "flattened", "structure", "tagged"]

Made = TypeVar("Made")

_TAGGED: dict[Any, tuple[str, Mapping[str, type]]] = {}


class SettingsError(ValueError):
    """One entry that cannot be used.

    Args:
        path: of the entry, such as "network.depth"; empty for the whole.
        problem: what is wrong with it.
    """

    def __init__(self, path: str, problem: str) -> None:
        self.path, self.problem = path, problem
        super().__init__(f"{path}: {problem}" if path else problem)


def structure(kind: type[Made], value: object, path: str = "") -> Made:
    """A dataclass of the entries of a mapping; entries that are missing keep their defaults.

    >>> from dataclasses import dataclass
    >>> @dataclass(frozen=True)
    ... class Network:
    ...     depth: int = 8
    >>> structure(Network, {"depth": 3})
    Network(depth=3)
    >>> structure(Network, {"deth": 3})
    Traceback (most recent call last):
    hyperplanes.utilities.files.settings.SettingsError: deth: an unknown entry; did you mean depth?

    Args:
        kind: the dataclass; its fields may be dataclasses.
        value: what a file holds.
        path: of the value in the file.

    Returns:
        The dataclass. Integers are converted to floats and lists to tuples, nothing else. An unknown entry, another
        type, a number out of range or not finite, or a value that the dataclass refuses raises a SettingsError for the
        first of them.
    """
    return _dataclass(kind, value, path)


def choose_by_tag(union: Any, tag: str, kinds: Mapping[str, type]) -> None:
    """Let an entry select the dataclass of a union.

    Args:
        union: of dataclasses, and None if optional.
        tag: name of the entry.
        kinds: the dataclasses by value of the entry.
    """
    _TAGGED[union] = tag, kinds


def tagged(value: Any, tag: str, kinds: Mapping[str, type]) -> dict[str, Any] | None:
    """The entries of a dataclass and its tag, as `choose_by_tag` expects; None for None."""
    if value is None:
        return None
    return {tag: next(name for name, kind in kinds.items() if type(value) is kind), **asdict(value)}


def flattened(entries: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested mappings as one, with names joined by dots.

    >>> flattened({"a": {"b": 1, "c": 2}})
    {'a.b': 1, 'a.c': 2}
    """
    flat: dict[str, Any] = {}
    for name, value in entries.items():
        flat |= flattened(value, f"{prefix}{name}.") if isinstance(value, Mapping) else {f"{prefix}{name}": value}
    return flat


def _dataclass(kind: Any, value: object, path: str) -> Any:
    value, prefix = _mapping(value, path), f"{path}." if path else ""
    known, hints = {each.name: each for each in fields(kind)}, get_type_hints(kind, include_extras=True)
    for name in sorted(value, key=str):
        if name not in known:
            raise SettingsError(f"{prefix}{name}", f"an unknown entry; {nearest(str(name), list(known))}")
    for name, each in known.items():
        if name not in value and each.default is MISSING and each.default_factory is MISSING:
            raise SettingsError(f"{prefix}{name}", "a missing entry")
    made = {name: _entry(hints[name], value[name], f"{prefix}{name}") for name in known if name in value}
    try:
        return kind(**made)
    except (ValueError, TypeError) as error:
        text = " ".join(str(error).split())
        name, _, problem = text.partition(": ")
        raise (SettingsError(f"{prefix}{name}", problem) if name in known else SettingsError(path, text)) from None


def _mapping(value: object, path: str) -> Mapping[Any, Any]:
    if not isinstance(value, Mapping):
        raise SettingsError(path, f"expected its entries by name, got {kind_of(value)}")
    return value


def _entry(hint: Any, value: Any, path: str) -> Any:
    """The value of a field with this annotation, from the value in a file."""
    if value is None and NoneType in get_args(hint):
        return None
    if hint in _TAGGED:
        tag, kinds = _TAGGED[hint]
        entries = _mapping(value, path)
        chosen = entries.get(tag)
        if not isinstance(chosen, str) or chosen not in kinds:
            raise SettingsError(path, f"{tag}: expected one of {', '.join(kinds)}, got {kind_of(chosen)}")
        return _dataclass(kinds[chosen], {name: entry for name, entry in entries.items() if name != tag}, path)
    for part in _kinds(hint):
        if is_dataclass(part):
            return _dataclass(part, value, path)
    value = _converted(hint, value)
    if problem := mismatch(value, hint):
        raise SettingsError(path, problem)
    numbers = value if isinstance(value, tuple) else (value,)
    if not all(math.isfinite(each) for each in numbers if isinstance(each, float)):
        raise SettingsError(path, f"expected finite numbers, got {kind_of(value)}")
    return value


def _converted(hint: Any, value: Any) -> Any:
    """Lists become tuples, all elements of one type, and integers become floats, where these are expected."""
    for part in _kinds(hint):
        if get_origin(part) is tuple and isinstance(value, list):
            return tuple(_converted(get_args(part)[0], each) for each in value)
        if part is float and type(value) is int and abs(value) < 2**63:
            return float(value)
    return value


def _kinds(hint: Any) -> tuple[Any, ...]:
    """The parts of a union with None; any other annotation alone."""
    return get_args(hint) if NoneType in get_args(hint) else (hint,)
