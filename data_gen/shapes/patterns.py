"""Procedural textures: wood, woven and printed fabric, panels, rows of windows.

Each is a square image drawn with a generator; v runs upwards, so a pattern "along v" runs along a loft or a sweep.
"""

from __future__ import annotations

import numpy as np

from data_gen.shapes.choices import one_of
from data_gen.shapes.materials import Colour, Material, brighten, pixel_centres

__all__ = ["PRINTS", "checks", "dots", "lines", "noise", "print_of", "stripes", "weave", "wheel_face", "wood"]

TEXTURE_SIZE = 112
"""Width and height of a texture in pixels."""


def _mix(first: Colour, second: Colour, share: np.ndarray) -> np.ndarray:
    """Pixels (h, w, 3) uint8: `first` where the share is 0, `second` where it is 1."""
    share = np.clip(share, 0, 1)[..., None]
    return np.round((1 - share) * np.array(first) + share * np.array(second)).astype(np.uint8)


def noise(rng: np.random.Generator, cells: tuple[int, int]) -> np.ndarray:
    """Smooth noise (v, u) in [0, 1]: random values on a lattice of that many cells, interpolated."""
    lattice = rng.random((cells[0] + 1, cells[1] + 1))
    rows, columns = np.linspace(0, cells[0], TEXTURE_SIZE), np.linspace(0, cells[1], TEXTURE_SIZE)
    r, c = np.minimum(rows.astype(int), cells[0] - 1), np.minimum(columns.astype(int), cells[1] - 1)
    fr, fc = (rows - r)[:, None], (columns - c)[None]
    fr, fc = fr * fr * (3 - 2 * fr), fc * fc * (3 - 2 * fc)
    upper = lattice[r][:, c] * (1 - fc) + lattice[r][:, c + 1] * fc
    lower = lattice[r + 1][:, c] * (1 - fc) + lattice[r + 1][:, c + 1] * fc
    return upper * (1 - fr) + lower * fr


def wood(rng: np.random.Generator, colour: Colour, boards: int = 1) -> Material:
    """Grain along v, in one or several boards side by side along u with dark joints."""
    u, v = pixel_centres(TEXTURE_SIZE, TEXTURE_SIZE)
    board = np.floor(u * boards)
    warp = noise(rng, (3, 6)) + 0.35 * noise(rng, (5, 24))
    phase = rng.uniform(0, 6, boards)[board.astype(int)]
    rings = 0.5 + 0.5 * np.sin(2 * np.pi * (rng.uniform(5, 8) * u + 2.2 * warp + phase + 0.4 * v))
    fine = noise(rng, (4, 70))
    level = 0.6 * rings + 0.4 * fine
    level = level * rng.uniform(0.75, 1, boards)[board.astype(int)]
    if boards > 1:
        level = np.where(np.abs(u * boards - np.round(u * boards)) < 0.035 * boards / 4, 1.7, level)
    return Material("wood", _mix(brighten(colour, 1.12), brighten(colour, 0.62), level))


def weave(rng: np.random.Generator, colour: Colour) -> Material:
    """Coarse woven cloth: a basket pattern with soft mottling."""
    u, v = pixel_centres(TEXTURE_SIZE, TEXTURE_SIZE)
    count = int(rng.integers(9, 16))
    across, along = np.sin(np.pi * count * u) ** 2, np.sin(np.pi * count * v) ** 2
    odd = (np.floor(u * count) + np.floor(v * count)) % 2 == 0
    level = np.where(odd, across, along) * 0.7 + 0.3 * noise(rng, (8, 8))
    return Material("weave", _mix(brighten(colour, 0.7), brighten(colour, 1.15), level))


def stripes(rng: np.random.Generator, first: Colour, second: Colour) -> Material:
    """Stripes along v of unequal width."""
    u, _ = pixel_centres(TEXTURE_SIZE, TEXTURE_SIZE)
    count, share = int(rng.integers(3, 8)), rng.uniform(0.3, 0.6)
    place = (u * count + 0.25) % 1
    thin = np.abs(place - (1 + share) / 2) < 0.05
    return Material("stripes", _mix(first, second, (place < share) | thin & (rng.random() < 0.5)))


def checks(rng: np.random.Generator, first: Colour, second: Colour) -> Material:
    """Gingham: two sets of stripes whose crossings are darker."""
    u, v = pixel_centres(TEXTURE_SIZE, TEXTURE_SIZE)
    count = int(rng.integers(3, 7))
    across, along = (u * count + 0.25) % 1 < 0.5, (v * count + 0.25) % 1 < 0.5
    return Material("checks", _mix(first, second, 0.5 * across + 0.5 * along))


def dots(rng: np.random.Generator, first: Colour, second: Colour) -> Material:
    """Staggered round spots."""
    u, v = pixel_centres(TEXTURE_SIZE, TEXTURE_SIZE)
    count, radius = int(rng.integers(4, 8)), rng.uniform(0.2, 0.32)
    row = np.floor(v * count)
    x, y = (u * count + 0.5 * (row % 2)) % 1 - 0.5, v * count - row - 0.5
    return Material("dots", _mix(first, second, (radius - np.hypot(x, y)) * 12 + 0.5))


def lines(rng: np.random.Generator, first: Colour, second: Colour) -> Material:
    """Zigzag lines across v."""
    u, v = pixel_centres(TEXTURE_SIZE, TEXTURE_SIZE)
    count, teeth = int(rng.integers(4, 8)), int(rng.integers(3, 7))
    place = (v * count + 0.45 * np.abs((u * teeth) % 1 * 2 - 1)) % 1
    return Material("zigzag", _mix(first, second, place < rng.uniform(0.35, 0.55)))


PRINTS = (stripes, checks, dots, lines)
"""Patterns in two colours."""


def print_of(rng: np.random.Generator, first: Colour, second: Colour) -> Material:
    """One of the two-coloured patterns, drawn at random."""
    return one_of(rng, PRINTS)(rng, first, second)


def wheel_face(rng: np.random.Generator) -> Material:
    """Spokes on a dark rim, round and centred: for the outer side of a wheel."""
    spokes, width = int(rng.integers(4, 11)), rng.uniform(0.25, 0.6)
    y, x = (np.mgrid[0:64, 0:64] - 31.5) / 31.5
    radius, angle = np.hypot(x, y), np.arctan2(y, x)
    level = rng.uniform(0.5, 0.85)
    metal = np.array([level, level, level * 1.02])
    dark = metal * rng.uniform(0.12, 0.3)
    spoke = np.abs((angle * spokes / (2 * np.pi)) % 1 - 0.5) < width / 2
    lit = (spoke & (radius < 0.9)) | (radius > 0.84) | (radius < rng.uniform(0.22, 0.34))
    image = np.where(lit[..., None], metal, dark)
    image[radius < 0.12] = metal * 0.4
    return Material("wheel", (image * 255).clip(0, 255).round().astype(np.uint8))
