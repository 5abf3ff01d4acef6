"""Everything over a chair's seat: backs and arms."""

from __future__ import annotations

import numpy as np

from data_gen.shapes.chairs.frame import ChairFrame, Palette
from data_gen.shapes.choices import pick
from data_gen.shapes.parts import Part, pair
from data_gen.shapes.primitives import box, cushion, panel, post, rod, tube

__all__ = ["arms", "back"]

_SINK = 0.03
"""Metres by which a back reaches into the seat."""


def _posts(frame: ChairFrame, palette: Palette, size: float, top: float = 1.0) -> list[Part]:
    """The two uprights that carry a back."""
    x = frame.width / 2 - size / 2 - 0.012
    foot, head = frame.at_back(x, -_SINK / frame.back), frame.at_back(x, top)
    upright = post(foot, head, size, 0.8 * size, palette.sides)
    return pair(Part.of("left_back_post", upright, palette.frame))


def _rail(frame: ChairFrame, palette: Palette, share: float, height: float, bow: float, name: str) -> Part:
    """A bar across the back, bowed backwards in the middle."""
    x = np.linspace(frame.width / 2 - 0.03, -frame.width / 2 + 0.03, 7)
    depth = bow * (1 - (2 * x / frame.width) ** 2)
    path = [frame.at_back(float(a), share, -float(b)) for a, b in zip(x, depth, strict=True)]
    return Part.of(name, tube(path, 0.02, height, sides=4), palette.frame)


def _ladder(rng: np.random.Generator, frame: ChairFrame, palette: Palette) -> list[Part]:
    """Posts with two to five bowed slats."""
    count = int(rng.integers(2, 6))
    height = rng.uniform(0.45, 0.75) * frame.back * 0.75 / count
    bow = rng.uniform(0.0, 0.04)
    shares = np.linspace(0.32, 1 - 0.5 * height / frame.back - 0.01, count)
    slats = [_rail(frame, palette, float(share), height, bow, f"slat_{k}") for k, share in enumerate(shares)]
    return _posts(frame, palette, rng.uniform(0.03, 0.042)) + slats


def _spindles(rng: np.random.Generator, frame: ChairFrame, palette: Palette) -> list[Part]:
    """A bowed top rail on thin rods that spread upwards."""
    count = int(rng.integers(4, 9))
    bow, top = rng.uniform(0.01, 0.05), 0.93
    parts = [_rail(frame, palette, top, rng.uniform(0.05, 0.1), bow, "top_rail")]
    for k, at in enumerate(np.linspace(-1, 1, count)):
        x = float(at) * (frame.width / 2 - 0.045)
        head = frame.at_back(x, top, -bow * (1 - (2 * x / frame.width) ** 2))
        foot = frame.at_back(0.88 * x, -0.02 / frame.back)
        parts.append(Part.of(f"spindle_{k}", post(foot, head, 0.018, 0.014, 6), palette.frame))
    if rng.random() < 0.5:
        parts += _posts(frame, palette, 0.034, 0.95)
    return parts


def _panel(rng: np.random.Generator, frame: ChairFrame, palette: Palette) -> list[Part]:
    """A curved shell that rises from the seat, its head rounded off or square."""
    lean = frame.back * np.tan(np.radians(frame.lean))
    width = frame.width - 0.02
    bottom, top = width * rng.uniform(0.86, 1.0), width * rng.uniform(0.8, 1.04)
    thick, bow, roundness = rng.uniform(0.02, 0.035), rng.uniform(0.02, 0.09), rng.choice([0.0, 0.25, 0.5, 0.8])
    solid = panel(bottom, top, frame.back + _SINK, thick, bow, float(lean), roundness)
    z = -frame.depth / 2 + 0.05
    return [Part.of("back", solid.projected("z").moved(0, frame.seat - _SINK, z), palette.seat)]


def _framed(rng: np.random.Generator, frame: ChairFrame, palette: Palette) -> list[Part]:
    """Posts and rails around a crossed, splatted or filled middle."""
    size = rng.uniform(0.03, 0.042)
    parts = _posts(frame, palette, size)
    parts.append(_rail(frame, palette, 0.94, rng.uniform(0.05, 0.1), 0.0, "top_rail"))
    parts.append(_rail(frame, palette, 0.2, 0.04, 0.0, "low_rail"))
    choice, x = rng.random(), frame.width / 2 - size
    if choice < 0.35:
        first = rod(frame.at_back(x, 0.2), frame.at_back(-x, 0.94), 0.03, 0.016)
        parts.append(Part.of("brace_0", first, palette.frame))
        second = rod(frame.at_back(-x, 0.2, 0.004), frame.at_back(x, 0.94, 0.004), 0.03, 0.016)
        parts.append(Part.of("brace_1", second, palette.frame))
    elif choice < 0.65:
        wide = rng.uniform(0.3, 0.5) * frame.width
        foot, head = frame.at_back(0, 0.18), frame.at_back(0, 0.95)
        board = panel(wide * 0.7, wide, head[1] - foot[1], 0.014, 0.0, foot[2] - head[2])
        parts.append(Part.of("splat", board.projected("z").moved(*foot).moved(0, 0, 0.007), palette.frame))
    else:
        foot, head = frame.at_back(0, 0.2), frame.at_back(0, 0.93)
        pad = panel(frame.width - 0.07, frame.width - 0.07, head[1] - foot[1], 0.036, 0.0, foot[2] - head[2])
        parts.append(Part.of("pad", pad.projected("z").moved(*foot).moved(0, 0, 0.018), palette.seat))
    return parts


def _padded(rng: np.random.Generator, frame: ChairFrame, palette: Palette) -> list[Part]:
    """An upholstered slab that stands on the seat."""
    thick = rng.uniform(0.08, 0.13) * (1.25 if frame.kind == "lounge" else 0.8)
    wide = frame.width * rng.uniform(0.9, 1.0)
    pad = cushion(wide, thick, frame.back + 0.05, rng.uniform(0.2, 0.8)).turned("x", 90).projected("z")
    pad = pad.moved(0, frame.back / 2).turned("x", -frame.lean)
    return [Part.of("back", pad.moved(0, frame.seat - 0.025, -frame.depth / 2 + thick * 0.5), palette.seat)]


def _office(rng: np.random.Generator, frame: ChairFrame, palette: Palette) -> list[Part]:
    """A pad on a bracket, with a headrest on some."""
    gap = rng.uniform(0.05, 0.12)
    wide = frame.width * rng.uniform(0.85, 0.98)
    lean = 0.5 * (frame.back - gap) * 0.3
    pad = panel(wide * 0.9, wide, frame.back - gap, 0.05, 0.05, lean, rng.choice([0.2, 0.4, 0.6]))
    z = -frame.depth / 2 + 0.02
    spine = [(0, frame.under + 0.015, -0.1), (0, frame.under + 0.015, z - 0.06), (0, frame.seat + gap + 0.18, z - 0.06)]
    parts = [
        Part.of("back", pad.projected("z").moved(0, frame.seat + gap, z), palette.seat),
        Part.of("bracket", tube(spine, 0.07, 0.022, sides=4), palette.metal),
    ]
    if rng.random() < 0.35:
        top = frame.seat + frame.back
        z_top = z - lean - 0.025
        stem = rod((0, top - 0.1, z_top + 0.0), (0, top + 0.1, z_top), 0.03, 0.02)
        rest = box(0.27, 0.13, 0.06, 0.03).moved(0, top + 0.1, z_top + 0.012)
        parts += [Part.of("headrest_stem", stem, palette.metal), Part.of("headrest", rest, palette.seat)]
    return parts


_BACKS = {
    "dining": {_ladder: 2, _spindles: 1.5, _panel: 2, _framed: 2, _padded: 0.7},
    "lounge": {_padded: 3, _panel: 0.5},
    "office": {_office: 3, _padded: 0.7},
    "bar": {_panel: 1, _ladder: 1, _spindles: 0.5},
    "rocking": {_ladder: 1, _spindles: 2, _framed: 1},
}
"""How often each back is drawn, by the chair's kind."""


def back(rng: np.random.Generator, frame: ChairFrame, palette: Palette) -> list[Part]:
    """Draw a back that suits the chair's kind, and build it; nothing for a stool."""
    if frame.back == 0:
        return []
    return pick(rng, _BACKS[frame.kind])(rng, frame, palette)


def arms(rng: np.random.Generator, frame: ChairFrame, palette: Palette) -> list[Part]:
    """Armrests: upholstered blocks, boards on posts, or bent loops."""
    x, high = frame.width / 2, frame.seat + rng.uniform(0.18, 0.23)
    rear, front = -frame.depth / 2 + 0.04, frame.depth / 2 - rng.uniform(0.04, 0.12)
    if frame.kind == "lounge" and rng.random() < 0.65:
        thick = rng.uniform(0.09, 0.15)
        low, length = frame.under - 0.004, frame.depth + 0.03
        block = box(thick, high - low, length, 0.04, 2).projected("x")
        left = Part.of("left_arm", block.moved(x + thick / 2 - 0.012, (high + low) / 2, -0.008), palette.seat)
    elif frame.kind == "office" or rng.random() < 0.35:
        out = x + 0.02
        path = [(x - 0.06, frame.under + 0.02, 0.02), (out + 0.02, frame.under + 0.02, 0.02), (out + 0.02, high, 0.02)]
        stand = Part.of("left_arm_stand", tube(path, 0.05, 0.02, sides=4), palette.metal)
        rest = box(0.07, 0.03, 0.6 * frame.depth, 0.02).moved(out + 0.015, high, 0.0)
        left = Part.of("left_arm", rest, palette.metal if rng.random() < 0.3 else palette.frame)
        return [*pair(stand), *pair(left)]
    else:
        lean = (high - frame.seat) * np.tan(np.radians(frame.lean))
        rest = box(0.055, 0.026, front - rear + 0.06 + lean, 0.012)
        rest = rest.moved(x - 0.012, high, (front + rear - lean) / 2 + 0.012)
        foot, head = (x - 0.03, frame.seat - 0.02, front - 0.03), (x - 0.014, high, front - 0.01)
        stand = Part.of("left_arm_post", post(foot, head, 0.032, 0.028, palette.sides), palette.frame)
        foot, head = (x - 0.03, frame.seat - 0.02, rear + 0.03), (x - 0.016, high, rear)
        prop = Part.of("left_arm_rear_post", post(foot, head, 0.026, 0.024, palette.sides), palette.frame)
        return [*pair(stand), *pair(prop), *pair(Part.of("left_arm", rest, palette.frame))]
    return pair(left)
