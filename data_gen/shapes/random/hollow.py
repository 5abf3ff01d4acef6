"""Open and hollow solids: walls with a thickness, so that they are closed surfaces all the same."""

from __future__ import annotations

import numpy as np

from data_gen.shapes.profiles import ellipse, rectangle
from data_gen.shapes.random.outlines import OUTLINE_CORNERS, outline
from data_gen.shapes.random.tubes import bar, subdivided, surface
from data_gen.shapes.solids import Solid, merged

__all__ = ["arch", "pipe", "vessel", "wire_cage"]


def _section(rng: np.random.Generator) -> tuple[np.ndarray, float]:
    """A circle, a square or any outline (OUTLINE_CORNERS, 2), and the crease angle that suits it."""
    draw = rng.random()
    if draw < 0.45:
        return ellipse(1.0, 1.0, OUTLINE_CORNERS), 45.0
    if draw < 0.75:
        return subdivided(rectangle(2.0, 2.0), OUTLINE_CORNERS), 40.0
    return outline(rng)


def _rings(section: np.ndarray, scales: np.ndarray, heights: np.ndarray) -> np.ndarray:
    """Level rings (k, n, 3): the outline at some scales, its coordinates (z, x), and heights y."""
    flat = scales[:, None, None] * section
    return np.stack([flat[..., 1], np.broadcast_to(heights[:, None], flat.shape[:2]), flat[..., 0]], axis=-1)


def vessel(rng: np.random.Generator, fine: bool) -> Solid:
    """A bowl, a cup or a box without a lid, of any outline."""
    section, crease = _section(rng)
    wall, floor = rng.uniform(0.05, 0.2), rng.uniform(0.06, 0.3)
    levels = np.linspace(0, 1, 7 if fine or rng.random() < 0.6 else 2)
    low, curve = rng.uniform(0.3, 1.0), rng.uniform(0.4, 2.0)
    outer = low + (1 - low) * levels**curve
    inside = np.interp(floor + (1 - floor) * levels, levels, outer) - wall
    inside = np.maximum(inside, 0.15 * outer.min())
    scales = np.concatenate([[0.0], outer, inside[::-1], [0.0]])
    heights = np.concatenate([[0.0], levels, (floor + (1 - floor) * levels)[::-1], [floor]])
    return surface(_rings(section, scales, 2 * heights - 1)).creased(crease)


def pipe(rng: np.random.Generator, fine: bool) -> Solid:
    """A wall around a channel that is open at both ends."""
    section, crease = _section(rng)
    levels = np.linspace(-1, 1, 6 if fine else 2)
    share = rng.uniform(0.4, 0.9)
    taper = np.linspace(1.0, rng.uniform(0.5, 1.0) if rng.random() < 0.4 else 1.0, len(levels))
    scales = np.concatenate([taper, share * taper[::-1]])
    return surface(_rings(section, scales, np.concatenate([levels, levels[::-1]])), closed=True).creased(crease)


def arch(rng: np.random.Generator, fine: bool) -> Solid:
    """A part of a ring with a rectangular section: an arch, a handle or a hook."""
    count = 24 if fine else 16
    angles = np.linspace(0, rng.uniform(0.6, 1.7) * np.pi, count)
    inner, depth = rng.uniform(0.4, 0.88), rng.uniform(0.08, 0.8)
    section = np.array([(inner, -depth), (1.0, -depth), (1.0, depth), (inner, depth)])
    if fine or rng.random() < 0.5:
        middle, half = section.mean(axis=0), (section[2] - section[0]) / 2
        section = middle + half * ellipse(1.0, 1.0, 12)
    radius, across = section[:, 0], section[:, 1]
    rings = np.stack(
        [
            np.cos(angles)[:, None] * radius,
            np.sin(angles)[:, None] * radius,
            np.broadcast_to(across, (count, len(section))),
        ],
        axis=-1,
    )
    return surface(rings[:, ::-1], inner=2 if fine else 0).creased(45)


def wire_cage(rng: np.random.Generator, _fine: bool) -> Solid:
    """The edges of a coarse solid as bars: a prism, a ball or a spindle."""
    sides, levels = int(rng.integers(4, 9)), int(rng.integers(2, 6))
    heights = np.linspace(-1, 1, levels)
    scales = np.sqrt(np.maximum(1 - (0.85 * heights) ** 2, 0)) if rng.random() < 0.6 else np.ones(levels)
    rings = _rings(ellipse(1.0, 1.0, sides), scales, heights)
    radius = rng.uniform(0.02, 0.055)
    bars = [bar(ring[k - 1], ring[k], radius, 4) for ring in rings for k in range(sides)]
    bars += [
        bar(low[k], high[k], radius, 4) for low, high in zip(rings[:-1], rings[1:], strict=True) for k in range(sides)
    ]
    return merged(bars)
