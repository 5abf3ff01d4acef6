"""Lampshades: thin-walled shells of revolution with what holds them and the bulb inside."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from data_gen.shapes.choices import one_of
from data_gen.shapes.materials import Colour, Material, brighten, plain, tint
from data_gen.shapes.parts import Part
from data_gen.shapes.patterns import print_of, weave
from data_gen.shapes.primitives import ball, cylinder, rod
from data_gen.shapes.solids import Solid, lathe

__all__ = ["BULB", "Shade", "sample_cloth", "sample_shade", "shell"]

BULB = plain((250, 226, 150), "bulb")
"""Material of bulbs and flames."""

_WALL = 0.012
_LINING = plain((238, 214, 158), "lining")

_OUTLINES: dict[str, tuple[tuple[float, float], ...]] = {
    "drum": ((1.0, 0.0), (1.0, 1.0)),
    "slanted": ((1.0, 0.0), (0.8, 1.0)),
    "empire": ((1.0, 0.0), (0.56, 1.0)),
    "coolie": ((1.0, 0.0), (0.26, 1.0)),
    "bell": ((1.0, 0.0), (0.86, 0.12), (0.7, 0.34), (0.56, 0.62), (0.48, 1.0)),
    "dome": ((1.0, 0.0), (0.98, 0.2), (0.9, 0.45), (0.72, 0.7), (0.45, 0.9), (0.2, 1.0)),
    "tulip": ((0.72, 0.0), (0.92, 0.25), (1.0, 0.55), (0.9, 1.0)),
    "barrel": ((0.7, 0.0), (0.94, 0.25), (1.0, 0.5), (0.94, 0.75), (0.7, 1.0)),
    "inverted": ((0.6, 0.0), (1.0, 1.0)),
    "stepped": ((1.0, 0.0), (0.98, 0.4), (0.72, 0.44), (0.7, 0.76), (0.42, 0.8), (0.4, 1.0)),
}
"""Outlines of the outer side, from the rim upwards: (share of the radius, share of the height)."""


@dataclass(frozen=True)
class Shade:
    """What a shade is like, in metres.

    Attributes:
        shape: key of the outline.
        radius: largest radius.
        height: extent along its axis.
        segments: sides; 4 or 6 for angular ones.
        cloth: material of the outer side.
        trim: material of the rims; none if absent.
    """

    shape: str
    radius: float
    height: float
    segments: int
    cloth: Material
    trim: Material | None

    def radius_at(self, share: float) -> float:
        """Outer radius at a share of the height."""
        radii, levels = zip(*_OUTLINES[self.shape], strict=True)
        return float(np.interp(share, levels, radii)) * self.radius


def sample_cloth(rng: np.random.Generator) -> Material:
    """Cloth, paper or glass of a shade: warm or colourful, plain or printed."""
    hues = (0.1, 0.12, 0.08, 0.02, 0.97, 0.33, 0.48, 0.57, 0.63, 0.78, 0.14)
    hue = one_of(rng, hues)
    colour = tint(rng, hue, rng.uniform(0.3, 0.75), rng.uniform(0.65, 0.92), 0.05)
    choice = rng.random()
    if choice < 0.35:
        return plain(colour, "cloth")
    if choice < 0.55:
        return weave(rng, colour)
    other: Colour = (240, 222, 176) if rng.random() < 0.6 else brighten(colour, 0.5)
    return print_of(rng, colour, other)


def sample_shade(rng: np.random.Generator, radius: float, height: float, shapes: tuple[str, ...]) -> Shade:
    """Draw a shade of about the given size among the named shapes."""
    shape = one_of(rng, shapes)
    angular = shape in ("drum", "slanted", "empire", "inverted") and rng.random() < 0.25
    segments = int(rng.choice([4, 6])) if angular else 24
    cloth = sample_cloth(rng)
    trim = plain(tint(rng, rng.random(), 0.6, 0.4), "trim") if rng.random() < 0.4 else None
    grow = rng.uniform(0.88, 1.12, 2)
    radius = radius * float(grow[0]) * (1.15 if segments == 4 else 1)
    return Shade(shape, radius, height * float(grow[1]), segments, cloth, trim)


def _hull(style: Shade) -> tuple[Solid, int]:
    """The double-walled shell standing on y = 0, and the number of steps on its outer side."""
    outer = np.array(_OUTLINES[style.shape]) * (style.radius, style.height)
    if style.trim is not None:  # a band at either rim
        band = 0.07
        low, high = style.radius_at(band), style.radius_at(1 - band)
        inner_points = [p for p in outer[1:-1] if band * 1.2 < p[1] / style.height < 1 - band * 1.2]
        bands = [(low, band * style.height), *inner_points, (high, (1 - band) * style.height)]
        outer = np.array([outer[0], *bands, outer[-1]])
    inner = outer[::-1] - (_WALL, 0)
    solid = lathe(np.concatenate([outer, inner]), style.segments, ring=True)
    steps = len(outer) - 1
    uv = solid.uv.copy()
    uv[..., 1] = np.clip(uv[..., 1] * 2 * len(outer) / steps, 0, 1)
    return replace(solid, uv=uv).repeated(3 if style.segments % 3 == 0 else 4).creased(45), steps


def shell(style: Shade, name: str, metal: Material, bulb: bool = True) -> list[Part]:
    """A shade whose rim is on y = 0 around the y axis, its spokes and bulb.

    Args:
        style: what it is like.
        name: prefix of the parts' names.
        metal: material of the fittings.
        bulb: whether a bulb hangs in it.

    Returns:
        The parts. A hub on the axis reaches from 0.6 to 0.86 of the height; whatever carries the shade joins it there.
    """
    solid, steps = _hull(style)
    along = solid.cells[:, 0]
    part = Part.of(f"{name}_shade", solid, style.cloth).painted(along >= steps, _LINING)
    if style.trim is not None:
        part = part.painted((along == 0) | (along == steps - 1), style.trim)
    parts = [part]
    high, count = 0.78 * style.height, 4 if style.segments == 4 else 3
    reach = style.radius_at(0.78) - 0.5 * _WALL
    for k in range(count):
        angle = 2 * np.pi * k / count
        tip = (reach * float(np.sin(angle)), high, reach * float(np.cos(angle)))
        parts.append(Part.of(f"{name}_spoke_{k}", rod((0, high, 0), tip, 0.008), metal))
    hub = cylinder(0.018, 0.26 * style.height, 10).moved(0, 0.73 * style.height)
    parts.append(Part.of(f"{name}_hub", hub, metal))
    if bulb:
        size = min(0.045, 0.32 * style.radius, 0.25 * style.height)
        glass = ball(size, 1.3 * size, size, 10, 8).moved(0, 0.62 * style.height - 1.1 * size)
        parts.append(Part.of(f"{name}_bulb", glass, BULB))
    return parts
