"""Plugins: objects that entry points of other installed packages name."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Collection
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from typing import Any

__all__ = ["find_entries", "load_entries"]


def load_entries(group: str, own: Collection[str] = ()) -> dict[str, Any]:
    """The objects of a group of entry points by name.

    Args:
        group: such as "hyperplanes.fields".
        own: reserved names, whose entries are left out.

    Returns:
        The objects by name; each is imported once. One that cannot be imported is left out, with a warning that names
        its package, so that a broken package does not stop commands that do not need it.
    """
    loaded = {entry.name: _load(entry) for entry in find_entries(group) if entry.name not in own}
    return {name: value for name, value in loaded.items() if value is not None}


def find_entries(group: str) -> tuple[EntryPoint, ...]:
    """The entry points of a group, cached until `sys.path` changes: reading all packages' metadata takes 10 ms."""
    return _find_entries(group, tuple(sys.path))


@cache
def _find_entries(group: str, path: tuple[str, ...]) -> tuple[EntryPoint, ...]:
    return tuple(entry_points(group=group))


@cache
def _load(entry: EntryPoint) -> Any:
    """The object that an entry point names; None, with a warning, if it cannot be imported."""
    try:
        return entry.load()
    except Exception as error:  # importing another package can raise anything
        package = entry.dist.name if entry.dist else entry.value
        reason = " ".join(f"{type(error).__name__}: {error}".split())
        warnings.warn(
            f"{package}: {entry.name!r} of {entry.group} is left out, {entry.value} cannot be imported ({reason}); "
            "update or remove that package",
            stacklevel=3,
        )
        return None
