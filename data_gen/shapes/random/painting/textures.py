"""Random textures: plain colours, noise of several octaves, patterns in any direction, wood, cloth, photographs, marks.

Images are square and small; u runs around a solid and v along it, as in `data_gen.shapes.patterns`.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from data_gen.shapes import patterns
from data_gen.shapes.choices import pick
from data_gen.shapes.materials import Material, plain
from data_gen.shapes.random.painting.colours import near, random_colour
from data_gen.shapes.random.painting.marks import label, sign, writing
from data_gen.shapes.random.painting.photographs import photograph

__all__ = ["TEXTURES", "octaves", "random_material"]


def octaves(rng: np.random.Generator, coarsest: int, count: int) -> np.ndarray:
    """Noise of several octaves, each of half the cells and half the strength, stretched to [0, 1]."""
    total, strength = np.zeros((patterns.TEXTURE_SIZE, patterns.TEXTURE_SIZE)), 1.0
    for octave in range(count):
        cells = min(coarsest << octave, patterns.TEXTURE_SIZE // 2)
        total += strength * patterns.noise(rng, (cells, cells))
        strength *= 0.55
    total -= total.min()
    return total / max(total.max(), 1e-9)


def _ramp(rng: np.random.Generator, level: np.ndarray, count: int) -> np.ndarray:
    """Pixels (h, w, 3) uint8: levels in [0, 1] along a line of that many random colours."""
    colours = np.array([random_colour(rng) for _ in range(count)], dtype=float)
    places = np.linspace(0, 1, count)
    pixels = np.stack([np.interp(level, places, colours[:, channel]) for channel in range(3)], axis=-1)
    return np.round(pixels).astype(np.uint8)


def _place(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Coordinates (u, v), each (size, size), turned by a random angle and in half of all cases bent by noise."""
    row, column = (np.mgrid[0 : patterns.TEXTURE_SIZE, 0 : patterns.TEXTURE_SIZE] + 0.5) / patterns.TEXTURE_SIZE
    angle = rng.choice([0.0, np.pi / 4, rng.uniform(0, np.pi)])
    u = np.cos(angle) * column + np.sin(angle) * row
    v = np.cos(angle) * row - np.sin(angle) * column
    if rng.random() < 0.5:
        strength, cells = rng.uniform(0.02, 0.2), int(rng.integers(2, 6))
        u = u + strength * patterns.noise(rng, (cells, cells))
        v = v + strength * patterns.noise(rng, (cells, cells))
    return u, v


def _speckled(rng: np.random.Generator, pixels: np.ndarray) -> np.ndarray:
    """The pixels with fine noise on them, in half of all cases."""
    if rng.random() < 0.5:
        return pixels
    grain = rng.uniform(0.05, 0.3) * (octaves(rng, 16, 2) - 0.5)
    return np.clip(np.round(pixels * (1 + grain[..., None])), 0, 255).astype(np.uint8)


def plain_colour(rng: np.random.Generator) -> Material:
    """One colour."""
    return plain(random_colour(rng))


def grain(rng: np.random.Generator) -> Material:
    """One colour, a little lighter and darker from place to place."""
    colour = np.array(random_colour(rng), dtype=float)
    level = octaves(rng, int(rng.integers(2, 20)), int(rng.integers(1, 4))) - 0.5
    pixels = colour * (1 + rng.uniform(0.2, 0.7) * level[..., None])
    return Material("grain", np.clip(np.round(pixels), 0, 255).astype(np.uint8))


def clouds(rng: np.random.Generator) -> Material:
    """Noise of several octaves between two to four colours."""
    level = octaves(rng, int(rng.integers(2, 9)), int(rng.integers(2, 6)))
    return Material("clouds", _ramp(rng, level, int(rng.integers(2, 5))))


def blotches(rng: np.random.Generator) -> Material:
    """Spots of two or three colours with sharp edges."""
    level = octaves(rng, int(rng.integers(2, 10)), int(rng.integers(1, 4)))
    count = int(rng.integers(2, 4))
    level = np.clip(np.floor(level * count), 0, count - 1) / (count - 1)
    return Material("blotches", _speckled(rng, _ramp(rng, level, count)))


def marble(rng: np.random.Generator) -> Material:
    """Veins: a sine of one coordinate bent by noise."""
    u, _ = _place(rng)
    warp = octaves(rng, 3, 4)
    level = 0.5 + 0.5 * np.sin(2 * np.pi * (rng.uniform(1, 5) * u + rng.uniform(0.5, 2.5) * warp))
    return Material("marble", _ramp(rng, level ** rng.uniform(0.6, 3), int(rng.integers(2, 4))))


def gradient(rng: np.random.Generator) -> Material:
    """Two or three colours that run into each other."""
    u, v = _place(rng)
    level = u if rng.random() < 0.6 else np.hypot(u - 0.5, v - 0.5)
    level = (level - level.min()) / np.ptp(level)
    return Material("gradient", _speckled(rng, _ramp(rng, level, int(rng.integers(2, 4)))))


def pattern(rng: np.random.Generator) -> Material:
    """Stripes, checks, dots, rings, bricks or triangles, in any direction."""
    u, v = _place(rng)
    count, share = rng.uniform(2, 10), rng.uniform(0.2, 0.7)
    kind = int(rng.integers(6))
    if kind == 0:
        level = (u * count) % 1 < share
    elif kind == 1:
        level = (np.floor(u * count) + np.floor(v * count)) % 2
    elif kind == 2:
        level = np.hypot((u * count) % 1 - 0.5, (v * count) % 1 - 0.5) < 0.2 + 0.28 * share
    elif kind == 3:
        centre = rng.uniform(0, 1, 2)
        level = (np.hypot(u - centre[0], v - centre[1]) * count) % 1 < share
    elif kind == 4:
        row = np.floor(v * 2 * count)
        joint = 0.06 + 0.1 * share
        level = (((u * count + 0.5 * (row % 2)) % 1) < joint / 2) | ((v * 2 * count) % 1 < joint)
    else:
        level = (u * count) % 1 < (v * count) % 1
    return Material("pattern", _speckled(rng, _ramp(rng, np.asarray(level, dtype=float), 2)))


def wood(rng: np.random.Generator) -> Material:
    """Wood of any colour, in one to four boards."""
    return patterns.wood(rng, random_colour(rng), int(rng.integers(1, 5)))


def cloth(rng: np.random.Generator) -> Material:
    """Woven cloth, or cloth printed in two colours."""
    colour = random_colour(rng)
    if rng.random() < 0.5:
        return patterns.weave(rng, colour)
    return patterns.print_of(rng, colour, random_colour(rng) if rng.random() < 0.7 else near(rng, colour, 40))


TEXTURES: dict[Callable[[np.random.Generator], Material], float] = {
    plain_colour: 2.5,
    grain: 2.0,
    clouds: 2.0,
    blotches: 1.2,
    marble: 1.0,
    gradient: 0.8,
    pattern: 2.2,
    wood: 1.0,
    cloth: 0.8,
    photograph: 2.0,
    writing: 0.6,
    label: 0.6,
    sign: 0.4,
}
"""Relative frequencies."""


def random_material(rng: np.random.Generator) -> Material:
    """One of `TEXTURES`."""
    return pick(rng, TEXTURES)(rng)
