"""Fighter jets: deltas and swept wings, one fin or two, intakes, stores under the wings, grey or camouflaged."""

from __future__ import annotations

import numpy as np

from data_gen.shapes.choices import one_of
from data_gen.shapes.materials import Colour, Material, brighten, plain, tint
from data_gen.shapes.parts import Part, pair
from data_gen.shapes.planes.livery import camouflage
from data_gen.shapes.planes.parts import fin, fuselage, pylon, wing
from data_gen.shapes.primitives import ball
from data_gen.shapes.solids import lathe

__all__ = ["fighter"]

_PAIRS: tuple[tuple[Colour, Colour], ...] = (
    ((78, 92, 66), (138, 132, 96)),
    ((82, 88, 98), (136, 144, 154)),
    ((62, 84, 112), (126, 148, 166)),
    ((122, 92, 62), (184, 158, 112)),
    ((58, 70, 62), (104, 112, 92)),
)


def _skins(rng: np.random.Generator) -> tuple[Material, Material]:
    """Main and secondary material."""
    choice = rng.random()
    if choice < 0.55:
        dark, light = one_of(rng, _PAIRS)
        return camouflage(rng, dark, light), plain(light, "plain")
    if choice < 0.85:
        level = int(rng.integers(96, 150))
        grey: Colour = (level - 6, level, level + 8)
        return plain(grey, "grey"), plain(brighten(grey, 0.72), "dark_grey")
    colour = tint(rng, rng.random(), 0.75, 0.55)
    return plain(colour, "display"), plain((222, 206, 150) if rng.random() < 0.5 else brighten(colour, 0.5), "trim")


def _store(name: str, x: float, y: float, z: float, size: float) -> list[Part]:
    """A missile under a pylon that reaches up into the wing."""
    body = lathe([(0.1, 0), (0.11, 0.1), (0.11, 2.2), (0.06, 2.5), (0, 2.65)], 8).creased(60).scaled(size, size, size)
    body = body.turned("x", 90).moved(x, y - 0.42 * size, z - 1.2 * size)
    parts = [Part.of(name, body, plain((196, 190, 176), "missile"))]
    blade = pylon((x, y - 0.44 * size, z), (x, y + 0.05 * size, z), 0.08 * size, 0.9 * size)
    parts.append(Part.of(f"{name}_pylon", blade, plain((88, 92, 98), "pylon")))
    for angle in (45.0, 135.0):
        vane = pylon((0, -0.3 * size, 0), (0, 0.3 * size, 0), 0.02 * size, 0.3 * size).turned("z", angle)
        vane = vane.moved(x, y - 0.42 * size, z - (0.95 + 0.0002 * angle) * size)
        parts.append(Part.of(f"{name}_vane_{angle:.0f}", vane, plain((120, 40, 36), "vane")))
    return parts


def fighter(rng: np.random.Generator) -> list[Part]:
    """A fighter jet: its parts in metres, y up, nose along +z."""
    main, second = _skins(rng)
    length, width = rng.uniform(14.5, 18.5), rng.uniform(1.7, 2.3)
    height = rng.uniform(1.45, 1.7)
    twin = rng.random() < 0.5
    delta = rng.random() < 0.4
    shape = (
        (0.0, 0.8 if twin else 0.55, 0.6, 0.02),
        (0.12, 0.95 if twin else 0.75, 0.75, 0.02),
        (0.35, 1.0, 0.95, 0.0),
        (0.55, 0.95, 1.0, 0.0),
        (0.7, 0.62, 0.86, 0.0),
        (0.82, 0.46, 0.62, -0.03),
        (0.93, 0.24, 0.32, -0.08),
        (0.99, 0.04, 0.05, -0.12),
        (1.0, 0.02, 0.02, -0.12),
    )
    body = fuselage(length, width, height, shape, 2.6, 16)
    radome = plain((70, 72, 78), "radome")
    parts = [Part.of("fuselage", body, main).painted(body.cells[:, 0] >= 6, radome)]
    canopy = ball(0.22 * width, 0.36 * height, 0.105 * length, 12, 8).moved(0, 0.33 * height, 0.24 * length)
    parts.append(Part.of("canopy", canopy, plain((56, 60, 64) if rng.random() < 0.6 else (132, 104, 52), "glass")))
    duct = ((0, 0.4, 0.5, 0), (0.25, 0.9, 0.9, 0), (1, 1, 1, 0))
    intake = fuselage(0.36 * length, 0.34 * width, 0.62 * height, duct, 5, 12)
    left = Part.of("left_intake", intake.moved(0.42 * width, -0.08 * height, 0.02 * length), main)
    parts += pair(left.capped(plain((30, 30, 34), "duct"), first=False))
    span = rng.uniform(3.9, 5.0)
    root = length * (rng.uniform(0.44, 0.52) if delta else rng.uniform(0.27, 0.33))
    tip = root * (rng.uniform(0.06, 0.12) if delta else rng.uniform(0.25, 0.4))
    sweep = root - tip - rng.uniform(0, 0.06) * root if delta else span * rng.uniform(0.6, 0.85)
    z = -0.5 * length + 0.1 * length + root if delta else 0.06 * length + 0.3 * root
    panel = wing(root, tip, span, sweep, rng.uniform(-0.06, 0.02) * span, 0.05, 0.0).projected("y")
    parts += pair(Part.of("left_wing", panel.moved(0, 0.04 * height, z), main))
    edge = wing(0.3 * length, 0.03 * length, 0.34 * width, 0.26 * length, 0, 0.04, 0.24 * width)
    parts += pair(Part.of("left_strake", edge.moved(0, 0.06 * height, z + 0.2 * length - 0.1 * root), second))
    at = np.array([0.5 * width, 0.05 * height, -0.5 * length + 0.17 * length])
    if delta and rng.random() < 0.6:
        at[2] = 0.22 * length
        small = wing(0.1 * length, 0.04 * length, 1.5, 0.07 * length, 0.12, 0.06, -0.3).projected("y")
        tailplane = Part.of("left_canard", small.moved(0.28 * width, 0.12 * height, at[2]), second)
    else:
        small = wing(0.16 * length, 0.06 * length, 2.3, 0.11 * length, -0.05, 0.06, -0.4).projected("y")
        tailplane = Part.of("left_tailplane", small.moved(*at), main)
    if not delta or at[2] > 0:
        parts += pair(tailplane)
    fin_root, fin_height = length * rng.uniform(0.17, 0.21), rng.uniform(1.9, 2.5)
    blade = fin(fin_root, 0.4 * fin_root, fin_height, 0.8 * fin_height, 0.06)
    foot = -0.5 * length + 0.06 * length + fin_root
    if twin:
        cant = rng.uniform(0, 22)
        upright = blade.turned("z", -cant).moved(0.33 * width, 0.18 * height, foot)
        parts += pair(Part.of("left_fin", upright, main))
    else:
        parts.append(Part.of("fin", blade.scaled(1, 1.2, 1).moved(0, 0.2 * height, foot), main))
    radius = 0.25 * height if twin else 0.29 * height
    mouth = [(0.72 * radius, -0.9), (0.78 * radius, -0.92), (radius, 0.5), (0.9 * radius, 0.5), (0.6 * radius, -0.2)]
    nozzle = lathe(mouth, 14, ring=True)
    flame = lathe([(0.75 * radius, -0.45), (0.8 * radius, 0.4)], 12)
    end = (0.24 * width if twin else 0.0, 0.02 * height, -0.5 * length - 0.1)
    ring = Part.of("left_nozzle", nozzle.turned("x", 90).moved(*end), plain((64, 62, 62), "nozzle"))
    core = Part.of("left_burner", flame.turned("x", 90).moved(*end), plain((34, 30, 30), "burner"))
    parts += pair(ring, core) if twin else [ring, core]
    if rng.random() < 0.6:
        for k, share in enumerate((0.45, 0.68)[: int(rng.integers(1, 3))]):
            x = share * span
            chord = root + (tip - root) * share
            parts += pair(*_store(f"left_missile_{k}", x, 0.02 * height, z - sweep * share - 0.5 * chord, 1.0))
    return parts
