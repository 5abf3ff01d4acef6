"""Materials for the surfaces of one random object."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from data_gen.shapes.choices import one_of
from data_gen.shapes.materials import Material
from data_gen.shapes.parts import Finish, Part
from data_gen.shapes.random.cuts import CUT_FACE
from data_gen.shapes.random.painting.textures import random_material
from data_gen.shapes.solids import Solid

__all__ = ["Paint"]

_FINISHES = (Finish(1.0), Finish(0.8), Finish(0.55), Finish(0.4), Finish(0.35), Finish(0.4, 0.3))
"""Matt to glossy; the last is metal, as far as the renderers support it."""


class Paint:
    """Draws the materials of one object: a single one, a few that recur, or always new ones.

    Attributes:
        finishes: the one or two finishes of the object.
    """

    def __init__(self, rng: np.random.Generator) -> None:
        self._rng = rng
        count = int(rng.choice([1, 2, 3, 4, 0], p=[0.08, 0.14, 0.18, 0.1, 0.5]))
        self._materials = [random_material(rng) for _ in range(count)]
        self.finishes = [one_of(rng, _FINISHES) for _ in range(int(rng.integers(1, 3)))]

    def draw(self) -> Material:
        """A material for the next surface."""
        if self._materials:
            return one_of(self._rng, self._materials)
        return random_material(self._rng)

    def part(self, name: str, solid: Solid) -> Part:
        """A painted solid: some have other materials on their flat ends, and most where they were cut."""
        part = replace(Part.of(name, solid, self.draw()), finish=one_of(self._rng, self.finishes))
        if self._rng.random() < 0.25 and (solid.cells[:, 0] == -1).any():
            part = part.capped(self.draw(), *one_of(self._rng, ((True, False), (False, True), (True, True))))
        cut = solid.cells[:, 0] == CUT_FACE
        if cut.any() and self._rng.random() < 0.6:
            part = part.painted(cut, self.draw())
        return part
