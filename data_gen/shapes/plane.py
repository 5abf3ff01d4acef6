"""Planes: airliners, fighters, light aircraft, biplanes, turboprops and gliders.

Metres, y up, nose along +z (so +x is the left wing's side), the fuselage's axis near y = 0.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from data_gen.shapes.parts import Part, pick
from data_gen.shapes.plane_civil import airliner, turboprop
from data_gen.shapes.plane_military import fighter
from data_gen.shapes.plane_small import biplane, glider, light

__all__ = ["KINDS", "plane"]

KINDS: dict[str, tuple[float, Callable[[np.random.Generator], list[Part]]]] = {
    "airliner": (0.4, airliner),
    "fighter": (0.22, fighter),
    "light": (0.16, light),
    "biplane": (0.08, biplane),
    "turboprop": (0.09, turboprop),
    "glider": (0.05, glider),
}
"""Kinds of plane: how often each is drawn, and its builder."""


def plane(rng: np.random.Generator) -> list[Part]:
    """A plane: its parts in metres, y up, nose along +z."""
    kind = pick(rng, {name: share for name, (share, _) in KINDS.items()})
    return KINDS[kind][1](rng)
