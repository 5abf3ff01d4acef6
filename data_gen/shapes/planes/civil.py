"""Airliners and turboprops, and the tail that all civil planes share. Metres, y up, nose along +z."""

from __future__ import annotations

import numpy as np

from data_gen.shapes.materials import Material, brighten, plain
from data_gen.shapes.parts import Part, pair
from data_gen.shapes.planes.livery import fuselage_side, sample_livery, tail_sign, wing_skin
from data_gen.shapes.planes.parts import fin, fuselage, jet_engine, propeller, pylon, undercarriage, wing
from data_gen.shapes.primitives import ball, rod

__all__ = ["airliner", "tail", "turboprop"]

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

_NACELLE = ((0, 0.1, 0.1, 0), (0.25, 0.6, 0.6, 0), (0.55, 1, 1, 0), (0.85, 0.95, 0.95, 0), (1, 0.55, 0.55, 0))


def tail(
    rng: np.random.Generator,
    root: float,
    height: float,
    at: tuple[float, float, float],
    span: float,
    high: bool,
    skins: tuple[Material, Material],
) -> list[Part]:
    """A fin whose root's leading edge is at a point, and the tailplane at its foot or on its top."""
    sign, skin = skins
    sweep, tip = rng.uniform(0.55, 0.95) * height, rng.uniform(0.4, 0.55) * root
    upright = fin(root, tip, height, sweep).moved(*at)
    y, z = (at[1] + 0.96 * height, at[2] - 0.93 * sweep) if high else (at[1] + 0.12 * height, at[2] - 0.28 * root)
    chord = min(1.1 * tip, 0.6 * root) if high else 0.62 * root
    stabiliser = wing(chord, 0.55 * chord, span, 0.5 * span * rng.uniform(0.7, 1.1), 0.06 * span, 0.1).moved(0, y, z)
    return [Part.of("fin", upright, sign), *pair(Part.of("left_tailplane", stabiliser, skin))]


def airliner(rng: np.random.Generator) -> list[Part]:
    """Two or four engines under swept wings, or two at the tail under a T."""
    livery = sample_livery(rng)
    at_tail = rng.random() < 0.22
    four = not at_tail and rng.random() < 0.22
    length = rng.uniform(34, 48) if not four else rng.uniform(52, 66)
    radius = length * rng.uniform(0.047, 0.058) * (1.1 if four else 1)
    body = fuselage(length, 2 * radius, 2 * radius * rng.uniform(1.0, 1.1), _LINER)
    skin = fuselage_side(rng, livery, (rng.uniform(0.2, 0.26), rng.uniform(0.84, 0.89)), cockpit=True)
    metal = (126, 132, 144) if rng.random() < 0.6 else brighten(livery.base, 0.8)
    panels = wing_skin(rng, metal, livery.accent)
    parts = [Part.of("fuselage", body, skin)]
    span, root = length * rng.uniform(0.42, 0.5), length * rng.uniform(0.17, 0.2)
    sweep, rise = span * rng.uniform(0.5, 0.68), span * rng.uniform(0.06, 0.13)
    z_wing, y_wing = length * rng.uniform(0.06, 0.12) - (0.09 * length if at_tail else 0), -0.5 * radius
    kink = (0.34, root * 0.56)
    tip = root * rng.uniform(0.2, 0.28)
    panel = wing(root, tip, span, sweep, rise, 0.12, 0.0, kink).moved(0, y_wing, z_wing)
    parts += pair(Part.of("left_wing", panel, panels))
    if rng.random() < 0.6:
        upturn = fin(0.9 * tip, 0.4 * tip, rng.uniform(0.05, 0.09) * span, 0.9 * tip, 0.08)
        upturn = upturn.moved(0.985 * span, y_wing + 0.98 * rise - 0.04, z_wing - sweep - 0.02 * tip)
        parts += pair(Part.of("left_winglet", upturn, plain(livery.accent)))
    belly = ball(0.92 * radius, 0.45 * radius, 0.8 * root, 12, 8).moved(0, -0.78 * radius, z_wing - 0.5 * root)
    parts.append(Part.of("belly", belly, plain(brighten(livery.base, 0.9))))
    cowl = plain(livery.accent if rng.random() < 0.5 else metal, "cowl")
    size = radius * rng.uniform(0.5, 0.66) * (0.8 if four else 1)
    if at_tail:
        at = (1.32 * radius + 0.4 * size, 0.3 * radius, -0.3 * length)
        size *= 0.8
        parts += pair(*jet_engine("left_engine", size, 4.6 * size, at, cowl))
        arm = rod((0.3 * radius, 0.25 * radius, at[2]), at, 2.2 * size, 0.3 * size, 4)
        parts += pair(Part.of("left_pylon", arm, plain(metal)))
    else:
        for k, share in enumerate((0.3, 0.58) if four else (rng.uniform(0.31, 0.37),)):
            x, wing_y, lead = share * span, y_wing + share * rise, z_wing - share * sweep
            at = (x, wing_y - 1.15 * size, lead + 0.7 * size)
            parts += pair(*jet_engine(f"left_engine_{k}", size, 3.2 * size, at, cowl))
            foot, head = (x, at[1] + 0.5 * size, lead - 0.6 * size), (x, wing_y, lead - 1.4 * size)
            blade = pylon(foot, head, 0.24 * size, 2.6 * size)
            parts += pair(Part.of(f"left_pylon_{k}", blade, plain(metal)))
    tail_root = length * rng.uniform(0.15, 0.18)
    foot = (0.0, 0.62 * radius, -0.5 * length + 1.28 * tail_root)
    skins = (tail_sign(rng, livery), panels)
    parts += tail(rng, tail_root, length * rng.uniform(0.14, 0.18), foot, 0.36 * span, at_tail, skins)
    if rng.random() < 0.35:
        low = -radius - 0.06 * length
        tyre, along = 0.018 * length, z_wing - 0.6 * root
        hip = (1.1 * radius, y_wing + rise * 1.1 * radius / span, along)
        parts += pair(*undercarriage("left_gear", hip, (1.2 * radius, low, along), tyre, None))
        hip = (0, -0.6 * radius, 0.38 * length)
        parts += undercarriage("nose_gear", hip, (0, low, 0.38 * length), 0.8 * tyre, None)
    return parts


def turboprop(rng: np.random.Generator) -> list[Part]:
    """Two or four propellers on a straight high wing, a T-tail or a plain one."""
    livery = sample_livery(rng)
    length = rng.uniform(22, 30)
    radius = length * rng.uniform(0.052, 0.062)
    body = fuselage(length, 2 * radius, 2.1 * radius, _LINER)
    parts = [Part.of("fuselage", body, fuselage_side(rng, livery, (0.24, 0.85), cockpit=True))]
    metal = brighten(livery.base, 0.85) if rng.random() < 0.5 else (126, 132, 144)
    skin = wing_skin(rng, metal, livery.accent)
    span, root = length * rng.uniform(0.48, 0.54), length * rng.uniform(0.1, 0.125)
    y, z = 0.86 * radius, 0.09 * length
    panel = wing(root, 0.5 * root, span, 0.06 * span, 0.02 * span, 0.13).moved(0, y, z)
    parts += pair(Part.of("left_wing", panel, skin))
    four = rng.random() < 0.3
    blades = int(rng.integers(4, 7))
    for k, share in enumerate((0.28, 0.56) if four else (0.32,)):
        x, size = share * span, 0.36 * radius * (0.85 if four else 1.1)
        at = (x, y - 0.5 * size + 0.02 * span * share, z - 0.06 * span * share)
        pod = fuselage(9 * size, 2 * size, 2.3 * size, _NACELLE, 2.2, 12).moved(at[0], at[1], at[2] - 1.2 * size)
        parts += pair(Part.of(f"left_nacelle_{k}", pod, plain(livery.accent)))
        hub = (x, at[1], at[2] + 3.45 * size)
        parts += pair(*propeller(f"left_propeller_{k}", 3.1 * size, blades, hub, rng.uniform(0, 90), livery.metal))
    tail_root = 0.15 * length
    foot = (0.0, 0.6 * radius, -0.5 * length + 1.2 * tail_root)
    high, skins = bool(rng.random() < 0.6), (tail_sign(rng, livery), skin)
    return parts + tail(rng, tail_root, 0.17 * length, foot, 0.3 * span, high, skins)
