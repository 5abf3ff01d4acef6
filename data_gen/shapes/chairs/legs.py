"""Everything under a chair's seat: legs, runners, pedestals, stars on casters."""

from __future__ import annotations

import numpy as np

from data_gen.shapes.chairs.frame import ChairFrame, Palette
from data_gen.shapes.choices import pick
from data_gen.shapes.materials import plain
from data_gen.shapes.parts import Part, pair
from data_gen.shapes.primitives import ball, cone, cylinder, post, rod, tapered, torus, tube
from data_gen.shapes.solids import lathe

__all__ = ["legs"]

_BITE = 0.012
"""Metres by which a part reaches into the one that it is joined to."""


def _corners(frame: ChairFrame, inset: float) -> list[tuple[str, float, float]]:
    """Where legs meet the seat: name, x and z of each."""
    if frame.kind == "lounge":
        inset += 0.06  # the cushion's lower corners are round
    x, z = frame.width / 2 - inset, frame.depth / 2 - inset
    if frame.round_seat:
        x, z = 0.72 * x, 0.72 * z
    return [("front_left", x, z), ("front_right", -x, z), ("rear_left", x, -z), ("rear_right", -x, -z)]


def _stretchers(rng: np.random.Generator, frame: ChairFrame, palette: Palette, feet: dict, heads: dict) -> list[Part]:
    """Bars between legs given by the centres of their feet and heads."""

    def along(name: str, height: float) -> tuple[float, float, float]:
        foot, head = np.array(feet[name]), np.array(heads[name])
        x, y, z = foot + (head - foot) * (height - foot[1]) / (head[1] - foot[1])
        return float(x), float(y), float(z)

    low = rng.uniform(0.25, 0.45) * frame.under
    thick = rng.uniform(0.016, 0.024)
    parts = []
    for side in ("left", "right"):
        start, end = along(f"rear_{side}", low), along(f"front_{side}", low)
        parts.append(Part.of(f"{side}_stretcher", rod(start, end, thick), palette.frame))
    if rng.random() < 0.6:
        middle = [
            (np.array(along(f"rear_{s}", low)) + np.array(along(f"front_{s}", low))) / 2 for s in ("left", "right")
        ]
        parts.append(Part.of("cross_stretcher", rod(middle[0], middle[1], thick), palette.frame))
    else:
        for end in ("rear", "front"):
            bar = rod(along(f"{end}_left", low * 1.25), along(f"{end}_right", low * 1.25), thick)
            parts.append(Part.of(f"{end}_stretcher", bar, palette.frame))
    return parts


def _four(rng: np.random.Generator, frame: ChairFrame, palette: Palette) -> list[Part]:
    """Four legs, square or round, upright or splayed, tapered downwards, often with stretchers."""
    splay = rng.uniform(0.02, 0.09) if rng.random() < 0.5 or frame.round_seat else 0.0
    size = rng.uniform(0.028, 0.05) * (1.25 if frame.kind == "lounge" else 1)
    sides = 4 if rng.random() < 0.5 else 8
    taper = rng.uniform(0.5, 1.0)
    feet, heads, parts = {}, {}, []
    for name, x, z in _corners(frame, 0.5 * size + 0.018):
        feet[name] = (x + np.sign(x) * splay, 0.0, z + np.sign(z) * splay)
        heads[name] = (x, frame.under + _BITE, z)
        parts.append(Part.of(f"{name}_leg", post(feet[name], heads[name], taper * size, size, sides), palette.frame))
    if sides == 4 and splay == 0 and not frame.round_seat:
        height = rng.uniform(0.04, 0.07)
        x_edge, z_edge = _corners(frame, 0.045)[0][1:]
        for name, wide, deep, x, z in (
            ("front", 2 * x_edge + 0.02, 0.018, 0.0, z_edge),
            ("rear", 2 * x_edge + 0.02, 0.018, 0.0, -z_edge),
            ("left", 0.018, 2 * z_edge + 0.016, x_edge, 0.0),
            ("right", 0.018, 2 * z_edge + 0.016, -x_edge, 0.0),
        ):
            tall = height if x == 0 else height - 0.006
            y = frame.under - tall / 2 + 0.004 + 0.002 * (x == 0)
            apron = tapered((wide, deep), (wide, deep), tall).moved(x, y, z)
            parts.append(Part.of(f"{name}_apron", apron, palette.frame))
    if frame.kind == "bar" or (frame.kind != "lounge" and rng.random() < 0.5):
        parts += _stretchers(rng, frame, palette, feet, heads)
    return parts


def _turned(rng: np.random.Generator, frame: ChairFrame, palette: Palette) -> list[Part]:
    """Four legs turned on a lathe, with beads and waists."""
    high = frame.under + _BITE
    stops = np.array([0, 0.06, 0.12, 0.3, 0.52, 0.58, 0.64, 0.7, 0.88, 1.0])
    radii = np.array([0.013, 0.02, 0.012, 0.02, 0.024, 0.015, 0.026, 0.015, 0.025, 0.022]) * rng.uniform(0.9, 1.2)
    leg = lathe(np.stack([radii, stops * high], 1), 8).creased(50)
    parts = [Part.of(f"{name}_leg", leg.moved(x, 0, z), palette.frame) for name, x, z in _corners(frame, 0.045)]
    points = {name: (x, 0.0, z) for name, x, z in _corners(frame, 0.045)}
    heads = {name: (x, high, z) for name, (x, _, z) in points.items()}
    return parts + _stretchers(rng, frame, palette, points, heads)


def _hairpin(rng: np.random.Generator, frame: ChairFrame, palette: Palette) -> list[Part]:
    """Four bent wires, each a V that stands on its tip."""
    parts = []
    out = rng.uniform(0.0, 0.06)
    for name, x, z in _corners(frame, 0.05):
        foot = np.array([x + np.sign(x) * out, 0.008, z + np.sign(z) * out])
        top = frame.under + _BITE
        first, second = np.array([x - np.sign(x) * 0.09, top, z]), np.array([x, top, z - np.sign(z) * 0.09])
        tip = 0.018 * (first - second) / np.linalg.norm(first - second)
        wire = tube([first, foot + tip, foot - tip, second], 0.014, sides=6)
        parts.append(Part.of(f"{name}_leg", wire, palette.metal))
    return parts


def _sled(rng: np.random.Generator, frame: ChairFrame, palette: Palette) -> list[Part]:
    """Two bent runners, joined under the seat."""
    width = rng.uniform(0.022, 0.034)
    x, z, top = frame.width / 2 - 0.035, frame.depth / 2 - 0.04, frame.under - 0.3 * width
    spread = rng.uniform(0.0, 0.05)
    foot = width / 2
    path = [(x, top, -z), (x, foot, -z - spread), (x, foot, z + spread), (x, top, z)]
    cut = [(x, top, z), (x, top, -z)]
    sides = 4 if rng.random() < 0.4 else 8
    runner = Part.of("left_runner", tube(path, width, sides=sides), palette.metal)
    bearer = Part.of("left_bearer", tube(cut, 0.96 * width, sides=sides), palette.metal)
    cross = rod((x, top, 0.5 * z), (-x, top, 0.5 * z), 0.8 * width, sides=8)
    return [*pair(runner, bearer), Part.of("bearer", cross, palette.metal)]


def _cantilever(rng: np.random.Generator, frame: ChairFrame, palette: Palette) -> list[Part]:
    """One bent tube a side that leaves the seat at the front and runs back along the floor, as in Bauhaus chairs."""
    width = rng.uniform(0.022, 0.03)
    x, z, top = frame.width / 2 - 0.02, frame.depth / 2 - 0.02, frame.under - 0.25 * width
    foot = width / 2
    bend = 0.05
    path = [
        (x, top, -z),
        (x, top, z - bend),
        (x, top - 0.3 * bend, z - 0.3 * bend),
        (x, top - bend, z),
        (x, foot + bend, z),
        (x, foot + 0.3 * bend, z - 0.3 * bend),
        (x, foot, z - bend),
        (x, foot, -z),
    ]
    side = Part.of("left_tube", tube(path, width, sides=8), palette.metal)
    floor = rod((x, foot, -z + width), (-x, foot, -z + width), 0.96 * width, sides=8)
    rail = rod((x, top, -z + 0.06), (-x, top, -z + 0.06), 0.96 * width, sides=8)
    return [*pair(side), Part.of("floor_rail", floor, palette.metal), Part.of("rail", rail, palette.metal)]


def _column(rng: np.random.Generator, frame: ChairFrame, palette: Palette) -> list[Part]:
    """A pillar on a disc or a trumpet foot."""
    radius = 0.5 * frame.width * rng.uniform(0.8, 0.98)
    top = frame.under + _BITE
    material = palette.frame if rng.random() < 0.4 else palette.metal
    if rng.random() < 0.5:
        share = np.linspace(0, 1, 8)
        flare = 0.026 + (radius - 0.03) * np.exp(-8 * share) + 0.07 * np.maximum(0, share - 0.6) ** 1.5 * 4
        profile = np.stack([flare, 0.012 + share * (top - 0.012)], 1)
        return [Part.of("foot", lathe([(radius, 0), *profile], 18).creased(50), material)]
    disc = lathe([(radius, 0), (radius, 0.012), (0.3 * radius, 0.035), (0.035, 0.05)], 20)
    pillar = cylinder(0.03, top - 0.02, 10).moved(0, top / 2 + 0.01)
    parts = [Part.of("disc", disc, material), Part.of("pillar", pillar, palette.metal)]
    if frame.kind == "bar":
        ring = torus(0.17, 0.012, 18, 6).moved(0, 0.42 * frame.seat)
        spoke = rod((-0.17, 0.42 * frame.seat, 0), (0.17, 0.42 * frame.seat, 0), 0.016)
        parts += [Part.of("footrest", ring, palette.metal), Part.of("footrest_spoke", spoke, palette.metal)]
    return parts


def _star(rng: np.random.Generator, frame: ChairFrame, palette: Palette) -> list[Part]:
    """A gas spring on a five-armed star with casters."""
    reach = 0.5 * frame.width * rng.uniform(1.05, 1.2)
    black = plain((40, 40, 44), "caster")
    arms = black if rng.random() < 0.5 else palette.metal
    parts = [Part.of("hub", cone(0.055, 0.04, 0.09, 10).moved(0, 0.11), arms)]
    for k in range(5):
        angle = np.radians(72 * k + 18)
        x, z = float(np.sin(angle)), float(np.cos(angle))
        arm = rod((0.02 * x, 0.11, 0.02 * z), (reach * x, 0.075, reach * z), 0.042, 0.03, sides=4)
        x, z = 0.96 * reach * x, 0.96 * reach * z
        wheel = ball(0.028, 0.028, 0.028, 8, 6).moved(x, 0.028, z)
        fork = post((x, 0.03, z), (x, 0.075, z), 0.018, 0.018)
        for name, solid, material in (("arm", arm, arms), ("caster", wheel, black), ("fork", fork, black)):
            parts.append(Part.of(f"star_{name}_{k}", solid, material))
    low, high = 0.12, frame.under
    sleeve = cylinder(0.034, 0.55 * (high - low), 10).moved(0, low + 0.275 * (high - low))
    parts.append(Part.of("sleeve", sleeve, black))
    parts.append(Part.of("spring", cylinder(0.02, high - low, 8).moved(0, (high + low) / 2 + 0.01), palette.metal))
    mount = tapered((0.12, 0.16), (0.24, 0.28), 0.04).moved(0, high - 0.012)
    return [*parts, Part.of("mount", mount, black)]


def _rockers(rng: np.random.Generator, frame: ChairFrame, palette: Palette) -> list[Part]:
    """Four legs on two curved runners."""
    size = rng.uniform(0.032, 0.044)
    x, z = frame.width / 2 - 0.04, frame.depth / 2 - 0.05
    radius, half = rng.uniform(0.95, 1.2), frame.depth / 2 + rng.uniform(0.14, 0.2)

    def height(at: np.ndarray | float) -> np.ndarray:
        return 0.02 + radius - np.sqrt(radius**2 - np.asarray(at) ** 2)

    along = np.linspace(-half - 0.08, half, 9)
    path = np.stack([np.full(9, x), height(along), along], 1)
    parts = pair(Part.of("left_rocker", tube(path, 0.032, 0.04, sides=4), palette.frame))
    for end, at in (("front", z), ("rear", -z)):
        foot = (x, float(height(at)) - 0.005, at)
        leg = Part.of(f"{end}_left_leg", post(foot, (x, frame.under + _BITE, at), 0.8 * size, size, 8), palette.frame)
        bar = rod((x, 0.5 * frame.under, at), (-x, 0.5 * frame.under, at), 0.02)
        parts += [*pair(leg), Part.of(f"{end}_stretcher", bar, palette.frame)]
    return parts


_LEGS = {
    "dining": {_four: 4, _turned: 1.5, _hairpin: 1, _sled: 1, _cantilever: 1.2, _column: 0.8},
    "lounge": {_four: 4, _hairpin: 0.6, _sled: 1, _column: 0.6},
    "office": {_star: 1},
    "bar": {_four: 2, _column: 1.5, _sled: 0.5},
    "rocking": {_rockers: 1},
}
"""How often each way to stand is drawn, by the chair's kind."""


def legs(rng: np.random.Generator, frame: ChairFrame, palette: Palette) -> list[Part]:
    """Draw a way to stand that suits the chair's kind, and build it."""
    build = pick(rng, _LEGS[frame.kind])
    if frame.round_seat and build in (_sled, _cantilever):
        build = _four
    return build(rng, frame, palette)
