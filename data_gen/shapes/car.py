"""Cars: a lofted body with cut-out wheel arches and painted glass, on wheels, with lights, mirrors and extras.

Metres, y up, front along +z (so +x is the car's left), wheels standing on y = 0. The body is ONE loft from tail to nose; what
makes it a sedan or a van is where along the length the windows begin and end and how high they reach. Glass, trim and the
wheel wells are faces of it in other materials.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from data_gen.shapes.materials import Colour, Material, plain, shade, tint
from data_gen.shapes.parts import Part
from data_gen.shapes.patterns import wheel_face
from data_gen.shapes.primitives import ball, box, cylinder, tapered
from data_gen.shapes.profiles import ellipse
from data_gen.shapes.solids import Solid, lathe, loft, sweep

__all__ = ["STYLES", "car"]


@dataclass(frozen=True)
class Style:
    """Proportions of a body; every pair is the range a value is drawn from.

    Attributes:
        length: Metres.
        width: Metres, without mirrors.
        height: Metres, ground to roof.
        glass: Where glass begins and ends as fractions of the length from the tail: foot of the rear window, rear end of
            the roof, front end of the roof, foot of the windscreen.
        belt: Height of the window sills as a fraction of the height.
        deck: Height of the tail's lid as a fraction of the height.
        nose: Height of the bonnet's front edge as a fraction of the height.
        clearance: Metres under the floor.
        wheel: Outer radius of the tyres in metres.
        roof: Width of the roof as a fraction of the body's.
    """

    length: tuple[float, float]
    width: tuple[float, float]
    height: tuple[float, float]
    glass: tuple[float, float, float, float]
    belt: float
    deck: float
    nose: float
    clearance: float
    wheel: tuple[float, float]
    roof: float


STYLES: dict[str, Style] = {
    "sedan": Style(
        (4.5, 5.0), (1.78, 1.9), (1.42, 1.52), (0.15, 0.31, 0.56, 0.71), 0.62, 0.66, 0.5, 0.2, (0.32, 0.35), 0.74
    ),
    "coupe": Style(
        (4.2, 4.6), (1.78, 1.88), (1.3, 1.38), (0.1, 0.34, 0.52, 0.68), 0.64, 0.66, 0.5, 0.17, (0.33, 0.36), 0.7
    ),
    "hatchback": Style(
        (3.7, 4.2), (1.68, 1.8), (1.45, 1.56), (0.015, 0.14, 0.6, 0.76), 0.6, 0.62, 0.52, 0.19, (0.3, 0.33), 0.76
    ),
    "wagon": Style(
        (4.5, 4.9), (1.78, 1.88), (1.45, 1.55), (0.012, 0.075, 0.57, 0.71), 0.6, 0.62, 0.5, 0.2, (0.32, 0.35), 0.77
    ),
    "suv": Style(
        (4.4, 4.9), (1.85, 2.0), (1.7, 1.88), (0.012, 0.06, 0.58, 0.7), 0.6, 0.62, 0.54, 0.28, (0.37, 0.42), 0.8
    ),
    "van": Style(
        (4.6, 5.3), (1.85, 2.0), (1.9, 2.2), (0.008, 0.022, 0.74, 0.88), 0.54, 0.56, 0.44, 0.22, (0.33, 0.36), 0.86
    ),
    "pickup": Style(
        (5.0, 5.5), (1.85, 2.0), (1.72, 1.85), (0.4, 0.435, 0.6, 0.72), 0.62, 0.58, 0.56, 0.3, (0.38, 0.43), 0.79
    ),
    "sports": Style(
        (4.1, 4.5), (1.85, 1.98), (1.12, 1.22), (0.08, 0.36, 0.49, 0.67), 0.66, 0.7, 0.47, 0.13, (0.33, 0.36), 0.66
    ),
}
"""Body styles by name."""

_PAINTS: tuple[tuple[float, float, float, float], ...] = (  # hue, saturation, value, weight
    (0.0, 0.85, 0.75, 3.0),
    (0.6, 0.75, 0.65, 3.0),
    (0.13, 0.85, 0.92, 1.6),
    (0.07, 0.85, 0.88, 1.4),
    (0.36, 0.6, 0.45, 1.4),
    (0.5, 0.6, 0.6, 1.2),
    (0.0, 0.03, 0.66, 1.6),
    (0.62, 0.12, 0.35, 1.4),
    (0.0, 0.05, 0.16, 1.2),
    (0.95, 0.7, 0.45, 0.9),
    (0.58, 0.4, 0.85, 1.0),
    (0.09, 0.35, 0.72, 0.8),
    (0.78, 0.45, 0.5, 0.6),
    (0.24, 0.65, 0.7, 0.8),
)


@dataclass(frozen=True)
class Frame:
    """Measures of one car that its parts share, in metres; z from the tail at -length / 2 to the nose."""

    style: str
    length: float
    width: float
    height: float
    floor: float
    belt: float
    deck: float
    nose: float
    cowl: float
    roof: float
    glass: np.ndarray
    wheel: float
    axles: tuple[float, float]

    def half_width(self, z: float | np.ndarray) -> np.ndarray:
        """Half of the body's width at z: full amidships, drawn in at both ends."""
        at = np.array([0, 0.015, 0.06, 0.16, 0.84, 0.94, 0.985, 1]) - 0.5
        blunt = 0.96 if self.style in ("van", "suv", "pickup") else 0.9
        share = np.array([blunt - 0.05, blunt, 0.97, 1, 1, 0.965, blunt - 0.02, blunt - 0.1])
        return np.interp(z, at * self.length, share * self.width / 2)

    def top(self, z: float | np.ndarray) -> np.ndarray:
        """Height of the silhouette at z, seen from the side."""
        tail, rear, front, cowl = self.glass
        half = self.length / 2
        bonnet = 0.45 * cowl + 0.55 * half
        at = [-half, -half + 0.06, tail, rear, (rear + front) / 2, front, cowl, bonnet, half - 0.12, half]
        lid = self.deck
        highs = [lid - 0.1, lid - 0.01, lid, self.height - 0.03, self.height, self.height - 0.04, self.cowl]
        highs += [self.cowl * 0.7 + self.nose * 0.3 + 0.02, self.nose, self.nose - 0.12]
        return np.interp(z, np.maximum.accumulate(np.array(at)), highs)

    def arch(self, z: np.ndarray) -> np.ndarray:
        """Height of the wheel arches over the ground at z; 0 away from them."""
        radius = 1.16 * self.wheel
        rise = [np.sqrt(np.maximum(0, radius**2 - (z - axle) ** 2)) for axle in self.axles]
        return np.max([np.where(r > 0, self.wheel + r, 0) for r in rise], axis=0)


def _frame(rng: np.random.Generator, name: str) -> Frame:
    """Draw the measures of a car of the named style."""
    style = STYLES[name]
    length, width, height = rng.uniform(*style.length), rng.uniform(*style.width), rng.uniform(*style.height)
    glass = (np.array(style.glass) + rng.uniform(-0.012, 0.012, 4) * (np.array(style.glass) > 0.05) - 0.5) * length
    wheel = rng.uniform(*style.wheel)
    overhang = rng.uniform(0.17, 0.2), rng.uniform(0.16, 0.19)
    belt = (style.belt + rng.uniform(-0.02, 0.02)) * height
    return Frame(
        style=name,
        length=length,
        width=width,
        height=height,
        floor=style.clearance,
        belt=belt,
        deck=style.deck * height + rng.uniform(-0.01, 0.02),
        nose=(style.nose + rng.uniform(-0.02, 0.03)) * height,
        cowl=belt + rng.uniform(0.01, 0.05),
        roof=style.roof,
        glass=glass,
        wheel=wheel,
        axles=(-length / 2 + overhang[0] * length, length / 2 - overhang[1] * length),
    )


def _sections(frame: Frame, stations: np.ndarray) -> np.ndarray:
    """Outlines (k, 20, 2) of the body at the stations: up the left side (+x) from the floor, over, and down the right."""
    half = frame.half_width(stations)
    top = frame.top(stations)
    end = np.abs(stations) / (frame.length / 2)
    floor = frame.floor + 0.12 * np.clip((end - 0.9) / 0.1, 0, 1)
    arch = np.maximum(frame.arch(stations), floor)
    belt = np.minimum(frame.belt, top - 0.05)
    rise = top - belt
    cabin = np.clip((rise - 0.05) / (frame.height - frame.belt - 0.05), 0, 1)
    lower = np.maximum(floor + 0.42 * (belt - floor), arch + 0.025)
    inner = half - 0.3
    roof = half * frame.roof
    sill = 0.93 * half

    def across(bonnet: np.ndarray, glasshouse: np.ndarray) -> np.ndarray:
        return bonnet * (1 - cabin) + glasshouse * cabin

    points = [
        (inner, floor - 0.01),
        (inner + 0.01, np.maximum(arch - 0.01, floor - 0.005)),
        (0.965 * half, arch),
        (half, lower),
        (0.985 * half, np.maximum(belt - 0.1, lower + 0.02)),
        (sill, np.maximum(belt, lower + 0.03)),
        (sill - 0.02, np.maximum(belt + across(0.1 * rise, np.full_like(rise, 0.025)), lower + 0.04)),
        (across(sill - 0.06, roof + 0.035), belt + 0.8 * rise + 0.05 * rise * cabin),
        (across(sill - 0.12, roof - 0.04), belt + 0.97 * rise),
        (across(0.3 * sill, 0.3 * roof), top + 0.03),
    ]
    left = np.stack([np.stack(point, -1) for point in points], 1)
    return np.concatenate([left, left[:, ::-1] * [-1, 1]], axis=1)


def _stations(frame: Frame, pillars: list[float]) -> np.ndarray:
    """Where along z the body has a section: bends of the silhouette, window posts, and around the wheel arches."""
    half = frame.length / 2
    fixed = [-half, -half + 0.06, half - 0.12, half, 0.45 * frame.glass[3] + 0.55 * half, *frame.glass]
    posts = [edge for post in pillars for edge in (post - 0.035, post + 0.035)]
    radius = 1.16 * frame.wheel
    turn = np.cos(np.radians([4, 28, 60, 90, 120, 152, 176]))
    arches = [axle + radius * np.concatenate([[1.004], turn, [-1.004]]) for axle in frame.axles]
    stations = np.unique(np.concatenate([fixed, posts, *arches]))
    arch_only = np.unique(np.concatenate(arches))
    keep = [stations[0]]
    for z in stations[1:]:
        if z - keep[-1] > 0.004 or z in arch_only:
            keep.append(z)
    return np.array(keep)


def _pillars(frame: Frame) -> list[float]:
    """Positions of the upright posts between the side windows."""
    _, rear, front, _ = frame.glass
    if frame.style in ("coupe", "sports"):
        return [rear * 0.8 + front * 0.2]
    if frame.style == "pickup":
        return [rear * 0.55 + front * 0.45]
    if frame.style == "sedan":
        return [0.55 * front + 0.45 * rear, rear - 0.05]
    return [0.62 * front + 0.38 * rear, 0.22 * front + 0.78 * rear]


def _body(rng: np.random.Generator, frame: Frame, paint: Colour) -> Part:
    """The shell with its glass, trim and wheel wells."""
    pillars = _pillars(frame)
    stations = _stations(frame, pillars)
    solid = loft(_sections(frame, stations), stations).creased(28)
    middle = (stations[1:] + stations[:-1]) / 2
    along, around = solid.cells.T
    z = np.where(along >= 0, middle[along], -9.0)
    strip = np.where(
        around <= 9, around, 18 - around
    )  # 0, 1 wheel well; 2, 3 flank; 4, 5 shoulder; 6 glass; 7 rail; 8, 9 top
    side = along >= 0
    part = Part.of("body", solid, plain(paint, "paint"))
    dark = plain((38, 38, 42), "underbody")
    part = part.painted(side & (strip <= 1), dark)
    tail, rear, front, cowl = frame.glass
    post = np.min([np.abs(z - p) for p in pillars], axis=0) < 0.04
    cargo = frame.style == "van" and rng.random() < 0.5
    window_end = front - 0.9 if cargo else tail
    window = side & (strip == 6) & (z < cowl) & (z > window_end) & ~post
    glass = plain(tint(rng, 0.58, 0.3, 0.24, 0.05), "glass")
    screens = side & (strip >= 8) & (((z < cowl) & (z > front)) | ((z > tail) & (z < rear)))
    part = part.painted(window | screens, glass)
    choice = rng.random()
    roof = side & (strip >= 7) & (z > rear) & (z < front)
    if choice < 0.2 and frame.style in ("hatchback", "suv", "coupe", "sports"):
        part = part.painted(roof, plain((30, 30, 34) if sum(paint) > 200 else (205, 205, 205), "roof"))
    elif choice < 0.45 and frame.style in ("sports", "coupe", "hatchback"):
        stripe = plain((232, 232, 228) if sum(paint) < 420 else (28, 28, 32), "stripe")
        part = part.painted(side & (strip == 9) & ~screens, stripe)
    elif choice < 0.6 and frame.style in ("van", "pickup", "wagon", "suv"):
        part = part.painted(side & (strip == 2), plain(tint(rng, rng.random(), 0.25, 0.5), "two_tone"))
    if frame.style == "suv" or (frame.style == "wagon" and choice > 0.8):
        part = part.painted(side & (strip == 2), plain((58, 58, 60), "cladding"))
    return part


def _wheels(rng: np.random.Generator, frame: Frame) -> list[Part]:
    """Four tyres with rims, their outer faces a little outside the flanks."""
    radius, width = frame.wheel, 0.21
    rubber = plain((27, 27, 29), "rubber")
    alloy = wheel_face(rng)
    rim_share = rng.uniform(0.66, 0.76)
    tyre = lathe(
        [(0.9 * radius, -width / 2), (radius, -0.34 * width), (radius, 0.34 * width), (0.9 * radius, width / 2)], 18
    )
    rim = lathe([(rim_share * radius, -0.05), (rim_share * radius, 0.004), (0.25 * radius, 0.016), (0, 0.02)], 16)
    parts = []
    for where, axle in zip(("rear", "front"), frame.axles, strict=True):
        outside = frame.width / 2 + 0.005 - width / 2
        wheel = Part.of(f"{where}_left_tyre", tyre.turned("z", -90).moved(outside, radius, axle), rubber)
        face = Part.of(
            f"{where}_left_rim", rim.turned("z", -90).projected("x").moved(outside + width / 2, radius, axle), alloy
        )
        hub = Part.of(
            f"{where}_axle",
            cylinder(0.09, 2 * outside, 8).turned("z", 90).moved(0, radius, axle),
            rubber,
        )
        parts += [wheel, face, wheel.mirrored(), face.mirrored(), hub]
    return parts


def _ends(rng: np.random.Generator, frame: Frame, paint: Colour) -> list[Part]:
    """Lamps, grille, bumpers and number plates."""
    half = frame.length / 2
    parts: list[Part] = []
    lamp = plain((244, 240, 214), "headlamp")
    red = plain((190, 24, 28), "tail_lamp")
    black = plain((33, 33, 36), "grille")
    chrome = plain((176, 180, 186), "chrome")
    trim = plain(shade(paint, 0.55), "bumper") if rng.random() < 0.5 else black
    front_half = float(frame.half_width(half))
    low = frame.floor + 0.12
    lamp_y = frame.nose - 0.21
    if rng.random() < 0.4:
        light = ball(0.1, 0.09, 0.08, 12, 6)
    else:
        light = box(rng.uniform(0.24, 0.34), rng.uniform(0.1, 0.16), 0.16, 0.03)
    left = Part.of("left_headlamp", light.moved(front_half - 0.16, lamp_y, half - 0.03), lamp)
    grille_height = rng.uniform(0.12, 0.24)
    grille = box(2 * front_half - rng.uniform(0.75, 0.95), grille_height, 0.1, 0.02)
    grille_y = max(lamp_y - rng.uniform(0, 0.06), low + 0.19 + grille_height / 2)
    parts += [left, left.mirrored(), Part.of("grille", grille.moved(0, grille_y, half - 0.025), black)]
    if rng.random() < 0.6:
        bar = box(2 * front_half - 0.8, 0.03, 0.12)
        parts.append(Part.of("grille_bar", bar.moved(0, grille_y + rng.uniform(-0.02, 0.03), half - 0.028), chrome))
    bumper = box(2 * front_half + 0.04, 0.16, 0.22, 0.05)
    parts.append(Part.of("front_bumper", bumper.moved(0, low + 0.07, half - 0.05), trim))
    back_half = float(frame.half_width(-half))
    parts.append(
        Part.of("rear_bumper", box(2 * back_half + 0.03, 0.17, 0.2, 0.05).moved(0, low + 0.09, -half + 0.05), trim)
    )
    tall = frame.style in ("hatchback", "wagon", "suv", "van")
    tail_y = frame.deck - (0.2 if not tall else rng.uniform(0.24, 0.34))
    size = (0.14, rng.uniform(0.24, 0.36)) if tall else (rng.uniform(0.28, 0.42), 0.13)
    light = box(size[0], size[1], 0.12, 0.02).moved(back_half - size[0] / 2 - 0.03, tail_y, -half + 0.035)
    tail = Part.of("left_tail_lamp", light, red)
    plate = plain((222, 214, 160), "plate")
    parts += [tail, tail.mirrored()]
    parts.append(Part.of("rear_plate", box(0.46, 0.12, 0.06).moved(0, low + 0.28, -half + 0.01), plate))
    parts.append(Part.of("front_plate", box(0.44, 0.1, 0.06).moved(0, low + 0.075, half + 0.045), plate))
    return parts


def _mirrors(frame: Frame, material: Material) -> list[Part]:
    """Outside mirrors on short arms, handles on the doors."""
    _, rear, front, cowl = frame.glass
    z = 0.75 * cowl + 0.25 * front
    out = float(frame.half_width(z))
    y = frame.belt + 0.06
    arm = sweep([(0.86 * out, y - 0.03, z), (out + 0.06, y, z)], ellipse(0.025, 0.02, 6))
    head = box(0.18, 0.12, 0.1, 0.03).moved(out + 0.09, y + 0.02, z)
    dark = plain((38, 38, 42), "arm")
    parts = [Part.of("left_mirror_arm", arm, dark), Part.of("left_mirror", head, material)]
    doors = (
        [0.55 * front + 0.45 * rear]
        if frame.style in ("coupe", "sports", "pickup")
        else [0.7 * front + 0.3 * rear, rear + 0.25]
    )
    for k, door in enumerate(doors):
        handle = box(0.06, 0.035, 0.17).moved(float(frame.half_width(door)) - 0.02, frame.belt - 0.11, door)
        parts.append(Part.of(f"left_handle_{k}", handle, plain((168, 170, 176), "chrome")))
    return parts + [part.mirrored() for part in parts]


def _extras(rng: np.random.Generator, frame: Frame, paint: Colour) -> list[Part]:
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
        rail = Part.of(
            "left_bed_wall", box(0.12, 0.26, long - 0.08).moved(inner - 0.06, frame.deck + 0.045, middle + 0.03), wall
        )
        gate = box(2 * inner - 0.2, 0.24, 0.1).moved(0, frame.deck + 0.04, -half + 0.13)
        parts += [rail, rail.mirrored(), Part.of("tailgate", gate, wall)]
        if rng.random() < 0.5:
            width = inner * frame.roof * 0.98
            hoop = [(width, frame.deck, tail - 0.2), (width * 0.95, frame.height - 0.05, tail - 0.14)]
            hoop += [(-x, y, z) for x, y, z in hoop[::-1]]
            parts.append(Part.of("roll_bar", sweep(hoop, ellipse(0.04, 0.04, 8), up=(0, 0, 1)), black))
    if frame.style in ("wagon", "suv") and rng.random() < 0.65 or frame.style == "van" and rng.random() < 0.3:
        x = float(frame.half_width(0)) * frame.roof - 0.12
        bar = Part.of(
            "left_roof_rail", box(0.05, 0.12, 0.85 * (front - rear)).moved(x, roof_y + 0.03, (front + rear) / 2), black
        )
        parts += [bar, bar.mirrored()]
        if rng.random() < 0.6:
            for k, share in enumerate((0.25, 0.75)):
                cross = box(2 * x + 0.1, 0.03, 0.06).moved(0, roof_y + 0.075, rear + share * (front - rear))
                parts.append(Part.of(f"roof_bar_{k}", cross, plain((150, 152, 156), "metal")))
    if frame.style == "sports" and rng.random() < 0.65 or frame.style == "coupe" and rng.random() < 0.3:
        wide = float(frame.half_width(-half + 0.1)) * 0.9
        height = rng.uniform(0.12, 0.24)
        for_paint = plain(paint, "paint") if rng.random() < 0.5 else black
        blade = box(2 * wide, 0.04, 0.28, 0.02).moved(0, frame.deck + height, -half + 0.16)
        strut = Part.of(
            "left_strut",
            box(0.05, height + 0.12, 0.12).moved(0.7 * wide, frame.deck + height / 2 - 0.05, -half + 0.17),
            black,
        )
        parts += [Part.of("spoiler", blade, for_paint), strut, strut.mirrored()]
    if frame.style in ("sedan", "wagon") and rng.random() < 0.12:
        sign = tapered((0.5, 0.2), (0.42, 0.12), 0.2).moved(0, roof_y + 0.1, 0.4 * rear + 0.6 * front)
        parts.append(Part.of("roof_sign", sign, plain((236, 190, 40), "sign")))
    if rng.random() < 0.6:
        pipe: Solid = (
            cylinder(0.045, 0.3, 10).turned("x", 90).moved(0.5 * frame.width / 2, frame.floor + 0.1, -half + 0.02)
        )
        exhaust = Part.of("left_exhaust", pipe, plain((140, 142, 146), "exhaust"))
        parts += [exhaust, exhaust.mirrored()] if frame.style in ("sports", "coupe") else [exhaust]
    return parts


def car(rng: np.random.Generator) -> list[Part]:
    """A car.

    Args:
        rng: Source of every choice.

    Returns:
        Its parts in metres, y up, front along +z, standing on y = 0.
    """
    names = list(STYLES)
    frame = _frame(rng, names[rng.choice(len(names), p=np.array([3, 1.5, 2.5, 1.5, 2.5, 1.5, 1.5, 2]) / 16)])
    weights = np.array([paint[3] for paint in _PAINTS])
    hue, saturation, value, _ = _PAINTS[rng.choice(len(_PAINTS), p=weights / weights.sum())]
    paint = tint(rng, hue, saturation, value, 0.08)
    cover = plain(paint, "paint") if rng.random() < 0.6 else plain((38, 38, 42), "cover")
    return [
        _body(rng, frame, paint),
        *_wheels(rng, frame),
        *_ends(rng, frame, paint),
        *_mirrors(frame, cover),
        *_extras(rng, frame, paint),
    ]
