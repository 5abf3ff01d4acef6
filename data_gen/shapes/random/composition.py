"""Compositions of random primitives: meaningless objects, from which a network learns to rely on the views.

The number of primitives and the lengths of their axes follow LRM-Zero (Xie et al. 2024, arXiv 2406.09371).
"""

from __future__ import annotations

import numpy as np

from data_gen.shapes.choices import one_of, pick
from data_gen.shapes.parts import Part
from data_gen.shapes.primitives import box, cylinder
from data_gen.shapes.random.cuts import difference
from data_gen.shapes.random.painting.surfaces import Paint
from data_gen.shapes.random.primitives import primitive
from data_gen.shapes.random.structures import structure
from data_gen.shapes.solids import Solid, merged, rotation

__all__ = ["COUNTS", "composition", "random_rotation"]

COUNTS = {1: 5, 2: 5, 3: 5, 4: 4, 5: 4, 6: 3, 7: 2, 8: 1, 9: 1}
"""Relative frequencies of objects by their number of primitives."""

RELIEF = 0.5
"""Share of the primitives with a height field."""

CUTS = 0.25
"""Share of the primitives from which others are subtracted; a quarter of it for the solids of structures."""

STRUCTURES = 0.3
"""Share of the objects with the structure of a table, a cart, a figure and so on."""

COPY_OFFSET = 0.003
"""Offset between copies, in extents of the solid: coplanar faces of two copies would flicker where they overlap."""

MOST_FACES = 3000
"""Faces of a primitive and its copies together."""

_PROPORTIONS = {"any": 0.62, "plate": 0.14, "rod": 0.12, "cube": 0.12}
_TURNS = {"none": 0.4, "quarter": 0.25, "upright": 0.15, "any": 0.2}
_ARRANGEMENTS = {"single": 0.66, "mirrored": 0.14, "row": 0.1, "ring": 0.1}


def random_rotation(rng: np.random.Generator) -> np.ndarray:
    """A rotation matrix (3, 3), uniform over all rotations (Shoemake 1992)."""
    w, x, y, z = (quaternion := rng.normal(size=4)) / np.linalg.norm(quaternion)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def _half_axes(rng: np.random.Generator, thin: bool) -> np.ndarray:
    """Half extents (3,) of a primitive: axes of 0.25 to 2; some are plates or rods if it may be thin."""
    axes = rng.uniform(0.25, 2.0, 3)
    kind = pick(rng, _PROPORTIONS) if thin else "any"
    if kind == "cube":
        axes[:] = axes[0]
    elif kind == "plate":
        axes[int(rng.integers(3))] = rng.uniform(0.03, 0.12)
    elif kind == "rod":
        long = int(rng.integers(3))
        axes[np.arange(3) != long] = rng.uniform(0.04, 0.2)
        axes[long] = rng.uniform(1.0, 2.2)
    return axes / 2


def _turn(rng: np.random.Generator) -> np.ndarray:
    """A rotation matrix (3, 3): none, quarter turns, about the y axis, or any."""
    kind = pick(rng, _TURNS)
    if kind == "none":
        return np.eye(3)
    if kind == "quarter":
        return rotation("xyz"[int(rng.integers(3))], 90.0 * int(rng.integers(1, 4)))
    if kind == "upright":
        return rotation("y", rng.uniform(0, 360))
    return random_rotation(rng)


def _piece(rng: np.random.Generator, thin: bool) -> Solid:
    """A primitive with its height field, its proportions and its rotation, about the origin."""
    solid = primitive(rng, RELIEF).scaled(*_half_axes(rng, thin))
    if rng.random() < CUTS:
        solid = _cut(rng, solid)
    return solid.transformed(_turn(rng))


def _cut(rng: np.random.Generator, solid: Solid) -> Solid:
    """The solid minus one to three primitives; unchanged if less than a quarter would be left."""
    left = solid
    low, high = solid.vertices.min(axis=0), solid.vertices.max(axis=0)
    for _ in range(int(rng.integers(1, 4))):
        tool = primitive(rng, 0.1).scaled(*(high - low) * rng.uniform(0.12, 0.45, 3))
        tool = tool.transformed(_turn(rng), low + (high - low) * rng.uniform(0.0, 1.0, 3))
        smaller = difference(left, tool)
        if smaller is not None and smaller.volume > 0.25 * solid.volume:
            left = smaller
    return left


def _arranged(rng: np.random.Generator, solid: Solid) -> Solid:
    """The solid alone, beside its mirror image, in a row of copies, or in a ring of them."""
    kind = pick(rng, _ARRANGEMENTS)
    most = max(2, MOST_FACES // len(solid.faces))
    extents = np.ptp(solid.vertices, axis=0)
    apart = np.full(3, COPY_OFFSET * extents.max())
    if kind == "mirrored":
        axis = int(rng.choice([0, 0, 2, 1]))
        mirror = np.diag(np.where(np.arange(3) == axis, -1.0, 1.0))
        shift = np.zeros(3)
        shift[axis] = extents[axis] * rng.uniform(0.3, 0.75)
        return merged([solid.moved(*shift), solid.transformed(mirror, apart - shift)])
    if kind == "row":
        count, axis = min(most, int(rng.integers(2, 6))), int(rng.integers(3))
        step = np.zeros(3)
        step[axis] = extents[axis] * rng.uniform(0.6, 1.2)
        size = rng.uniform(0.5, 0.9)
        places = (np.arange(count) - (count - 1) / 2)[:, None] * step
        return merged([solid.transformed(size * np.eye(3), place + k * apart) for k, place in enumerate(places)])
    if kind == "ring":
        count = min(most, int(rng.integers(3, 9)))
        small = solid.transformed(rng.uniform(0.3, 0.6) * np.eye(3))
        outer = small.moved(z=rng.uniform(0.3, 0.9))
        return merged([outer.transformed(rotation("y", 360.0 * k / count), k * apart) for k in range(count)])
    return solid


def _attached(rng: np.random.Generator, solid: Solid, others: list[Solid]) -> Solid:
    """The solid moved to the outside of one of the others, most often into it a little, some apart."""
    other = one_of(rng, others)
    direction = rng.normal(size=3)
    if rng.random() < 0.5:
        direction = np.where(np.arange(3) == int(rng.integers(3)), rng.choice([-1.0, 1.0]), 0.1 * direction)
    direction /= np.linalg.norm(direction)
    middle = (other.vertices.min(axis=0) + other.vertices.max(axis=0)) / 2
    reach = ((other.vertices - middle) @ direction).max() + (solid.vertices @ -direction).max()
    share = rng.uniform(1.05, 1.5) if rng.random() < 0.08 else rng.uniform(0.45, 0.95)
    return solid.moved(*middle + share * reach * direction)


def _base(rng: np.random.Generator, solids: list[Solid]) -> Solid:
    """A plate under all of them."""
    points = np.concatenate([solid.vertices for solid in solids])
    low, high = points.min(axis=0), points.max(axis=0)
    width, _, depth = (high - low) * rng.uniform(0.7, 1.4, 3) + 0.1
    thick = rng.uniform(0.03, 0.3)
    plate = box(width, thick, depth) if rng.random() < 0.6 else cylinder(0.5, thick, 24).scaled(width, 1.0, depth)
    middle = (low + high) / 2
    return plate.moved(middle[0], low[1] - 0.3 * thick, middle[2])


def _composed(rng: np.random.Generator) -> list[Solid]:
    """One to nine primitives, some of them repeated."""
    solids: list[Solid] = []
    for _ in range(pick(rng, COUNTS)):
        solid = _arranged(rng, _piece(rng, thin=bool(solids)))
        solids.append(_attached(rng, solid, solids) if solids else solid)
    if rng.random() < 0.12:
        edge = np.concatenate([solid.vertices for solid in solids])[:, 0]
        shift = -edge.min() - rng.uniform(0.1, 0.5) * np.ptp(edge)
        shifted = [solid.moved(shift) for solid in solids]
        apart = COPY_OFFSET * np.ptp(edge)
        solids = [merged([solid, solid.mirrored().moved(0.0, apart, apart)]) for solid in shifted]
    return solids


def composition(rng: np.random.Generator) -> list[Part]:
    """An object of random primitives, composed at random or as a rough structure.

    Returns:
        Its parts about the origin; any side may be up, but most stand upright.
    """
    if rng.random() < STRUCTURES:
        solids = [_cut(rng, solid) if rng.random() < CUTS / 4 else solid for solid in structure(rng)]
        upright = 0.85
    else:
        solids, upright = _composed(rng), 0.75
    if rng.random() < 0.15:
        solids.append(_base(rng, solids))
    turn = rotation("y", rng.uniform(0, 360)) if rng.random() < upright else random_rotation(rng)
    paint = Paint(rng)
    return [paint.part(f"piece_{index}", solid.transformed(turn)) for index, solid in enumerate(solids)]
