"""Cars: a lofted body with painted glass on wheels, with lamps, bumpers, mirrors and extras.

Metres, y up, front along +z (so +x is the car's left), wheels standing on y = 0.
"""

from __future__ import annotations

import numpy as np

from data_gen.shapes.cars.body import body
from data_gen.shapes.cars.frame import CarFrame, sample_frame
from data_gen.shapes.choices import pick
from data_gen.shapes.materials import Colour, Material, brighten, plain, tint
from data_gen.shapes.parts import Part, pair
from data_gen.shapes.patterns import wheel_face
from data_gen.shapes.primitives import ball, box, cylinder, tapered
from data_gen.shapes.profiles import ellipse
from data_gen.shapes.solids import lathe, sweep

__all__ = ["car"]

_SHARES = {
    "sedan": 3, "coupe": 1.5, "hatchback": 2.5, "wagon": 1.5, "suv": 2.5, "van": 1.5, "pickup": 1.5, "sports": 2
}  # fmt: skip
_PAINTS: dict[tuple[float, float, float], float] = {  # hue, saturation, value: weight
    (0.0, 0.85, 0.75): 3.0,
    (0.6, 0.75, 0.65): 3.0,
    (0.13, 0.85, 0.92): 1.6,
    (0.07, 0.85, 0.88): 1.4,
    (0.36, 0.6, 0.45): 1.4,
    (0.5, 0.6, 0.6): 1.2,
    (0.0, 0.03, 0.66): 1.6,
    (0.62, 0.12, 0.35): 1.4,
    (0.0, 0.05, 0.16): 1.2,
    (0.95, 0.7, 0.45): 0.9,
    (0.58, 0.4, 0.85): 1.0,
    (0.09, 0.35, 0.72): 0.8,
    (0.78, 0.45, 0.5): 0.6,
    (0.24, 0.65, 0.7): 0.8,
}


def _wheels(rng: np.random.Generator, frame: CarFrame) -> list[Part]:
    """Four tyres with rims, their outer faces a little outside the flanks."""
    radius, width = frame.wheel, 0.21
    rubber = plain((27, 27, 29), "rubber")
    alloy = wheel_face(rng)
    rim_share = rng.uniform(0.66, 0.76)
    tyre = lathe(np.array([(0.9, -0.5), (1, -0.34), (1, 0.34), (0.9, 0.5)]) * (radius, width), 18)
    rim = lathe([(rim_share * radius, -0.05), (rim_share * radius, 0.004), (0.25 * radius, 0.016), (0, 0.02)], 16)
    parts = []
    for where, axle in zip(("rear", "front"), frame.axles, strict=True):
        outside = frame.width / 2 + 0.005 - width / 2
        wheel = Part.of(f"{where}_left_tyre", tyre.turned("z", -90).moved(outside, radius, axle), rubber)
        face = rim.turned("z", -90).projected("x").moved(outside + width / 2, radius, axle)
        hub = cylinder(0.09, 2 * outside, 8).turned("z", 90).moved(0, radius, axle)
        parts += [*pair(wheel, Part.of(f"{where}_left_rim", face, alloy)), Part.of(f"{where}_axle", hub, rubber)]
    return parts


def _ends(rng: np.random.Generator, frame: CarFrame, paint: Colour) -> list[Part]:
    """Lamps, grille, bumpers and number plates."""
    half = frame.length / 2
    parts: list[Part] = []
    lamp = plain((244, 240, 214), "headlamp")
    red = plain((190, 24, 28), "tail_lamp")
    black = plain((33, 33, 36), "grille")
    chrome = plain((176, 180, 186), "chrome")
    trim = plain(brighten(paint, 0.55), "bumper") if rng.random() < 0.5 else black
    front_half = float(frame.half_width(half))
    low = frame.floor + 0.12
    lamp_y = frame.nose - 0.21
    if rng.random() < 0.4:
        light = ball(0.1, 0.09, 0.08, 12, 6)
    else:
        light = box(rng.uniform(0.24, 0.34), rng.uniform(0.1, 0.16), 0.16, 0.03)
    left = Part.of("left_headlamp", light.moved(front_half - 0.16, lamp_y, half - 0.03), lamp)
    grille_height = rng.uniform(0.12, 0.24)
    grille_width = 2 * front_half - rng.uniform(0.75, 0.95)
    grille = box(grille_width, grille_height, 0.1, 0.02)
    grille_y = max(lamp_y - rng.uniform(0, 0.06), low + 0.19 + grille_height / 2)
    parts += [*pair(left), Part.of("grille", grille.moved(0, grille_y, half - 0.025), black)]
    if rng.random() < 0.6:
        bar = box(grille_width - 0.04, 0.03, 0.12)
        parts.append(Part.of("grille_bar", bar.moved(0, grille_y + rng.uniform(-0.02, 0.03), half - 0.022), chrome))
    bumper = box(2 * front_half + 0.04, 0.16, 0.22, 0.05)
    parts.append(Part.of("front_bumper", bumper.moved(0, low + 0.07, half - 0.05), trim))
    back_half = float(frame.half_width(-half))
    bumper = box(2 * back_half + 0.03, 0.17, 0.2, 0.05)
    parts.append(Part.of("rear_bumper", bumper.moved(0, low + 0.09, -half + 0.05), trim))
    tall = frame.style in ("hatchback", "wagon", "suv", "van")
    tail_y = frame.deck - (0.2 if not tall else rng.uniform(0.24, 0.34))
    size = (0.14, rng.uniform(0.24, 0.36)) if tall else (rng.uniform(0.28, 0.42), 0.13)
    light = box(size[0], size[1], 0.12, 0.02).moved(back_half - size[0] / 2 - 0.03, tail_y, -half + 0.035)
    parts += pair(Part.of("left_tail_lamp", light, red))
    plate = plain((222, 214, 160), "plate")
    parts.append(Part.of("rear_plate", box(0.46, 0.12, 0.06).moved(0, low + 0.28, -half + 0.01), plate))
    parts.append(Part.of("front_plate", box(0.44, 0.1, 0.06).moved(0, low + 0.075, half + 0.045), plate))
    return parts


def _mirrors(frame: CarFrame, material: Material) -> list[Part]:
    """Outside mirrors on short arms, handles on the doors."""
    _, rear, front, cowl = frame.glass
    z = 0.75 * cowl + 0.25 * front
    out = float(frame.half_width(z))
    y = frame.belt + 0.06
    arm = sweep([(0.86 * out, y - 0.03, z), (out + 0.06, y, z)], ellipse(0.025, 0.02, 6))
    head = box(0.18, 0.12, 0.1, 0.03).moved(out + 0.09, y + 0.02, z)
    dark = plain((38, 38, 42), "arm")
    parts = [Part.of("left_mirror_arm", arm, dark), Part.of("left_mirror", head, material)]
    two = frame.style in ("coupe", "sports", "pickup")
    doors = [0.55 * front + 0.45 * rear] if two else [0.7 * front + 0.3 * rear, rear + 0.25]
    for k, door in enumerate(doors):
        handle = box(0.06, 0.035, 0.17).moved(float(frame.half_width(door)) - 0.02, frame.belt - 0.11, door)
        parts.append(Part.of(f"left_handle_{k}", handle, plain((168, 170, 176), "chrome")))
    return pair(*parts)


def _extras(rng: np.random.Generator, frame: CarFrame, paint: Colour) -> list[Part]:
    """What some cars carry: a load bed, roof rails, a spoiler, a taxi sign, an exhaust."""
    parts: list[Part] = []
    half, black = frame.length / 2, plain((36, 36, 40), "black")
    tail, rear, front, _ = frame.glass
    roof_y = frame.height
    if frame.style == "pickup":
        middle, long = (tail - 0.1 - half) / 2, tail - 0.1 + half
        inner = float(frame.half_width(middle)) * 0.93
        parts.append(Part.of("bed", box(2 * inner - 0.24, 0.1, long - 0.22).moved(0, frame.deck + 0.01, middle), black))
        wall = plain(paint, "paint")
        side = box(0.12, 0.26, long - 0.08).moved(inner - 0.06, frame.deck + 0.045, middle + 0.03)
        rail = Part.of("left_bed_wall", side, wall)
        gate = box(2 * inner - 0.2, 0.24, 0.1).moved(0, frame.deck + 0.04, -half + 0.13)
        parts += [*pair(rail), Part.of("tailgate", gate, wall)]
        if rng.random() < 0.5:
            width = inner * frame.roof * 0.98
            hoop = [(width, frame.deck, tail - 0.2), (width * 0.95, frame.height - 0.05, tail - 0.14)]
            hoop += [(-x, y, z) for x, y, z in hoop[::-1]]
            parts.append(Part.of("roll_bar", sweep(hoop, ellipse(0.04, 0.04, 8), up=(0, 0, 1)), black))
    if frame.style in ("wagon", "suv") and rng.random() < 0.65 or frame.style == "van" and rng.random() < 0.3:
        x = float(frame.half_width(0)) * frame.roof - 0.12
        bar = box(0.05, 0.12, 0.85 * (front - rear)).moved(x, roof_y + 0.03, (front + rear) / 2)
        parts += pair(Part.of("left_roof_rail", bar, black))
        if rng.random() < 0.6:
            for k, share in enumerate((0.25, 0.75)):
                cross = box(2 * x + 0.1, 0.03, 0.06).moved(0, roof_y + 0.085, rear + share * (front - rear))
                parts.append(Part.of(f"roof_bar_{k}", cross, plain((150, 152, 156), "metal")))
    if frame.style == "sports" and rng.random() < 0.65 or frame.style == "coupe" and rng.random() < 0.3:
        wide = float(frame.half_width(-half + 0.1)) * 0.9
        height = rng.uniform(0.12, 0.24)
        for_paint = plain(paint, "paint") if rng.random() < 0.5 else black
        blade = box(2 * wide, 0.04, 0.28, 0.02).moved(0, frame.deck + height, -half + 0.16)
        strut = box(0.05, height + 0.12, 0.12).moved(0.7 * wide, frame.deck + height / 2 - 0.05, -half + 0.17)
        parts += [Part.of("spoiler", blade, for_paint), *pair(Part.of("left_strut", strut, black))]
    if frame.style in ("sedan", "wagon") and rng.random() < 0.12:
        sign = tapered((0.5, 0.2), (0.42, 0.12), 0.2).moved(0, roof_y + 0.1, 0.4 * rear + 0.6 * front)
        parts.append(Part.of("roof_sign", sign, plain((236, 190, 40), "sign")))
    if rng.random() < 0.6:
        pipe = cylinder(0.045, 0.3, 10).turned("x", 90)
        pipe = pipe.moved(0.5 * frame.width / 2, frame.floor + 0.1, -half + 0.02)
        exhaust = Part.of("left_exhaust", pipe, plain((140, 142, 146), "exhaust"))
        parts += pair(exhaust) if frame.style in ("sports", "coupe") else [exhaust]
    return parts


def car(rng: np.random.Generator) -> list[Part]:
    """A car: its parts in metres, y up, front along +z, standing on y = 0."""
    frame = sample_frame(rng, pick(rng, _SHARES))
    paint = tint(rng, *pick(rng, _PAINTS), 0.08)
    cover = plain(paint, "paint") if rng.random() < 0.6 else plain((38, 38, 42), "cover")
    return [
        body(rng, frame, paint),
        *_wheels(rng, frame),
        *_ends(rng, frame, paint),
        *_mirrors(frame, cover),
        *_extras(rng, frame, paint),
    ]
