"""Lamps: table, floor, arc, desk and hanging ones, and chandeliers.

Metres, y up, front along +z. Standing lamps stand on y = 0; hanging ones hang from a ceiling plate at the top.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from data_gen.shapes.choices import pick
from data_gen.shapes.lamps.shades import BULB, Shade, sample_cloth, sample_shade, shell
from data_gen.shapes.lamps.stands import floor_stand, foot, sample_metal, table_body
from data_gen.shapes.materials import Material, plain, tint
from data_gen.shapes.parts import Part
from data_gen.shapes.primitives import ball, cone, cylinder, rod, tube
from data_gen.shapes.solids import lathe

__all__ = ["lamp"]

_CLOTH = ("drum", "slanted", "empire", "coolie", "bell", "barrel", "inverted", "stepped")
_HARD = ("dome", "coolie", "bell", "tulip", "empire", "stepped")


def _moved(parts: Sequence[Part], x: float, y: float, z: float) -> list[Part]:
    """The parts shifted."""
    return [replace(part, solid=part.solid.moved(x, y, z)) for part in parts]


def _turned(parts: Sequence[Part], axis: str, degrees: float) -> list[Part]:
    """The parts turned about an axis through the origin."""
    return [replace(part, solid=part.solid.turned(axis, degrees)) for part in parts]


def _on_top(style: Shade, height: float, metal: Material) -> list[Part]:
    """A shade carried by a stem that ends at `height`: the neck, the shade, a finial."""
    rim = height + 0.02 - 0.12 * style.height
    top = rim + 0.86 * style.height
    neck = cylinder(0.011, top - height + 0.055, 8).moved(0, (top + height) / 2 - 0.0225)
    finial = ball(0.017, 0.024, 0.017, 10, 6).moved(0, top + 0.012)
    return [
        Part.of("neck", neck, metal),
        *_moved(shell(style, "main", metal), 0, rim, 0),
        Part.of("finial", finial, metal),
    ]


def _table(rng: np.random.Generator) -> list[Part]:
    """A ceramic, wooden or metal body under a shade."""
    metal = sample_metal(rng)
    height = rng.uniform(0.2, 0.36)
    radius = rng.uniform(0.07, 0.13)
    style = sample_shade(rng, rng.uniform(0.14, 0.2), rng.uniform(0.16, 0.25), _CLOTH)
    if rng.random() < 0.08:  # a globe straight on a foot
        size = rng.uniform(0.11, 0.15)
        globe = ball(size, size, size, 20, 12).moved(0, 0.05 + 0.93 * size)
        collar = cylinder(0.5 * size, 0.07, 16).moved(0, 0.05)
        return [
            *foot(rng, 0.75 * size, metal),
            Part.of("collar", collar, metal),
            Part.of("globe", globe, sample_cloth(rng)),
        ]
    return [*table_body(rng, height, radius, metal), *_on_top(style, height, metal)]


def _floor(rng: np.random.Generator) -> list[Part]:
    """A tall stand under a shade."""
    metal = sample_metal(rng)
    height = rng.uniform(0.95, 1.3)
    style = sample_shade(rng, rng.uniform(0.2, 0.27), rng.uniform(0.24, 0.36), _CLOTH)
    return [*floor_stand(rng, height, metal), *_on_top(style, height, metal)]


def _arc(rng: np.random.Generator) -> list[Part]:
    """A heavy foot, a wide bow, and a shade that hangs from its end over the front."""
    metal = sample_metal(rng)
    reach, height = rng.uniform(0.65, 0.9), rng.uniform(1.25, 1.5)
    angles = np.linspace(0, 0.97 * np.pi, 13)
    straight = rng.uniform(0.35, 0.55) * height
    z = 0.5 * reach * (1 - np.cos(angles)) - 0.5 * reach
    y = straight + (height - straight) * np.sin(angles)
    path = [(0.0, 0.01, -0.5 * reach), *zip(np.zeros(13), y, z, strict=True)]
    bow = tube(path, 0.032, sides=8)
    end_y, end_z = float(y[-1]), float(z[-1])
    style = sample_shade(rng, rng.uniform(0.18, 0.25), rng.uniform(0.16, 0.24), _HARD)
    rim = end_y - 0.8 * style.height
    stand = _moved(foot(rng, rng.uniform(0.16, 0.21), metal), 0, 0, -0.5 * reach)
    return [*stand, Part.of("bow", bow, metal), *_moved(shell(style, "main", metal), 0, rim, end_z)]


def _desk(rng: np.random.Generator) -> list[Part]:
    """Two jointed arms and a turnable metal head."""
    colour = plain(tint(rng, rng.random(), rng.uniform(0.5, 0.9), rng.uniform(0.4, 0.8)), "paint")
    metal = colour if rng.random() < 0.5 else sample_metal(rng)
    radius, high = rng.uniform(0.085, 0.115), rng.uniform(0.12, 0.16)
    style = sample_shade(rng, radius, high, ("dome", "coolie", "bell", "empire", "tulip"))
    style = replace(style, cloth=colour, trim=None, segments=24)
    lower, upper = rng.uniform(0.22, 0.3), rng.uniform(0.2, 0.28)
    lean, forward = np.radians(rng.uniform(8, 32)), np.radians(rng.uniform(25, 60))
    hip = np.array([0, 0.05, -0.06])
    knee = hip + lower * np.array([0, np.cos(lean), -np.sin(lean)])
    wrist = knee + upper * np.array([0, np.sin(forward), np.cos(forward)])
    parts = [*_moved(foot(rng, rng.uniform(0.095, 0.125), colour), 0, 0, -0.06)]
    parts.append(Part.of("socket", cylinder(0.022, 0.06, 12).moved(0, 0.035, -0.06), metal))
    twin = rng.random() < 0.5
    for name, start, end in (("lower", hip, knee), ("upper", knee, wrist)):
        for k, x in enumerate((-0.014, 0.014) if twin else (0.0,)):
            side = np.array([x, 0, 0])
            parts.append(Part.of(f"{name}_arm_{k}", rod(start + side, end + side, 0.013 if twin else 0.018), metal))
    for name, at in (("hip", hip), ("knee", knee), ("wrist", wrist)):
        joint = cylinder(0.022, 0.046, 12).turned("z", 90).moved(*at)
        parts.append(Part.of(name, joint, plain((48, 48, 52), "joint")))
    tilt = -rng.uniform(15, 45)
    head = _moved(shell(style, "head", metal), 0, -0.82 * style.height, 0)
    cap = cylinder(0.026, 0.05, 12).moved(0, 0.16 * style.height)
    cover = lathe([(style.radius_at(1.0) - 0.006, 0.12 * style.height), (0.02, 0.24 * style.height)], 24)
    head += [Part.of("head_cap", cap, colour), Part.of("head_cover", cover, colour)]
    return parts + _moved(_turned(head, "x", tilt), 0, wrist[1], wrist[2])


def _ceiling(top: float, metal: Material) -> list[Part]:
    """The plate on the ceiling."""
    return [Part.of("ceiling_plate", cone(0.035, 0.06, 0.04, 16).moved(0, top), metal)]


def _pendant(rng: np.random.Generator) -> list[Part]:
    """One shade on a cord, or a paper lantern, or a glass globe."""
    metal = sample_metal(rng)
    drop = rng.uniform(0.2, 0.5)
    if rng.random() < 0.3:
        size = rng.uniform(0.15, 0.21)
        flat = rng.uniform(0.75, 1.1)
        globe = Part.of("lantern", ball(size, size * flat, size, 20, 14), sample_cloth(rng))
        top = size * flat
        collar = cylinder(0.05, 0.04, 14)
        parts = [globe, Part.of("collar", collar.moved(0, 0.985 * top), metal)]
    else:
        style = sample_shade(rng, rng.uniform(0.16, 0.24), rng.uniform(0.15, 0.26), (*_HARD, "drum", "barrel"))
        parts, top = shell(style, "main", metal), 0.8 * style.height
        if style.shape in ("dome", "coolie"):
            cover = lathe([(style.radius_at(1.0) - 0.004, 0.985 * style.height), (0.02, 1.12 * style.height)], 24)
            parts.append(Part.of("cover", cover, metal))
            collar = cylinder(0.019, 0.3 * style.height, 10).moved(0, 0.95 * style.height)
            parts.append(Part.of("collar", collar, metal))
    cord = cylinder(0.009, drop + 0.1, 8).moved(0, top + drop / 2 - 0.05)
    return [*parts, Part.of("cord", cord, plain((46, 44, 44), "cord")), *_ceiling(top + drop, metal)]


def _chandelier(rng: np.random.Generator) -> list[Part]:
    """A turned column with curved arms that carry candles or small shades."""
    metal = sample_metal(rng)
    count = int(rng.integers(4, 9))
    reach, rise, drop = rng.uniform(0.26, 0.36), rng.uniform(0.02, 0.12), rng.uniform(0.25, 0.4)
    radii = np.concatenate([[0.012], rng.uniform(0.02, 0.065, 7), [0.016]])
    column = lathe(np.stack([radii, np.linspace(-0.14, 0.2, 9)], 1), 14).creased(50)
    parts = [Part.of("column", column, metal)]
    parts.append(Part.of("pendant_ball", ball(0.03, 0.036, 0.03, 12, 8).moved(0, -0.16), metal))
    shaded = rng.random() < 0.6
    up = not shaded or rng.random() < 0.6
    style = sample_shade(rng, 0.075, 0.09, ("empire", "slanted", "bell", "tulip"))
    style = replace(style, segments=12, trim=None)
    share = np.linspace(0, 1, 8)
    sag = rng.uniform(0.06, 0.12)
    path = np.stack([np.zeros(8), rise * share - sag * np.sin(np.pi * share * 0.9), reach * share], 1)
    tip = path[-1]
    arm = [Part.of("arm", tube(path, 0.018), metal)]
    arm.append(Part.of("cup", cone(0.014, 0.034, 0.03, 10).moved(0, tip[1] + 0.012, tip[2]), metal))
    if up:
        candle = cylinder(0.013, 0.09, 8).moved(0, tip[1] + 0.06, tip[2])
        arm.append(Part.of("candle", candle, plain((226, 206, 160), "candle")))
        flame = ball(0.019, 0.03, 0.019, 8, 6).moved(0, tip[1] + 0.125, tip[2])
        arm.append(Part.of("flame", flame, BULB))
        if shaded:
            arm += _moved(shell(style, "small", metal, bulb=False), 0, tip[1] + 0.03, tip[2])
    else:
        arm += _moved(shell(style, "small", metal), 0, tip[1] - 0.72 * style.height, tip[2])
    for k in range(count):
        turned = _turned(arm, "y", 360 * k / count)
        parts += [replace(part, name=f"{part.name}_{k}") for part in turned]
    cord = cylinder(0.011, drop + 0.03, 8).moved(0, 0.18 + drop / 2)
    return [*parts, Part.of("cord", cord, metal), *_ceiling(0.19 + drop, metal)]


_KINDS: dict[Callable[[np.random.Generator], list[Part]], float] = {
    _table: 0.36,
    _floor: 0.2,
    _desk: 0.16,
    _arc: 0.07,
    _pendant: 0.12,
    _chandelier: 0.09,
}
"""How often each kind of lamp is drawn."""


def lamp(rng: np.random.Generator) -> list[Part]:
    """A lamp: its parts in metres, y up, front along +z."""
    return pick(rng, _KINDS)(rng)
