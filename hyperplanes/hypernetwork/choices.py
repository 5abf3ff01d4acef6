"""Settings that name one of a few things."""

from __future__ import annotations

from collections.abc import Collection, Mapping

__all__ = ["check_choices"]


def check_choices(settings: object, known: Mapping[str, Collection[str | None]]) -> None:
    """Hold settings against what there is to choose from.

    Args:
        settings: an object with attributes.
        known: what each of some of them may be, by name.

    Raises:
        ValueError: something else.
    """
    for name, choices in known.items():
        if getattr(settings, name) not in choices:
            expected = ", ".join(map(repr, choices))
            raise ValueError(f"{name}: expected one of {expected}, got {getattr(settings, name)!r}")
