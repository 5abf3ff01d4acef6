"""Small planes: light aircraft, biplanes and gliders. Metres, y up, nose along +z."""

from __future__ import annotations

import numpy as np

from data_gen.shapes.materials import plain
from data_gen.shapes.parts import Part, pair
from data_gen.shapes.planes.civil import tail
from data_gen.shapes.planes.livery import fuselage_side, sample_livery, tail_sign, wing_skin
from data_gen.shapes.planes.parts import fuselage, propeller, undercarriage, wing
from data_gen.shapes.primitives import ball, cone, rod

__all__ = ["biplane", "glider", "light"]

_LIGHT = (
    (0.0, 0.08, 0.16, 0.12),
    (0.25, 0.36, 0.4, 0.06),
    (0.45, 0.86, 0.8, 0.02),
    (0.58, 1.0, 1.0, 0.0),
    (0.72, 0.98, 0.86, -0.07),
    (0.8, 0.9, 0.72, -0.12),
    (0.94, 0.74, 0.58, -0.13),
    (1.0, 0.42, 0.36, -0.13),
)
"""Light aircraft: a thin tail boom, a cabin, a low engine cover."""


def light(rng: np.random.Generator) -> list[Part]:
    """One propeller in the nose, a high or low straight wing, fixed wheels."""
    livery = sample_livery(rng)
    length, width = rng.uniform(7.2, 8.6), rng.uniform(1.05, 1.25)
    height = width * rng.uniform(1.1, 1.25)
    high = rng.random() < 0.5
    body = fuselage(length, width, height, _LIGHT, 2.7)
    part = Part.of("fuselage", body, fuselage_side(rng, livery, None, cockpit=False))
    along, around = body.cells.T
    angle = (around + 0.5) % 18 * 20  # degrees from +x, counter-clockwise seen from the nose
    glass = plain((48, 60, 76), "glass")
    upper = ((angle > 8) & (angle < 62)) | ((angle > 118) & (angle < 172))
    part = part.painted((along == 2) & upper, glass).painted((along == 3) & (angle > 8) & (angle < 172), glass)
    span, chord = rng.uniform(4.6, 5.6), rng.uniform(1.3, 1.6)
    colour = livery.base if rng.random() < 0.6 else livery.accent
    skin = wing_skin(rng, colour, livery.accent if colour == livery.base else livery.base)
    y = 0.47 * height if high else -0.34 * height
    z = 0.1 * length + 0.5 * chord
    panel = wing(chord, chord * rng.uniform(0.6, 1), span, 0.12, 0.03 * span if high else 0.09 * span, 0.13)
    parts = [part, *pair(Part.of("left_wing", panel.moved(0, y, z), skin))]
    if high:
        foot, head = (0.3 * width, -0.35 * height, z - 0.35 * chord), (0.5 * span, y + 0.015 * span, z - 0.38 * chord)
        parts += pair(Part.of("left_strut", rod(foot, head, 0.1, 0.05), livery.metal))
    foot, at_top = (0, 0.12 * height, -0.5 * length + 0.17 * length), bool(rng.random() < 0.15)
    parts += tail(rng, 0.15 * length, 0.155 * length, foot, 0.33 * span, at_top, (tail_sign(rng, livery), skin))
    radius, blades = rng.uniform(0.85, 1.0), int(rng.integers(2, 4))
    nose = (0, -0.13 * height, 0.5 * length + 0.03)
    parts += propeller("propeller", radius, blades, nose, rng.uniform(0, 180), plain(livery.accent))
    low = -0.5 * height - rng.uniform(0.45, 0.6)
    spat = plain(livery.accent) if rng.random() < 0.6 else None
    hip, foot = (0.2 * width, -0.3 * height, z - 0.5 * chord), (0.95, low, z - 0.45 * chord)
    parts += pair(*undercarriage("left_gear", hip, foot, 0.24, spat))
    if rng.random() < 0.65:
        parts += undercarriage("nose_gear", (0, -0.3 * height, 0.4 * length), (0, low, 0.41 * length), 0.2, spat)
    else:
        parts += undercarriage("tail_gear", (0, 0.0, -0.42 * length), (0, -0.3 * height, -0.45 * length), 0.11, None)
    return parts


def biplane(rng: np.random.Generator) -> list[Part]:
    """Two wings braced with struts, a round engine, an open cockpit."""
    livery = sample_livery(rng)
    length, width = rng.uniform(6.4, 7.4), rng.uniform(0.95, 1.1)
    shape = (
        (0.0, 0.1, 0.2, 0.1),
        (0.3, 0.5, 0.55, 0.05),
        (0.55, 0.86, 0.95, 0.02),
        (0.75, 0.95, 1.0, 0),
        (0.9, 1.0, 0.98, 0),
        (0.94, 0.9, 0.88, 0),
    )
    body = fuselage(length, width, 1.05 * width, shape, 2.4)
    parts = [Part.of("fuselage", body, fuselage_side(rng, livery, None, cockpit=False))]
    nose = 0.44 * length
    engine = cone(0.46 * width, 0.38 * width, 0.5, 12).turned("x", 90).moved(0, 0, nose + 0.18)
    parts.append(Part.of("engine", engine, plain((72, 74, 80), "engine")))
    for k in range(7):
        angle = 2 * np.pi * k / 7
        x, y = float(np.sin(angle)), float(np.cos(angle))
        top = (0.52 * width * x, 0.52 * width * y, nose + 0.22)
        head = rod((0.25 * x, 0.25 * y, nose + 0.22), top, 0.17, sides=6)
        parts.append(Part.of(f"cylinder_{k}", head, plain((98, 96, 92), "cylinder")))
    radius, hub = rng.uniform(0.95, 1.1), (0, 0, nose + 0.5)
    parts += propeller("propeller", radius, 2, hub, rng.uniform(0, 180), plain(livery.accent))
    span, chord = rng.uniform(3.8, 4.6), rng.uniform(1.1, 1.3)
    gap, stagger = rng.uniform(1.25, 1.45), rng.uniform(0.1, 0.45)
    skin = wing_skin(rng, livery.accent if rng.random() < 0.5 else livery.base, livery.accent)
    z = 0.24 * length
    low_y, high_y = -0.4 * width, -0.4 * width + gap
    upper = wing(chord, 0.9 * chord, span, 0.1, 0.05 * span, 0.1).moved(0, high_y, z + stagger)
    lower = wing(chord, 0.9 * chord, 0.93 * span, 0.1, 0.05 * span, 0.1).moved(0, low_y, z)
    parts += pair(Part.of("left_upper_wing", upper, skin), Part.of("left_lower_wing", lower, skin))
    for k, (x, back) in enumerate(((0.62 * span, 0.25), (0.62 * span, 0.7))):
        rise = 0.05 * x
        strut = rod((x, low_y + rise, z - back * chord), (x, high_y + rise, z + stagger - back * chord), 0.05, 0.09)
        parts += pair(Part.of(f"left_strut_{k}", strut, livery.metal))
    cabane = rod((0.3 * width, 0.2, z - 0.4 * chord), (0.42 * width, high_y, z + stagger - 0.4 * chord), 0.05, 0.08)
    parts += pair(Part.of("left_cabane", cabane, livery.metal))
    rim = ball(0.3 * width, 0.12, 0.42, 12, 6).moved(0, 0.46 * width, 0.02 * length)
    screen = ball(0.2 * width, 0.2, 0.06, 10, 6).moved(0, 0.5 * width, 0.02 * length + 0.42)
    parts += [
        Part.of("cockpit", rim, plain((52, 40, 34), "leather")),
        Part.of("windscreen", screen, plain((70, 84, 100), "glass")),
    ]
    foot = (0, 0.1, -0.5 * length + 0.17 * length)
    parts += tail(rng, 0.16 * length, 0.15 * length, foot, 0.34 * span, False, (tail_sign(rng, livery), skin))
    hip, left = (0.25 * width, -0.3 * width, 0.26 * length), (0.75, -0.5 * width - 0.55, 0.3 * length)
    parts += pair(*undercarriage("left_gear", hip, left, 0.3, None))
    parts.append(Part.of("axle", rod(left, (-left[0], *left[1:]), 0.06), livery.metal))
    return parts + undercarriage("tail_gear", (0, 0, -0.44 * length), (0, -0.3 * width, -0.47 * length), 0.1, None)


def glider(rng: np.random.Generator) -> list[Part]:
    """A slender body under very long thin wings."""
    livery = sample_livery(rng)
    length, width = rng.uniform(6.6, 7.6), rng.uniform(0.62, 0.74)
    shape = (
        (0, 0.12, 0.14, 0.1),
        (0.35, 0.26, 0.28, 0.06),
        (0.55, 0.6, 0.66, 0.03),
        (0.72, 0.95, 1.0, 0),
        (0.85, 0.9, 0.92, -0.02),
        (0.95, 0.6, 0.58, -0.08),
        (1, 0.1, 0.1, -0.12),
    )
    body = fuselage(length, width, 1.15 * width, shape)
    parts = [Part.of("fuselage", body, fuselage_side(rng, livery, None, cockpit=False))]
    canopy = ball(0.4 * width, 0.5 * width, 0.16 * length, 12, 8).moved(0, 0.26 * width, 0.29 * length)
    parts.append(Part.of("canopy", canopy, plain((48, 58, 74), "glass")))
    skin = wing_skin(rng, livery.base, livery.accent)
    span, chord = rng.uniform(5.6, 7.0), rng.uniform(0.7, 0.85)
    panel = wing(chord, 0.4 * chord, span, 0.15, 0.07 * span, 0.14).moved(0, 0.35 * width, 0.19 * length)
    parts += pair(Part.of("left_wing", panel, skin))
    parts += undercarriage("gear", (0, -0.2 * width, 0.13 * length), (0, -0.62 * width, 0.13 * length), 0.2, None)
    foot = (0, 0.1 * width, -0.5 * length + 0.13 * length)
    return parts + tail(rng, 0.13 * length, 0.17 * length, foot, 0.2 * span, True, (tail_sign(rng, livery), skin))
