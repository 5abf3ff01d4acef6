"""The shell of a car: ONE loft from tail to nose with cut-out wheel arches.

What makes it a sedan or a van is where along the length the windows begin and end and how high they reach. Glass,
trim and the wheel wells are faces of it in other materials.
"""

from __future__ import annotations

import numpy as np

from data_gen.shapes.cars.frame import CarFrame
from data_gen.shapes.materials import Colour, Material, brighten, canvas, plain, tint
from data_gen.shapes.parts import Part
from data_gen.shapes.solids import Solid, loft

__all__ = ["body"]


def _sections(frame: CarFrame, stations: np.ndarray) -> np.ndarray:
    """Outlines (k, 20, 2) of the body at the stations: up the left side (+x) from the floor, over, down the right."""
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


def _stations(frame: CarFrame, pillars: list[float]) -> np.ndarray:
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


def _pillars(frame: CarFrame) -> list[float]:
    """Positions of the upright posts between the side windows."""
    _, rear, front, _ = frame.glass
    if frame.style in ("coupe", "sports"):
        return [rear * 0.8 + front * 0.2]
    if frame.style == "pickup":
        return [rear * 0.55 + front * 0.45]
    if frame.style == "sedan":
        return [0.55 * front + 0.45 * rear, rear - 0.05]
    return [0.62 * front + 0.38 * rear, 0.22 * front + 0.78 * rear]


def _flank(rng: np.random.Generator, frame: CarFrame, paint: Colour, pillars: list[float], solid: Solid) -> Material:
    """The painted sides, seen along x over the body's bounds: door gaps, a dark sill, a moulding, some with a decal."""
    (_, low, back), (_, high, front) = solid.vertices.min(axis=0), solid.vertices.max(axis=0)
    row, column = np.mgrid[0:80, 0:224]
    z, y = back + (column + 0.5) / 224 * (front - back), high - (row + 0.5) / 80 * (high - low)
    image = canvas(paint, 80, 224)
    sill, dark = frame.floor + 0.07, brighten(paint, 0.45)
    image[y < sill + 0.05] = brighten(paint, 0.7)
    contrast: Colour = (226, 222, 208) if sum(paint) < 400 else (40, 42, 50)
    choice = rng.random()
    middle = (sill + frame.belt) / 2
    _, rear, roof_front, cowl = frame.glass
    if choice < 0.16:
        image[np.abs(y - middle - 0.05 * (z / frame.length)) < 0.045] = contrast
    elif choice < 0.28 and frame.style in ("sports", "coupe", "hatchback"):
        centre = 0.5 * (pillars[0] + cowl)
        image[np.hypot(z - centre, y - middle) < 0.2] = contrast
        image[np.hypot(z - centre, y - middle) < 0.13] = brighten(contrast, 0.45)
    elif choice < 0.5 and frame.style == "van":
        image[(np.abs(z - 0.5 * (rear + pillars[0])) < 0.9) & (np.abs(y - middle) < 0.17)] = contrast
    elif choice < 0.6:
        image[np.abs(y - middle) < 0.022] = (150, 152, 158)
    seams = [0.8 * cowl + 0.2 * roof_front, pillars[0]]
    if frame.style not in ("coupe", "sports", "pickup"):
        seams.append(max(pillars[-1], frame.axles[0] + 1.2 * frame.wheel) if len(pillars) > 1 else rear)
    for seam in seams:
        image[(np.abs(z - seam) < 0.014) & (y > sill)] = dark
    image[(np.abs(y - sill - 0.05) < 0.012) & (z > min(seams)) & (z < max(seams))] = dark
    return Material("flank", image)


def body(rng: np.random.Generator, frame: CarFrame, paint: Colour) -> Part:
    """The shell with its glass, trim and wheel wells."""
    pillars = _pillars(frame)
    stations = _stations(frame, pillars)
    solid = loft(_sections(frame, stations), stations).projected("x").creased(28)
    middle = (stations[1:] + stations[:-1]) / 2
    along, around = solid.cells.T
    z = np.where(along >= 0, middle[along], -9.0)
    # strips of either side: 0, 1 wheel well; 2, 3 flank; 4, 5 shoulder; 6 glass; 7 rail; 8, 9 top
    strip = np.where(around <= 9, around, 18 - around)
    side = along >= 0
    part = Part.of("body", solid, plain(paint, "paint"))
    dark = plain((38, 38, 42), "underbody")
    part = part.painted(side & (strip <= 1), dark)
    part = part.painted(side & (strip >= 2) & (strip <= 5), _flank(rng, frame, paint, pillars, solid))
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
