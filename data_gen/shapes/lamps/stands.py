"""What lamps stand on: discs, blocks, tripods, turned and glazed bodies."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from data_gen.shapes.choices import one_of
from data_gen.shapes.materials import Colour, Material, brighten, plain, tint
from data_gen.shapes.parts import Part
from data_gen.shapes.patterns import print_of, wood
from data_gen.shapes.primitives import ball, box, cylinder, post, rod
from data_gen.shapes.solids import lathe

__all__ = ["sample_body_material", "sample_metal", "floor_stand", "foot", "table_body"]

_METALS: tuple[Colour, ...] = (
    (168, 128, 62),
    (58, 56, 58),
    (140, 144, 150),
    (142, 88, 58),
    (44, 46, 52),
    (112, 96, 72),
)
_WOODS: tuple[Colour, ...] = ((176, 122, 72), (130, 82, 48), (92, 58, 40), (200, 154, 100))


def sample_metal(rng: np.random.Generator) -> Material:
    """Brass, black iron, steel, copper or bronze."""
    return plain(one_of(rng, _METALS), "metal")


def sample_body_material(rng: np.random.Generator) -> Material:
    """Glazed or printed ceramic, or wood."""
    choice = rng.random()
    if choice < 0.25:
        return wood(rng, one_of(rng, _WOODS))
    colour = tint(rng, rng.random(), rng.uniform(0.4, 0.8), rng.uniform(0.4, 0.75))
    if choice < 0.6:
        return plain(colour, "glaze")
    return print_of(rng, colour, (228, 214, 184) if rng.random() < 0.6 else brighten(colour, 0.5))


def foot(rng: np.random.Generator, radius: float, metal: Material) -> list[Part]:
    """A flat foot on y = 0 whose middle is at least 0.03 high: disc, dome, steps or a square slab."""
    choice = int(rng.integers(4))
    if choice == 0:
        solid = lathe([(radius, 0), (radius, 0.018), (0.9 * radius, 0.03), (0.15 * radius, 0.04)], 24)
    elif choice == 1:
        angles = np.linspace(0, 0.5 * np.pi, 6)[:-1]
        profile = np.stack([radius * np.cos(angles), 0.01 + 0.45 * radius * np.sin(angles)], 1)
        solid = lathe([(radius, 0), *profile, (0.1 * radius, 0.01 + 0.45 * radius)], 24)
    elif choice == 2:
        radii, levels = radius * np.array([1, 1, 0.72, 0.72, 0.42, 0.4]), (0, 0.02, 0.024, 0.046, 0.05, 0.075)
        solid = lathe(np.stack([radii, levels], 1), 24)
    else:
        solid = box(1.7 * radius, 0.04, 1.7 * radius, 0.02, 2).moved(0, 0.02)
    return [Part.of("foot", solid.creased(30), metal)]


def _vase(rng: np.random.Generator, height: float, radius: float) -> np.ndarray:
    """Profile of a smooth pot: a few random radii, interpolated by a cosine ramp."""
    count = int(rng.integers(3, 6))
    radii = np.concatenate([[rng.uniform(0.45, 0.75)], rng.uniform(0.4, 1.0, count), [rng.uniform(0.16, 0.3)]])
    radii = radii / radii.max() * radius
    at = np.linspace(0, count + 1, 15)
    i = np.minimum(at.astype(int), count)
    f = (1 - np.cos(np.pi * (at - i))) / 2
    return np.stack([radii[i] * (1 - f) + radii[i + 1] * f, at / (count + 1) * height], 1)


def table_body(rng: np.random.Generator, height: float, radius: float, metal: Material) -> list[Part]:
    """The body of a table lamp, from y = 0 to a neck at `height`.

    Args:
        rng: source of the choices.
        height: metres.
        radius: largest radius in metres.
        metal: material of fittings.

    Returns:
        The parts; the topmost reaches at least to `height` on the axis.
    """
    material = sample_body_material(rng)
    choice = rng.random()
    if choice < 0.4:
        body = lathe(_vase(rng, height, radius), 20).repeated(2).creased(50)
        if rng.random() < 0.5:
            plinth = cylinder(0.8 * radius, 0.03, 20).moved(0, 0.013)
            return [Part.of("plinth", plinth, metal), Part.of("body", body.moved(0, 0.02), material)]
        return [Part.of("body", body, material)]
    if choice < 0.55:  # balls on one another
        count = int(rng.integers(2, 5))
        size = height / (2 * 0.92 * count)
        balls = [ball(size, size, size, 16, 10).moved(0, 0.02 + size * (0.94 + 1.84 * k)) for k in range(count)]
        parts = [Part.of(f"ball_{k}", solid, material if k % 2 == 0 else metal) for k, solid in enumerate(balls)]
        return [*foot(rng, max(0.75 * radius, 0.9 * size), metal), *parts]
    if choice < 0.7:  # a block
        side = radius * rng.uniform(1.0, 1.5)
        block = box(side, height, side * rng.uniform(0.6, 1.0), 0.012).projected("z").moved(0, height / 2)
        return [Part.of("body", block, material)]
    if choice < 0.82:  # three legs
        return _tripod(rng, height, 1.1 * radius, metal if rng.random() < 0.4 else material, metal)
    segments = int(rng.choice([4, 6, 8, 20]))  # an hourglass or a faceted column
    waist = rng.uniform(0.3, 0.8)
    profile = [(0.8 * radius, 0), (0.8 * radius, 0.03), (0.8 * waist * radius, 0.5 * height), (0.6 * radius, height)]
    return [Part.of("body", lathe(profile, segments).repeated(2).creased(25), material)]


def _tripod(rng: np.random.Generator, height: float, radius: float, material: Material, metal: Material) -> list[Part]:
    """Three legs that meet under a hub at `height`."""
    thick = 0.018 + 0.012 * height
    parts = []
    start = rng.uniform(0, 120)
    for k in range(3):
        angle = np.radians(start + 120 * k)
        x, z = float(np.sin(angle)), float(np.cos(angle))
        leg = post((radius * x, 0, radius * z), (0.02 * x, height, 0.02 * z), 0.7 * thick, thick, 6)
        parts.append(Part.of(f"leg_{k}", leg, material))
        if height > 0.8:
            tip, y = radius * (1 - 0.45) + 0.02 * 0.45, 0.45 * height
            parts.append(Part.of(f"brace_{k}", rod((0, y, 0), (tip * x, y, tip * z), 0.012), metal))
    return [*parts, Part.of("hub", cylinder(0.022 + 0.7 * thick, 0.07, 12).moved(0, height - 0.01), metal)]


def _pole(rng: np.random.Generator, height: float, metal: Material) -> list[Part]:
    """A foot and a pole with a knob or two."""
    radius = rng.uniform(0.016, 0.026)
    parts = foot(rng, rng.uniform(0.15, 0.2), metal)
    parts.append(Part.of("pole", cylinder(radius, height - 0.01, 10).moved(0, height / 2 + 0.005), metal))
    for k in range(int(rng.integers(0, 3))):
        knob = ball(2.1 * radius, 2.1 * radius, 2.1 * radius, 12, 8).moved(0, rng.uniform(0.2, 0.75) * height)
        parts.append(Part.of(f"knob_{k}", knob, metal))
    return parts


def _turned_pole(rng: np.random.Generator, height: float) -> list[Part]:
    """A wooden column turned on a lathe."""
    timber = wood(rng, one_of(rng, _WOODS))
    count = int(rng.integers(9, 15))
    radii = np.concatenate([[0.05], rng.uniform(0.018, 0.045, count), [0.02]])
    profile = np.stack([radii, np.linspace(0.02, height, count + 2)], 1)
    column = Part.of("pole", lathe(profile, 12).creased(50), timber)
    return [*foot(rng, rng.uniform(0.15, 0.19), timber), column]


def floor_stand(rng: np.random.Generator, height: float, metal: Material) -> list[Part]:
    """The stand of a floor lamp, from y = 0 to `height` on the axis, in metres."""
    makers: tuple[Callable[[], list[Part]], ...] = (
        lambda: _pole(rng, height, metal),
        lambda: _turned_pole(rng, height),
        lambda: _tripod(rng, height, rng.uniform(0.26, 0.36), sample_body_material(rng), metal),
    )
    return makers[int(rng.choice(3, p=[0.45, 0.2, 0.35]))]()
