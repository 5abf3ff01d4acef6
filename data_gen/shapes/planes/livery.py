"""What planes are painted with: liveries seen from the side, tails, wings with their flaps, camouflage."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from data_gen.shapes.materials import Colour, Material, brighten, canvas, pixel_centres, plain, tint

__all__ = ["Livery", "camouflage", "sample_livery", "fuselage_side", "tail_sign", "wing_skin"]

_WIDE, _HIGH, _TALL = 224, 56, 96
_GLASS: Colour = (42, 50, 64)


@dataclass(frozen=True)
class Livery:
    """Colours of a plane: of most of it, of its decoration, and of bare metal."""

    base: Colour
    accent: Colour
    metal: Material


def sample_livery(rng: np.random.Generator) -> Livery:
    """Two colours that differ clearly, few of them pale."""
    hue = rng.random()
    choice = rng.random()
    if choice < 0.2:
        level = int(rng.integers(140, 190))
        base: Colour = (level - 6, level, min(255, level + 8))
        accent = tint(rng, hue, 0.8, 0.62, 0.08)
    elif choice < 0.7:
        base = tint(rng, hue, rng.uniform(0.5, 0.75), rng.uniform(0.5, 0.75), 0.04)
        accent = (222, 198, 142) if rng.random() < 0.5 else tint(rng, hue + rng.uniform(0.3, 0.6), 0.8, 0.45, 0.05)
    else:
        base = tint(rng, hue, 0.3, 0.72, 0.05)
        accent = tint(rng, hue + rng.uniform(-0.05, 0.05), 0.85, 0.38, 0.05)
    return Livery(base, accent, plain((128, 132, 140), "metal"))


def fuselage_side(
    rng: np.random.Generator, livery: Livery, windows: tuple[float, float] | None, cockpit: bool
) -> Material:
    """Side view of a fuselage, tail at u = 0: decoration, a row of windows, doors, cockpit glass.

    Args:
        rng: source of the choices.
        livery: colours.
        windows: where the row begins and ends, as shares of the length from the tail; none if absent.
        cockpit: whether the windscreen is painted on.

    Returns:
        The material, for coordinates projected along x.
    """
    u, v = pixel_centres(_HIGH, _WIDE)
    image = canvas(livery.base, _HIGH, _WIDE)
    style = int(rng.integers(6))
    low = rng.uniform(0.3, 0.42)
    if style == 0:
        image[np.abs(v - 0.57) < 0.09] = livery.accent
    elif style == 1:
        image[v < low] = livery.accent
    elif style == 2:
        image[u < 0.3 - 0.22 * (v - 0.5)] = livery.accent
    elif style == 3:
        image[v < low + 0.5 * np.maximum(0, 0.35 - u) ** 0.8] = livery.accent
        image[np.abs(v - low - 0.06 - 0.5 * np.maximum(0, 0.35 - u) ** 0.8) < 0.025] = brighten(livery.accent, 0.6)
    elif style == 4:
        for start in (0.2, 0.29, 0.38):
            image[np.abs(u - start + 0.25 * (v - 0.5)) < 0.03] = livery.accent
        image[u > 0.9] = livery.accent
    else:
        image[(v < 0.45) & (v > 0.36)] = livery.accent
        image[(v < 0.31) & (v > 0.27)] = brighten(livery.accent, 0.6)
    if windows is not None:
        start, end = windows
        count = int(rng.integers(16, 30))
        place = (u - start) / (end - start) * count
        row = (place > 0) & (place < count) & (np.abs(place % 1 - 0.5) < 0.3)
        image[row & (np.abs(v - 0.6) < 0.055)] = _GLASS
        for door in (start - 0.025, end + 0.02, (start + end) / 2):
            edge = (np.abs(u - door) < 0.013) & (v > 0.4) & (v < 0.74)
            image[edge] = brighten(livery.base, 0.72)
    if cockpit:
        image[(np.abs(u - 0.952) < 0.022) & (v > 0.6) & (v < 0.74) & (np.abs(u - 0.951) > 0.003)] = _GLASS
    return Material("fuselage", image)


def tail_sign(rng: np.random.Generator, livery: Livery) -> Material:
    """A fin's two sides: bands, a disc, a chevron or rays, for coordinates projected along x."""
    u, v = pixel_centres(_TALL, _TALL)
    first, second = (livery.accent, livery.base) if rng.random() < 0.7 else (livery.base, livery.accent)
    image = canvas(first, _TALL, _TALL)
    style = int(rng.integers(5))
    if style == 0:
        image[(np.floor((v + 0.4 * u) * rng.uniform(4, 7)) % 2) == 0] = second
    elif style == 1:
        image[np.hypot(u - 0.42, v - 0.55) < 0.2] = second
        image[np.hypot(u - 0.42, v - 0.55) < 0.1] = brighten(first, 0.6)
    elif style == 2:
        image[np.abs(v - 0.3 - 0.6 * np.abs(u - 0.45)) < 0.08] = second
        image[np.abs(v - 0.55 - 0.6 * np.abs(u - 0.45)) < 0.05] = second
    elif style == 3:
        image[v > rng.uniform(0.55, 0.75)] = second
    else:
        image[(np.floor(np.arctan2(v + 0.2, u + 0.3) * 9) % 2) == 0] = second
    return Material("fin", image)


def wing_skin(rng: np.random.Generator, colour: Colour, accent: Colour) -> Material:
    """A wing unrolled: trailing edge at u = 0 and 1, root at v = 0; flaps, panel lines, a coloured tip."""
    u, v = pixel_centres(_TALL, _TALL)
    image = canvas(colour, _TALL, _TALL)
    image[np.abs(u - 0.5) < 0.07] = brighten(colour, 1.12)
    edge = np.minimum(u, 1 - u)
    for low, high in ((0.06, 0.44), (0.47, 0.66), (0.69, 0.92)):
        inside = (edge < 0.13) & (v > low) & (v < high)
        image[inside] = brighten(colour, rng.uniform(0.78, 0.92))
    image[(np.abs(edge - 0.135) < 0.01) & (v < 0.92)] = brighten(colour, 0.55)
    if rng.random() < 0.6:
        image[v > rng.uniform(0.82, 0.93)] = accent
    return Material("wing", image)


def camouflage(rng: np.random.Generator, dark: Colour, light: Colour) -> Material:
    """Two or three colours in blotches."""
    lattice = rng.random((9, 9))
    at = np.linspace(0, 7.999, _TALL)
    i, f = at.astype(int), at % 1
    f = f * f * (3 - 2 * f)
    rows = lattice[i] * (1 - f)[:, None] + lattice[i + 1] * f[:, None]
    field = rows[:, i] * (1 - f) + rows[:, i + 1] * f
    image = canvas(light, _TALL, _TALL)
    image[field > 0.48] = dark
    if rng.random() < 0.5:
        image[field < 0.3] = brighten(dark, 0.6)
    return Material("camouflage", image)
