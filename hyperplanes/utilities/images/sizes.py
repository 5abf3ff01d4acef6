"""Sizes of scaled images."""

from __future__ import annotations

__all__ = ["scaled_size"]


def scaled_size(size: tuple[int, int], longest: int, *, enlarge: bool = False) -> tuple[int, int]:
    """A size in pixels, in either order of the axes, scaled so that the longer side has `longest` pixels.

    Smaller sizes stay unchanged without `enlarge`.

    >>> scaled_size((3000, 4000), 1000)
    (750, 1000)
    """
    factor = longest / max(size) if enlarge else min(1.0, longest / max(size))
    return max(1, round(size[0] * factor)), max(1, round(size[1] * factor))
