"""Building blocks of planes: fuselages, wings, fins, engines, propellers, undercarriages.

Metres, y up, nose along +z, the fuselage's axis on x = y = 0 unless moved.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from data_gen.shapes.materials import Material, plain
from data_gen.shapes.parts import Part
from data_gen.shapes.primitives import ball, cylinder, rod
from data_gen.shapes.profiles import airfoil, rectangle, superellipse
from data_gen.shapes.solids import Solid, lathe, loft

__all__ = ["propeller", "fin", "fuselage", "jet_engine", "pylon", "undercarriage", "wing"]

_BLACK = plain((36, 36, 40), "black")


def fuselage(
    length: float,
    width: float,
    height: float,
    shape: Sequence[tuple[float, float, float, float]],
    boxiness: float = 2.0,
    sides: int = 18,
) -> Solid:
    """Body of changing section.

    Args:
        length: from tail to nose; the middle lies at z = 0.
        width: largest extent along x.
        height: largest extent along y.
        shape: rows (share of the length from the tail, share of the width, share of the height, rise of the section's
            middle as a share of the height).
        boxiness: exponent of the section's superellipse; 2 for an ellipse.
        sides: corners of a section.

    Returns:
        The solid, with texture coordinates projected along x.
    """
    outlines = [
        superellipse(max(wide, 0.02) * width, max(high, 0.02) * height, boxiness, sides) + (0, rise * height)
        for _, wide, high, rise in shape
    ]
    stations = [(share - 0.5) * length for share, *_ in shape]
    return loft(outlines, stations).projected("x").creased(50)


def wing(
    root: float,
    tip: float,
    span: float,
    sweep: float,
    rise: float,
    thickness: float = 0.11,
    inside: float = 0.0,
    kink: tuple[float, float] | None = None,
) -> Solid:
    """The left half of a wing or tailplane, its root's leading edge at z = 0.

    Args:
        root: chord at the root.
        tip: chord at the tip.
        span: extent along x of this half, from `inside`.
        sweep: how far the tip's leading edge lies behind the root's.
        rise: how far the tip lies over the root.
        thickness: share of the chord.
        inside: x at which it begins, inside the fuselage.
        kink: share of the span and chord there where the trailing edge bends; none if absent.

    Returns:
        The solid; texture v runs from root to tip, u around the section from the trailing edge.
    """
    stops = [(0.0, root)] + ([kink] if kink else [(0.5, (root + tip) / 2)]) + [(0.96, 0.04 * root + 0.96 * tip)]
    if kink:
        stops[-1] = (0.96, tip + (kink[1] - tip) * 0.04 / (1 - kink[0]))
    outlines, stations = [], []
    for share, chord in [*stops, (1.0, 0.72 * stops[-1][1])]:
        section = airfoil(chord, thickness * chord * (1 if share < 1 else 0.5), 5)[::-1]
        outlines.append(np.stack([section[:, 1] + rise * share, section[:, 0] - chord - sweep * share], 1))
        stations.append(inside + span * share)
    return loft(outlines, stations, "x").creased(55)


def fin(root: float, tip: float, height: float, sweep: float, thickness: float = 0.1) -> Solid:
    """Upright tail fin standing on y = 0, its root's leading edge at z = 0, texture coordinates projected along x."""
    outlines, stations = [], []
    for share, chord in ((0.0, root), (0.5, (root + tip) / 2), (0.97, 0.03 * root + 0.97 * tip), (1.0, 0.8 * tip)):
        section = airfoil(chord, thickness * chord * (1 if share < 1 else 0.6), 5)
        outlines.append(section - (chord + sweep * share, 0))
        stations.append(height * share)
    return loft(outlines, stations, "y").projected("x").creased(55)


def jet_engine(name: str, radius: float, length: float, at: tuple[float, float, float], cowl: Material) -> list[Part]:
    """A nacelle with an open intake and a core, its middle at a point, facing +z."""
    r, h = radius, length / 2
    shell = np.array([(0.62, -1), (0.9, -0.2), (1, 0.5), (0.95, 1), (0.86, 0.94), (0.6, -0.5)]) * (r, h)
    outlet = np.array([(0.42, -1.35), (0.56, -0.9), (0.8, 0.2), (0.86, 0.66), (0.2, 0.72)]) * (r, h)
    spinner = np.array([(0.24, 0.6), (0.14, 0.82), (0, 0.9)]) * (r, h)
    parts = [
        (f"{name}_cowl", lathe(shell, 16, ring=True).creased(50), cowl),
        (f"{name}_core", lathe(outlet, 14).creased(50), plain((58, 60, 66), "core")),
        (f"{name}_spinner", lathe(spinner, 10), plain((120, 122, 128), "spinner")),
    ]
    return [Part.of(part, solid.turned("x", 90).moved(*at), material) for part, solid, material in parts]


def propeller(
    name: str, radius: float, blades: int, at: tuple[float, float, float], turn: float, spinner: Material
) -> list[Part]:
    """A propeller with its spinner, facing +z.

    Args:
        name: prefix of the parts' names.
        radius: of the circle that the tips describe.
        blades: how many.
        at: centre of the hub.
        turn: degrees by which the first blade stands off the upright.
        spinner: material of the hub.

    Returns:
        The parts.
    """
    hub = lathe(np.array([(0.16, -0.12), (0.15, 0.08), (0.09, 0.24), (0, 0.32)]) * radius, 12)
    parts = [Part.of(f"{name}_spinner", hub.creased(50).turned("x", 90).moved(*at), spinner)]
    tipped = plain((214, 168, 40), "blade_tip")
    outline = np.array([(-0.02, -0.035), (0.02, -0.055), (0.02, 0.035), (-0.02, 0.055)]) * radius
    outlines = [outline * size for size in (0.8, 1.2, 1.0, 0.6)]
    for k in range(blades):
        blade = loft(outlines, radius * np.array([0.02, 0.5, 0.86, 1.0]), "y").creased(40)
        part = Part.of(f"{name}_blade_{k}", blade.turned("z", turn + 360 * k / blades).moved(*at), _BLACK)
        parts.append(part.painted(blade.cells[:, 0] == 2, tipped).capped(tipped, first=False))
    return parts


def undercarriage(
    name: str, top: tuple[float, float, float], foot: tuple[float, float, float], radius: float, spat: Material | None
) -> list[Part]:
    """A leg with a wheel at its foot, in a streamlined fairing if a material is given for one."""
    x, y, z = foot
    leg = rod(top, foot, 0.4 * radius, 0.22 * radius)
    wheel = lathe(np.array([(0.75, -0.18), (1, -0.1), (1, 0.1), (0.75, 0.18)]) * radius, 14)
    disc = cylinder(0.5 * radius, 0.44 * radius, 10)
    parts = [
        Part.of(f"{name}_leg", leg, plain((120, 124, 130), "strut")),
        Part.of(f"{name}_wheel", wheel.turned("z", 90).moved(x, y, z), _BLACK),
        Part.of(f"{name}_disc", disc.turned("z", 90).moved(x, y, z), plain((150, 152, 158), "disc")),
    ]
    if spat is not None:
        cover = ball(0.34 * radius, 0.75 * radius, 1.7 * radius, 10, 8).moved(x, y + 0.35 * radius, z - 0.2 * radius)
        parts.append(Part.of(f"{name}_spat", cover, spat))
    return parts


def pylon(bottom: tuple[float, float, float], top: tuple[float, float, float], width: float, chord: float) -> Solid:
    """Upright blade between an engine or a store and the wing above it, `chord` long."""
    outlines = [rectangle(chord, width) + (z, x) for x, _, z in (bottom, top)]
    return loft(outlines, [bottom[1], top[1]], "y").creased(20)
