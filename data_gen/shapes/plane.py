"""Planes: airliners, business jets, fighters, light aircraft, biplanes, turboprops and gliders.

Metres, y up, nose along +z (so +x is the left wing's side), the fuselage's axis near y = 0.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from data_gen.shapes.materials import plain, shade
from data_gen.shapes.parts import Part
from data_gen.shapes.plane_livery import draw_livery, fuselage_side, tail_sign, wing_skin
from data_gen.shapes.plane_military import fighter
from data_gen.shapes.plane_parts import airscrew, fin, fuselage, jet_engine, pylon, undercarriage, wing
from data_gen.shapes.primitives import ball, cone, rod

__all__ = ["KINDS", "plane"]

_LINER = (
    (0.0, 0.1, 0.16, 0.36),
    (0.03, 0.2, 0.3, 0.32),
    (0.12, 0.5, 0.58, 0.2),
    (0.22, 0.8, 0.82, 0.09),
    (0.34, 1.0, 1.0, 0.0),
    (0.86, 1.0, 1.0, 0.0),
    (0.91, 0.94, 0.92, -0.02),
    (0.955, 0.74, 0.7, -0.07),
    (0.985, 0.44, 0.4, -0.13),
    (1.0, 0.12, 0.12, -0.17),
)
"""Airliner: an upswept tail cone, a tube, a drooping nose."""

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


def _tail(
    rng: np.random.Generator,
    root: float,
    height: float,
    at: tuple[float, float, float],
    span: float,
    high: bool,
    skins: tuple,
) -> list[Part]:
    """A fin whose root's leading edge is at a point, and the tailplane at its foot or on its top."""
    sign, skin = skins
    sweep, tip = rng.uniform(0.55, 0.95) * height, rng.uniform(0.4, 0.55) * root
    upright = fin(root, tip, height, sweep).moved(*at)
    y, z = (at[1] + 0.96 * height, at[2] - 0.93 * sweep) if high else (at[1] + 0.12 * height, at[2] - 0.28 * root)
    chord = min(1.1 * tip, 0.6 * root) if high else 0.62 * root
    stabiliser = wing(chord, 0.55 * chord, span, 0.5 * span * rng.uniform(0.7, 1.1), 0.06 * span, 0.1).moved(0, y, z)
    left = Part.of("left_tailplane", stabiliser, skin)
    return [Part.of("fin", upright, sign), left, left.mirrored()]


def _airliner(rng: np.random.Generator) -> list[Part]:
    """Two or four engines under swept wings, or two at the tail under a T."""
    livery = draw_livery(rng)
    at_tail = rng.random() < 0.22
    four = not at_tail and rng.random() < 0.22
    length = rng.uniform(34, 48) if not four else rng.uniform(52, 66)
    radius = length * rng.uniform(0.047, 0.058) * (1.1 if four else 1)
    body = fuselage(length, 2 * radius, 2 * radius * rng.uniform(1.0, 1.1), _LINER)
    skin = fuselage_side(rng, livery, (rng.uniform(0.2, 0.26), rng.uniform(0.84, 0.89)), cockpit=True)
    metal = (126, 132, 144) if rng.random() < 0.6 else shade(livery.base, 0.8)
    panels = wing_skin(rng, metal, livery.accent)
    parts = [Part.of("fuselage", body, skin)]
    span, root = length * rng.uniform(0.42, 0.5), length * rng.uniform(0.17, 0.2)
    sweep, rise = span * rng.uniform(0.5, 0.68), span * rng.uniform(0.06, 0.13)
    z_wing, y_wing = length * rng.uniform(0.06, 0.12) - (0.09 * length if at_tail else 0), -0.5 * radius
    kink = (0.34, root * 0.56)
    tip = root * rng.uniform(0.2, 0.28)
    left = Part.of("left_wing", wing(root, tip, span, sweep, rise, 0.12, 0.0, kink).moved(0, y_wing, z_wing), panels)
    parts += [left, left.mirrored()]
    if rng.random() < 0.6:
        upturn = fin(0.9 * tip, 0.4 * tip, rng.uniform(0.05, 0.09) * span, 0.9 * tip, 0.08)
        let = Part.of("left_winglet", upturn.moved(0.985 * span, y_wing + 0.98 * rise - 0.04, z_wing - sweep - 0.02 * tip), plain(livery.accent))
        parts += [let, let.mirrored()]
    belly = ball(0.92 * radius, 0.45 * radius, 0.8 * root, 12, 8).moved(0, -0.78 * radius, z_wing - 0.5 * root)
    parts.append(Part.of("belly", belly, plain(shade(livery.base, 0.9))))
    cowl = plain(livery.accent if rng.random() < 0.5 else metal, "cowl")
    size = radius * rng.uniform(0.5, 0.66) * (0.8 if four else 1)
    if at_tail:
        at = (1.32 * radius + 0.4 * size, 0.3 * radius, -0.3 * length)
        size *= 0.8
        parts += _pair(jet_engine("left_engine", size, 4.6 * size, at, cowl))
        arm = Part.of("left_pylon", rod((0.3 * radius, 0.25 * radius, at[2]), at, 2.2 * size, 0.3 * size, 4), plain(metal))
        parts += [arm, arm.mirrored()]
    else:
        for k, share in enumerate((0.3, 0.58) if four else (rng.uniform(0.31, 0.37),)):
            x, wing_y, lead = share * span, y_wing + share * rise, z_wing - share * sweep
            at = (x, wing_y - 1.15 * size, lead + 0.7 * size)
            parts += _pair(jet_engine(f"left_engine_{k}", size, 3.2 * size, at, cowl))
            blade = pylon((x, at[1] + 0.5 * size, lead - 0.6 * size), (x, wing_y, lead - 1.4 * size), 0.24 * size, 2.6 * size)
            parts += _pair([Part.of(f"left_pylon_{k}", blade, plain(metal))])
    tail_root = length * rng.uniform(0.15, 0.18)
    foot = (0.0, 0.62 * radius, -0.5 * length + 1.28 * tail_root)
    skins = (tail_sign(rng, livery), panels)
    parts += _tail(rng, tail_root, length * rng.uniform(0.14, 0.18), foot, 0.36 * span, at_tail, skins)
    if rng.random() < 0.35:
        low = -radius - 0.06 * length
        tyre = 0.018 * length
        parts += _pair(undercarriage("left_gear", (1.1 * radius, y_wing, z_wing - 0.75 * root), (1.2 * radius, low, z_wing - 0.75 * root), tyre, None))
        parts += undercarriage("nose_gear", (0, -0.6 * radius, 0.38 * length), (0, low, 0.38 * length), 0.8 * tyre, None)
    return parts


def _pair(parts: list[Part]) -> list[Part]:
    """The parts and their mirror images."""
    return parts + [part.mirrored() for part in parts]


def _light(rng: np.random.Generator) -> list[Part]:
    """One propeller in the nose, a high or low straight wing, fixed wheels."""
    livery = draw_livery(rng)
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
    left = Part.of("left_wing", wing(chord, chord * rng.uniform(0.6, 1), span, 0.12, 0.03 * span if high else 0.09 * span, 0.13).moved(0, y, z), skin)
    parts = [part, left, left.mirrored()]
    if high:
        strut = rod((0.3 * width, -0.35 * height, z - 0.35 * chord), (0.5 * span, y + 0.015 * span, z - 0.38 * chord), 0.1, 0.05)
        parts += _pair([Part.of("left_strut", strut, livery.metal)])
    parts += _tail(rng, 0.15 * length, 0.155 * length, (0, 0.12 * height, -0.5 * length + 0.17 * length), 0.33 * span, bool(rng.random() < 0.15), (tail_sign(rng, livery), skin))
    nose = (0, -0.13 * height, 0.5 * length + 0.03)
    parts += airscrew("propeller", rng.uniform(0.85, 1.0), int(rng.integers(2, 4)), nose, rng.uniform(0, 180), plain(livery.accent))
    low = -0.5 * height - rng.uniform(0.45, 0.6)
    spat = plain(livery.accent) if rng.random() < 0.6 else None
    parts += _pair(undercarriage("left_gear", (0.2 * width, -0.3 * height, z - 0.5 * chord), (0.95, low, z - 0.45 * chord), 0.24, spat))
    if rng.random() < 0.65:
        parts += undercarriage("nose_gear", (0, -0.3 * height, 0.4 * length), (0, low, 0.41 * length), 0.2, spat)
    else:
        parts += undercarriage("tail_gear", (0, 0.0, -0.42 * length), (0, -0.3 * height, -0.45 * length), 0.11, None)
    return parts


def _biplane(rng: np.random.Generator) -> list[Part]:
    """Two wings braced with struts, a round engine, an open cockpit."""
    livery = draw_livery(rng)
    length, width = rng.uniform(6.4, 7.4), rng.uniform(0.95, 1.1)
    shape = ((0.0, 0.1, 0.2, 0.1), (0.3, 0.5, 0.55, 0.05), (0.55, 0.86, 0.95, 0.02), (0.75, 0.95, 1.0, 0), (0.9, 1.0, 0.98, 0), (0.94, 0.9, 0.88, 0))
    parts = [Part.of("fuselage", fuselage(length, width, 1.05 * width, shape, 2.4), fuselage_side(rng, livery, None, cockpit=False))]
    nose = 0.44 * length
    engine = cone(0.46 * width, 0.38 * width, 0.5, 12).turned("x", 90).moved(0, 0, nose + 0.18)
    parts.append(Part.of("engine", engine, plain((72, 74, 80), "engine")))
    for k in range(7):
        angle = 2 * np.pi * k / 7
        x, y = float(np.sin(angle)), float(np.cos(angle))
        cylinder_head = rod((0.25 * x, 0.25 * y, nose + 0.22), (0.52 * width * x, 0.52 * width * y, nose + 0.22), 0.17, sides=6)
        parts.append(Part.of(f"cylinder_{k}", cylinder_head, plain((98, 96, 92), "cylinder")))
    parts += airscrew("propeller", rng.uniform(0.95, 1.1), 2, (0, 0, nose + 0.5), rng.uniform(0, 180), plain(livery.accent))
    span, chord = rng.uniform(3.8, 4.6), rng.uniform(1.1, 1.3)
    gap, stagger = rng.uniform(1.25, 1.45), rng.uniform(0.1, 0.45)
    skin = wing_skin(rng, livery.accent if rng.random() < 0.5 else livery.base, livery.accent)
    z = 0.24 * length
    low_y, high_y = -0.4 * width, -0.4 * width + gap
    upper = Part.of("left_upper_wing", wing(chord, 0.9 * chord, span, 0.1, 0.05 * span, 0.1).moved(0, high_y, z + stagger), skin)
    lower = Part.of("left_lower_wing", wing(chord, 0.9 * chord, 0.93 * span, 0.1, 0.05 * span, 0.1).moved(0, low_y, z), skin)
    parts += _pair([upper, lower])
    for k, (x, back) in enumerate(((0.62 * span, 0.25), (0.62 * span, 0.7))):
        rise = 0.05 * x
        strut = rod((x, low_y + rise, z - back * chord), (x, high_y + rise, z + stagger - back * chord), 0.05, 0.09)
        parts += _pair([Part.of(f"left_strut_{k}", strut, livery.metal)])
    cabane = rod((0.3 * width, 0.2, z - 0.4 * chord), (0.42 * width, high_y, z + stagger - 0.4 * chord), 0.05, 0.08)
    parts += _pair([Part.of("left_cabane", cabane, livery.metal)])
    rim = ball(0.3 * width, 0.12, 0.42, 12, 6).moved(0, 0.46 * width, 0.02 * length)
    screen = ball(0.2 * width, 0.2, 0.06, 10, 6).moved(0, 0.5 * width, 0.02 * length + 0.42)
    parts += [Part.of("cockpit", rim, plain((52, 40, 34), "leather")), Part.of("windscreen", screen, plain((70, 84, 100), "glass"))]
    parts += _tail(rng, 0.16 * length, 0.15 * length, (0, 0.1, -0.5 * length + 0.17 * length), 0.34 * span, False, (tail_sign(rng, livery), skin))
    parts += _pair(undercarriage("left_gear", (0.25 * width, -0.3 * width, 0.26 * length), (0.75, -0.5 * width - 0.55, 0.3 * length), 0.3, None))
    axle = rod((0.75, -0.5 * width - 0.55, 0.3 * length), (-0.75, -0.5 * width - 0.55, 0.3 * length), 0.06)
    parts.append(Part.of("axle", axle, livery.metal))
    return parts + undercarriage("tail_gear", (0, 0, -0.44 * length), (0, -0.3 * width, -0.47 * length), 0.1, None)


def _turboprop(rng: np.random.Generator) -> list[Part]:
    """Two or four propellers on a straight high wing, a T-tail or a plain one."""
    livery = draw_livery(rng)
    length = rng.uniform(22, 30)
    radius = length * rng.uniform(0.052, 0.062)
    parts = [Part.of("fuselage", fuselage(length, 2 * radius, 2.1 * radius, _LINER), fuselage_side(rng, livery, (0.24, 0.85), cockpit=True))]
    metal = shade(livery.base, 0.85) if rng.random() < 0.5 else (126, 132, 144)
    skin = wing_skin(rng, metal, livery.accent)
    span, root = length * rng.uniform(0.48, 0.54), length * rng.uniform(0.1, 0.125)
    y, z = 0.86 * radius, 0.09 * length
    left = Part.of("left_wing", wing(root, 0.5 * root, span, 0.06 * span, 0.02 * span, 0.13).moved(0, y, z), skin)
    parts += [left, left.mirrored()]
    four = rng.random() < 0.3
    blades = int(rng.integers(4, 7))
    for k, share in enumerate((0.28, 0.56) if four else (0.32,)):
        x, size = share * span, 0.36 * radius * (0.85 if four else 1.1)
        at = (x, y - 0.5 * size + 0.02 * span * share, z - 0.06 * span * share)
        pod = fuselage(9 * size, 2 * size, 2.3 * size, ((0, 0.1, 0.1, 0), (0.25, 0.6, 0.6, 0), (0.55, 1, 1, 0), (0.85, 0.95, 0.95, 0), (1, 0.55, 0.55, 0)), 2.2, 12)
        parts += _pair([Part.of(f"left_nacelle_{k}", pod.moved(at[0], at[1], at[2] - 1.2 * size), plain(livery.accent))])
        screw = airscrew(f"left_propeller_{k}", 3.1 * size, blades, (x, at[1], at[2] + 3.45 * size), rng.uniform(0, 90), livery.metal)
        parts += _pair(screw)
    tail_root = 0.15 * length
    foot = (0.0, 0.6 * radius, -0.5 * length + 1.2 * tail_root)
    return parts + _tail(rng, tail_root, 0.17 * length, foot, 0.3 * span, bool(rng.random() < 0.6), (tail_sign(rng, livery), skin))


def _glider(rng: np.random.Generator) -> list[Part]:
    """A slender body under very long thin wings."""
    livery = draw_livery(rng)
    length, width = rng.uniform(6.6, 7.6), rng.uniform(0.62, 0.74)
    shape = ((0, 0.12, 0.14, 0.1), (0.35, 0.26, 0.28, 0.06), (0.55, 0.6, 0.66, 0.03), (0.72, 0.95, 1.0, 0), (0.85, 0.9, 0.92, -0.02), (0.95, 0.6, 0.58, -0.08), (1, 0.1, 0.1, -0.12))
    parts = [Part.of("fuselage", fuselage(length, width, 1.15 * width, shape), fuselage_side(rng, livery, None, cockpit=False))]
    canopy = ball(0.4 * width, 0.5 * width, 0.16 * length, 12, 8).moved(0, 0.26 * width, 0.29 * length)
    parts.append(Part.of("canopy", canopy, plain((48, 58, 74), "glass")))
    skin = wing_skin(rng, livery.base, livery.accent)
    span, chord = rng.uniform(5.6, 7.0), rng.uniform(0.7, 0.85)
    left = Part.of("left_wing", wing(chord, 0.4 * chord, span, 0.15, 0.07 * span, 0.14).moved(0, 0.35 * width, 0.19 * length), skin)
    parts += [left, left.mirrored()]
    wheel = undercarriage("gear", (0, -0.2 * width, 0.13 * length), (0, -0.62 * width, 0.13 * length), 0.2, None)
    return parts + wheel + _tail(rng, 0.13 * length, 0.17 * length, (0, 0.1 * width, -0.5 * length + 0.13 * length), 0.2 * span, True, (tail_sign(rng, livery), skin))


KINDS: dict[str, tuple[float, Callable[[np.random.Generator], list[Part]]]] = {
    "airliner": (0.4, _airliner),
    "fighter": (0.22, fighter),
    "light": (0.16, _light),
    "biplane": (0.08, _biplane),
    "turboprop": (0.09, _turboprop),
    "glider": (0.05, _glider),
}
"""Kinds of plane: how often each is drawn, and its builder."""


def plane(rng: np.random.Generator) -> list[Part]:
    """A plane.

    Args:
        rng: Source of every choice.

    Returns:
        Its parts in metres, y up, nose along +z.
    """
    shares = [share for share, _ in KINDS.values()]
    kind = list(KINDS)[int(rng.choice(len(KINDS), p=shares))]
    return KINDS[kind][1](rng)
