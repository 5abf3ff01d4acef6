"""Planes: airliners, fighters, light aircraft, biplanes, turboprops and gliders.

Metres, y up, nose along +z (so +x is the left wing's side), the fuselage's axis near y = 0.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from data_gen.shapes.choices import pick
from data_gen.shapes.parts import Part
from data_gen.shapes.planes.civil import airliner, turboprop
from data_gen.shapes.planes.military import fighter
from data_gen.shapes.planes.small import biplane, glider, light

__all__ = ["plane"]

_KINDS: dict[Callable[[np.random.Generator], list[Part]], float] = {
    airliner: 0.4,
    fighter: 0.22,
    light: 0.16,
    biplane: 0.08,
    turboprop: 0.09,
    glider: 0.05,
}
"""How often each kind of plane is drawn."""


def plane(rng: np.random.Generator) -> list[Part]:
    """A plane: its parts in metres, y up, nose along +z."""
    return pick(rng, _KINDS)(rng)
