"""Meaningless marks that look like writing, numbers, labels and signs."""

from __future__ import annotations

import numpy as np

from data_gen.shapes import patterns
from data_gen.shapes.materials import Material
from data_gen.shapes.random.painting.colours import random_colour

__all__ = ["glyph", "label", "sign", "writing"]


def _two_colours(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """A background and another colour that differs from it by at least 90 in one channel's mean."""
    ground = np.array(random_colour(rng))
    ink = np.array(random_colour(rng))
    if abs(ink.mean() - ground.mean()) < 90:
        ink = np.array([20, 20, 20]) if ground.mean() > 128 else np.array([240, 240, 235])
    return ground, ink


def glyph(rng: np.random.Generator) -> np.ndarray:
    """A made-up letter: the pixels (7, 5) touched by two to four strokes between points of a lattice."""
    cells = np.zeros((7, 5), dtype=bool)
    rows, columns = (0, 3, 6), (0, 2, 4)
    row, column = int(rng.choice(rows)), int(rng.choice(columns))
    for _ in range(int(rng.integers(2, 5))):
        if rng.random() < 0.5:
            other = int(rng.choice([r for r in rows if r != row]))
            cells[min(row, other) : max(row, other) + 1, column] = True
            row = other
        else:
            other = int(rng.choice([c for c in columns if c != column]))
            cells[row, min(column, other) : max(column, other) + 1] = True
            column = other
    return cells


def _line(rng: np.random.Generator, cells: int) -> np.ndarray:
    """Words of glyphs in one line: (7, cells), boolean."""
    line, place = np.zeros((7, cells), dtype=bool), 0
    while place + 5 <= cells:
        line[:, place : place + 5] = glyph(rng)
        place += 6 if rng.random() < 0.8 else 10
    return line


def writing(rng: np.random.Generator) -> Material:
    """Lines of glyphs on a plain ground."""
    size, lines = patterns.TEXTURE_SIZE, int(rng.integers(1, 7))
    scale = max(1, size // (10 * lines))
    page = np.zeros((size, size), dtype=bool)
    for number in range(lines):
        line = np.kron(_line(rng, size // scale - 2), np.ones((scale, scale), dtype=bool))
        top = int((number + 0.5) * size / lines - 3.5 * scale)
        page[top : top + 7 * scale, scale : scale + line.shape[1]] = line[: size - top]
    ground, ink = _two_colours(rng)
    return Material("writing", np.where(page[..., None], ink, ground).astype(np.uint8))


def label(rng: np.random.Generator) -> Material:
    """A rectangle with a word in it, on a ground with a stripe or two."""
    image = writing(rng).image.copy()
    size = patterns.TEXTURE_SIZE
    ground, ink = _two_colours(rng)
    top, left = (int(rng.uniform(0.08, 0.4) * size) for _ in range(2))
    bottom, right = (int(size - rng.uniform(0.08, 0.4) * size) for _ in range(2))
    whole = np.tile(ground.astype(np.uint8), (size, size, 1))
    for _ in range(int(rng.integers(3))):
        place, width = int(rng.integers(size)), int(rng.integers(2, 14))
        whole[place : place + width] = ink
    whole[top:bottom, left:right] = image[top:bottom, left:right]
    return Material("label", whole)


def sign(rng: np.random.Generator) -> Material:
    """One large shape on a plain ground: a disc, a ring, a cross, a triangle, an arrow or a glyph."""
    v, u = (np.mgrid[0 : patterns.TEXTURE_SIZE, 0 : patterns.TEXTURE_SIZE] + 0.5) / patterns.TEXTURE_SIZE * 2 - 1
    kind, size = int(rng.integers(6)), rng.uniform(0.4, 0.85)
    if kind == 0:
        shape = np.hypot(u, v) < size
    elif kind == 1:
        shape = np.abs(np.hypot(u, v) - 0.8 * size) < 0.2 * size
    elif kind == 2:
        shape = (np.minimum(np.abs(u), np.abs(v)) < 0.3 * size) & (np.maximum(np.abs(u), np.abs(v)) < size)
    elif kind == 3:
        shape = (v < size) & (np.abs(u) < 0.6 * (v + size))
    elif kind == 4:
        shape = ((np.abs(u) < 0.25 * size) & (v > -0.2) & (v < size)) | ((v < 0) & (np.abs(u) < v + size))
    else:
        cells = glyph(rng)
        row = np.clip(((v / size + 1) / 2 * 7).astype(int), 0, 6)
        column = np.clip(((u / size + 1) / 2 * 5).astype(int), 0, 4)
        shape = cells[row, column] & (np.maximum(np.abs(u), np.abs(v)) < size)
    ground, ink = _two_colours(rng)
    return Material("sign", np.where(np.rot90(shape, int(rng.integers(4)))[..., None], ink, ground).astype(np.uint8))
