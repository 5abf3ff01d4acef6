"""Random solids that fill a given box: the parts of structures."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from data_gen.shapes.primitives import box, cushion, tapered
from data_gen.shapes.random.primitives import Maker, ball, cylinder, lathe, loft, pebble, primitive
from data_gen.shapes.solids import Solid, merged

__all__ = ["BODIES", "LIMBS", "crate", "filling", "sides"]

Corner = Sequence[float] | np.ndarray


def filling(
    rng: np.random.Generator, makers: tuple[Maker, ...], low: Corner, high: Corner, relief: float = 0.2
) -> Solid:
    """One of some primitives, stretched into the box between two corners.

    Args:
        rng: source of every choice.
        makers: the primitives.
        low: the corner (x, y, z) of smallest coordinates.
        high: the opposite corner.
        relief: probability of a height field.

    Returns:
        The solid.
    """
    solid = primitive(rng, relief, makers)
    bottom, top = solid.vertices.min(axis=0), solid.vertices.max(axis=0)
    scale = (np.asarray(high, dtype=float) - np.asarray(low, dtype=float)) / (top - bottom)
    return solid.transformed(np.diag(scale), np.asarray(low, dtype=float) - scale * bottom)


def sides(solid: Solid) -> Solid:
    """The solid and its mirror image at x = 0."""
    return merged([solid, solid.mirrored()])


def crate(rng: np.random.Generator, _fine: bool) -> Solid:
    """A box, some with rounded edges, tapered, or swollen."""
    draw = rng.random()
    if draw < 0.4:
        return box(2, 2, 2, rng.choice([0.0, 0.1, 0.3]), 2)
    if draw < 0.75:
        top = rng.uniform(0.5, 1.0, 2) * 2
        return tapered((2, 2), (float(top[0]), float(top[1])), 2, (float(rng.uniform(-0.4, 0.4)), 0))
    return cushion(2, 2, 2, rng.uniform(0, 1))


BODIES: tuple[Maker, ...] = (crate, loft, cylinder, ball, pebble, lathe)
LIMBS: tuple[Maker, ...] = (crate, cylinder, lathe, loft)
