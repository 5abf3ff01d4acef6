"""What other installed packages add: objects that entry points name."""

from __future__ import annotations

from collections.abc import Collection
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from typing import Any

__all__ = ["load_entries"]


def load_entries(group: str, own: Collection[str] = ()) -> dict[str, Any]:
    """The objects of a group of entry points by name.

    Args:
        group: such as "hyperplanes.fields".
        own: names that are taken; entries of those names are left out.

    Returns:
        What the entry points name; each is imported once. One that cannot be imported is a ValueError that names its
        package.
    """
    return {entry.name: _load(entry) for entry in entry_points(group=group) if entry.name not in own}


@cache
def _load(entry: EntryPoint) -> Any:
    try:
        return entry.load()
    except (ImportError, AttributeError) as error:
        package = entry.dist.name if entry.dist else entry.value
        raise ValueError(
            f"{package}: expected {entry.value} for {entry.group} {entry.name!r}, found none ({error}); "
            "update or remove that package"
        ) from None
