"""Chairs: a seat, something under it to stand on, and mostly a back and arms.

Metres, y up, the sitter looks along +z, feet on y = 0.
"""

from __future__ import annotations

import numpy as np

from data_gen.shapes.chairs.backs import arms, back
from data_gen.shapes.chairs.frame import ChairFrame, Palette, sample_palette
from data_gen.shapes.chairs.legs import legs
from data_gen.shapes.choices import pick
from data_gen.shapes.parts import Part
from data_gen.shapes.primitives import box, cushion
from data_gen.shapes.solids import lathe

__all__ = ["chair"]

_KINDS = {"dining": 0.5, "lounge": 0.2, "office": 0.14, "bar": 0.08, "rocking": 0.08}


def _frame(rng: np.random.Generator) -> ChairFrame:
    """Draw the kind of chair and its measures."""
    kind = pick(rng, _KINDS)
    width, depth = rng.uniform(0.4, 0.52), rng.uniform(0.4, 0.5)
    seat, back_height, lean = rng.uniform(0.43, 0.48), rng.uniform(0.38, 0.58), rng.uniform(3, 14)
    thick = rng.uniform(0.022, 0.06)
    round_seat = False
    if kind == "lounge":
        width, depth = rng.uniform(0.52, 0.72), rng.uniform(0.52, 0.64)
        seat, thick, back_height, lean = rng.uniform(0.36, 0.44), rng.uniform(0.12, 0.2), rng.uniform(0.36, 0.5), 10.0
    elif kind == "office":
        thick, back_height = rng.uniform(0.06, 0.1), rng.uniform(0.45, 0.68)
    elif kind == "bar":
        width = depth = rng.uniform(0.34, 0.42)
        seat, back_height = rng.uniform(0.66, 0.78), rng.choice([0.0, 0.2, 0.3])
        round_seat = bool(back_height == 0 and rng.random() < 0.7)
    elif kind == "dining" and rng.random() < 0.06:
        back_height, round_seat = 0.0, True
        width = depth = rng.uniform(0.31, 0.37)
    return ChairFrame(kind, width, depth, seat, thick, float(back_height), lean, round_seat)


def _seat(rng: np.random.Generator, frame: ChairFrame, palette: Palette) -> list[Part]:
    """The seat, with a cushion on some."""
    middle = frame.seat - frame.thick / 2
    if frame.round_seat:
        r, t = frame.width / 2, frame.thick
        disc = lathe([(0.9 * r, -t / 2), (r, -0.2 * t), (r, 0.2 * t), (0.93 * r, t / 2)], 22).creased(50)
        return [Part.of("seat", disc.projected("y").moved(0, middle), palette.seat)]
    if frame.kind in ("lounge", "office"):
        slab = cushion(frame.width, frame.thick, frame.depth, rng.uniform(0.1, 0.5))
        return [Part.of("seat", slab.projected("y").moved(0, middle), palette.seat)]
    slab = box(frame.width, frame.thick, frame.depth, rng.choice([0.012, 0.04, 0.08]), 3)
    upholstered = palette.seat.name not in ("wood", "plastic")
    parts = [Part.of("seat", slab.projected("y").moved(0, middle), palette.frame if upholstered else palette.seat)]
    if upholstered:
        high = rng.uniform(0.03, 0.06)
        pad = cushion(frame.width - 0.03, high, frame.depth - 0.07, 0.4).projected("y")
        parts.append(Part.of("cushion", pad.moved(0, frame.seat + 0.28 * high, 0.02), palette.seat))
    return parts


def chair(rng: np.random.Generator) -> list[Part]:
    """A chair: its parts in metres, y up, the sitter looking along +z, standing on y = 0."""
    frame = _frame(rng)
    palette = sample_palette(rng, frame.kind)
    parts = _seat(rng, frame, palette) + legs(rng, frame, palette) + back(rng, frame, palette)
    chance = {"dining": 0.22, "lounge": 0.85, "office": 0.65, "bar": 0.0, "rocking": 0.75}[frame.kind]
    if frame.back > 0.3 and rng.random() < chance:
        parts += arms(rng, frame, palette)
    return parts
