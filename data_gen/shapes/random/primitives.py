"""Random solids in the cube of side 2 about the origin, for compositions.

Each function takes a generator, and whether the solid is to be fine enough to be displaced. LRM-Zero (Xie et al. 2024,
arXiv 2406.09371) composes cubes, balls, cylinders, cones and tori; lathes, lofts, sweeps and frames of bars are added.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np

from data_gen.shapes.choices import pick
from data_gen.shapes.profiles import ellipse, rectangle
from data_gen.shapes.random.hollow import arch, pipe, vessel, wire_cage
from data_gen.shapes.random.outlines import OUTLINE_CORNERS, blob, outline
from data_gen.shapes.random.relief import random_relief
from data_gen.shapes.random.tubes import bar, subdivided, tube
from data_gen.shapes.solids import Solid, merged

__all__ = ["BAR_PRIMITIVES", "PRIMITIVES", "Maker", "primitive"]

Maker = Callable[[np.random.Generator, bool], Solid]

_STATIONS = 9


def _upright(stations: int = _STATIONS) -> np.ndarray:
    """Points (k, 3) from y = -1 to y = 1."""
    return np.stack([np.zeros(stations), np.linspace(-1, 1, stations), np.zeros(stations)], axis=1)


def box(rng: np.random.Generator, fine: bool) -> Solid:
    """Cube, of many faces a side."""
    stations, inner = (7, 2) if fine else (2, 0)
    section = subdivided(rectangle(2.0, 2.0), OUTLINE_CORNERS if fine else 4)
    solid = tube(_upright(stations), np.tile(section, (stations, 1, 1)), inner=inner)
    return solid.repeated(int(rng.choice([1, 4]))).creased(40)


def cylinder(rng: np.random.Generator, fine: bool) -> Solid:
    """Cylinder, or a frustum of two radii."""
    stations, inner = (7, 2) if fine else (2, 0)
    radii = np.linspace(1.0, rng.uniform(0.4, 1.0) if rng.random() < 0.4 else 1.0, stations)
    return tube(_upright(stations), radii[:, None, None] * ellipse(1.0, 1.0, OUTLINE_CORNERS), inner=inner).creased(40)


def cone(rng: np.random.Generator, fine: bool) -> Solid:
    """Cone or pyramid with a tip."""
    sides = int(rng.choice([3, 4, 5, OUTLINE_CORNERS, OUTLINE_CORNERS]))
    stations, inner = (8, 2) if fine else (3, 0)
    radii = np.linspace(1.0, 0.0, stations)
    section = subdivided(ellipse(1.0, 1.0, sides), OUTLINE_CORNERS if fine else sides)
    return tube(_upright(stations), radii[:, None, None] * section, inner=inner).creased(
        50 if sides == OUTLINE_CORNERS else 30
    )


def ball(rng: np.random.Generator, fine: bool) -> Solid:
    """Ball; a part of one, cut flat; or a superellipsoid, between a ball and a cube."""
    start = rng.uniform(-0.6, 0.3) if rng.random() < 0.3 else -1.0
    angles = np.linspace(np.arcsin(start), np.pi / 2, 13)
    exponent = rng.uniform(0.35, 1.4) if rng.random() < 0.25 else 1.0
    radii = np.maximum(np.cos(angles), 0) ** exponent
    radii[-1] = 0
    if start == -1.0:
        radii[0] = 0
    spine = np.stack([np.zeros(13), np.sign(np.sin(angles)) * np.abs(np.sin(angles)) ** exponent, np.zeros(13)], axis=1)
    return tube(spine, radii[:, None, None] * ellipse(1.0, 1.0, OUTLINE_CORNERS)).creased(60)


def torus(rng: np.random.Generator, fine: bool) -> Solid:
    """Ring of a round, square or random section, flat in the plane of x and z."""
    angles = -np.arange(OUTLINE_CORNERS) * (2 * np.pi / OUTLINE_CORNERS)
    minor = rng.uniform(0.12, 0.45)
    section = minor * np.stack([np.cos(angles), np.sin(angles)], axis=1)[::-1][::2]
    crease = 60.0
    if rng.random() < 0.4:
        corners, crease = outline(rng)
        section = minor * corners[::2]
    circle = (1 - minor) * np.stack([np.cos(angles), 0 * angles, np.sin(angles)], axis=1)
    return tube(circle, np.tile(section, (OUTLINE_CORNERS, 1, 1)), closed=True).creased(crease)


def capsule(rng: np.random.Generator, fine: bool) -> Solid:
    """Cylinder with round ends."""
    angles = np.linspace(0, np.pi / 2, 6)
    radius = rng.uniform(0.3, 0.7)
    top = np.stack([np.cos(angles), np.sin(angles)], axis=1) * radius + (0, 1 - radius)
    profile = np.concatenate([(top * (1, -1))[::-1], top])
    profile[[0, -1], 0] = 0
    spine = np.stack([np.zeros(12), profile[:, 1], np.zeros(12)], axis=1)
    return tube(spine, profile[:, :1, None] * ellipse(1.0, 1.0, OUTLINE_CORNERS) / radius).creased(60)


def lathe(rng: np.random.Generator, fine: bool) -> Solid:
    """A random profile turned about the y axis: smooth as a vase, or in steps as a chess piece."""
    count = int(rng.integers(3, 7))
    radii = rng.uniform(0.15, 1.0, count)
    if rng.random() < 0.6:
        stations = np.linspace(-1, 1, 14)
        places = np.concatenate([[-1.0], np.sort(rng.uniform(-0.9, 0.9, count - 2)), [1.0]])
        profile = np.stack([_smooth(places, radii, stations), stations], axis=1)
    else:
        widths = rng.uniform(0.15, 1.0, count)
        edges = np.concatenate([[0.0], np.cumsum(widths)]) / widths.sum() * 2 - 1
        heights = np.stack([edges[:-1] + 0.005, edges[1:] - 0.005], axis=1).reshape(-1)
        profile = np.stack([np.repeat(radii, 2), heights], axis=1)
    if rng.random() < 0.3:
        profile[-1, 0] = 0
    spine = np.stack([np.zeros(len(profile)), profile[:, 1], np.zeros(len(profile))], axis=1)
    return tube(spine, profile[:, :1, None] * ellipse(1.0, 1.0, OUTLINE_CORNERS)).creased(40)


def loft(rng: np.random.Generator, fine: bool) -> Solid:
    """One outline that turns into another on the way up, swells, twists and leans."""
    first, crease = outline(rng)
    second = outline(rng)[0] if rng.random() < 0.5 else first
    share = np.linspace(0, 1, _STATIONS)
    scale = _smooth(np.linspace(0, 1, 3), rng.uniform(0.3, 1.0, 3), share)
    twist = (rng.uniform(-1.6, 1.6) if rng.random() < 0.35 else 0.0) * share
    turn = np.stack([np.cos(twist), -np.sin(twist), np.sin(twist), np.cos(twist)], axis=1).reshape(-1, 2, 2)
    blended = (1 - share)[:, None, None] * first + share[:, None, None] * second
    sections = scale[:, None, None] * (blended @ turn.transpose(0, 2, 1))
    spine = _upright()
    if rng.random() < 0.4:
        spine[:, [0, 2]] += rng.uniform(-0.5, 0.5, 2) * (share**2)[:, None]
    return tube(spine, sections).creased(crease)


def _smooth_curve(rng: np.random.Generator, knots: int) -> np.ndarray:
    """A random smooth curve (20, 3) that fills the cube of side 2."""
    walk = np.cumsum(rng.normal(size=(knots, 3)) * rng.uniform(0.2, 1.0, 3) + rng.normal(size=3) * 0.5, axis=0)
    from scipy.interpolate import CubicSpline

    curve = CubicSpline(np.arange(knots), walk)(np.linspace(0, knots - 1, 20))
    curve -= (curve.min(axis=0) + curve.max(axis=0)) / 2
    return curve / np.abs(curve).max()


def bent_tube(rng: np.random.Generator, fine: bool) -> Solid:
    """A tube, round or not, along a random smooth curve."""
    spine = 0.9 * _smooth_curve(rng, int(rng.integers(3, 6)))
    section, crease = (ellipse(1.0, 1.0, OUTLINE_CORNERS), 60.0) if rng.random() < 0.6 else outline(rng)
    widths = rng.uniform(0.05, 0.2) * _smooth(np.linspace(0, 1, 3), rng.uniform(0.6, 1.4, 3), np.linspace(0, 1, 20))
    if rng.random() < 0.2:
        widths[-1] = 0
    return tube(spine, widths[:, None, None] * section[::2]).creased(crease)


def spring(rng: np.random.Generator, fine: bool) -> Solid:
    """A helix of wire."""
    turns, radius = rng.uniform(1.5, 4.5), rng.uniform(0.05, 0.12)
    angles = np.linspace(0, 2 * np.pi * turns, int(14 * turns))
    spine = np.stack([0.85 * np.cos(angles), np.linspace(-0.9, 0.9, len(angles)), 0.85 * np.sin(angles)], axis=1)
    return tube(spine, np.tile(radius * ellipse(1.0, 1.0, 7), (len(angles), 1, 1)), inner=0).creased(60)


def pebble(rng: np.random.Generator, fine: bool) -> Solid:
    """A stone: a ball whose sections are random."""
    angles = np.linspace(-np.pi / 2, np.pi / 2, 11)
    sections = np.cos(angles)[:, None, None] * blob(rng)
    sections[[0, -1]] = 0
    spine = np.stack([np.zeros(11), np.sin(angles), np.zeros(11)], axis=1)
    return tube(spine, sections).creased(60)


def wire_box(rng: np.random.Generator, fine: bool) -> Solid:
    """The twelve edges of a cube as bars."""
    radius, sides = rng.uniform(0.04, 0.12), int(rng.choice([4, 6]))
    inside = 1 - radius
    bars = []
    for axis in range(3):
        for a in (-inside, inside):
            for b in (-inside, inside):
                start = np.insert([a, b], axis, -inside - 0.7 * radius)
                bars.append(bar(start, np.insert([a, b], axis, inside + 0.7 * radius), radius, sides))
    return merged(bars)


def grille(rng: np.random.Generator, fine: bool) -> Solid:
    """Parallel bars in a plane, crossed by others."""
    radius, sides = rng.uniform(0.025, 0.07), int(rng.choice([4, 6]))
    bars = []
    for axis, count in ((0, int(rng.integers(3, 8))), (1, int(rng.integers(0, 8)))):
        for place in np.linspace(-0.92, 0.92, count) if count > 1 else ():
            start = np.array([-1.0, place, 0.8 * radius * axis])
            end = np.array([1.0, place, 0.8 * radius * axis])
            bars.append(
                bar(
                    np.roll(start[:2], axis).tolist() + [start[2]],
                    np.roll(end[:2], axis).tolist() + [end[2]],
                    radius,
                    sides,
                )
            )
    return merged(bars)


def _smooth(places: np.ndarray, values: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Values interpolated without overshooting (Fritsch and Carlson 1980)."""
    from scipy.interpolate import PchipInterpolator

    return PchipInterpolator(places, values)(at)


PRIMITIVES: dict[Maker, float] = {
    box: 3.0,
    cylinder: 2.2,
    ball: 2.2,
    cone: 1.2,
    torus: 1.2,
    capsule: 0.7,
    lathe: 1.6,
    loft: 2.5,
    bent_tube: 1.2,
    pebble: 0.7,
    vessel: 1.2,
    pipe: 0.8,
    arch: 0.8,
    wire_box: 0.4,
    wire_cage: 0.3,
    grille: 0.4,
    spring: 0.25,
}
"""Relative frequencies."""


BAR_PRIMITIVES = (wire_box, wire_cage, grille, spring)
"""Primitives made of bars, too thin for displacement."""


def primitive(rng: np.random.Generator, relief: float, makers: Iterable[Maker] = PRIMITIVES) -> Solid:
    """A random primitive, its longest extent 2, about the origin.

    Args:
        rng: source of every choice.
        relief: probability of a height field.
        makers: the primitives to choose from; one that is not in `PRIMITIVES` is as frequent as 1.0 there.

    Returns:
        The solid.
    """
    maker = pick(rng, {maker: PRIMITIVES.get(maker, 1.0) for maker in makers})
    fine = maker not in BAR_PRIMITIVES and bool(rng.random() < relief)
    solid = maker(rng, fine)
    if fine:
        solid = random_relief(rng, solid)
    low, high = solid.vertices.min(axis=0), solid.vertices.max(axis=0)
    scale = 2 / (high - low).max()
    return solid.transformed(scale * np.eye(3), -scale * (low + high) / 2)
