"""The order in which people sort file names."""

from __future__ import annotations

import re

__all__ = ["natural_order"]


def natural_order(name: str) -> list[tuple[int, int | str]]:
    """A key that sorts numbers in names as numbers, and upper and lower case alike.

    >>> sorted(["r_10.png", "r_9.png", "R_1.png"], key=natural_order)
    ['R_1.png', 'r_9.png', 'r_10.png']
    """
    return [(0, int(part)) if part.isdecimal() else (1, part) for part in re.split(r"(\d+)", name.lower()) if part]
