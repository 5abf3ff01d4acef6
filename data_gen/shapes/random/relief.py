"""Height fields on a solid's surface: its vertices moved along their normals by a random function of their place.

Equal places move equally, so a closed surface stays closed. LRM-Zero gains 1 dB from height fields on its faces.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from data_gen.shapes.choices import pick
from data_gen.shapes.solids import Solid, signed_volume

__all__ = ["displaced", "random_relief", "vertex_normals"]

_KINDS = {"waves": 2.0, "noise": 3.0, "ridges": 1.0, "steps": 1.0, "furrows": 1.5}


def vertex_normals(solid: Solid) -> np.ndarray:
    """Unit normals (V, 3): the mean of the faces around a vertex, weighted by their area."""
    triangles = solid.vertices[solid.faces]
    normals = np.repeat(np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]), 3, axis=0)
    corner = solid.faces.reshape(-1)
    total = np.stack([np.bincount(corner, normals[:, k], len(solid.vertices)) for k in range(3)], axis=1)
    return total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-12)


def displaced(solid: Solid, heights: np.ndarray) -> Solid:
    """The solid with every vertex moved outwards along its normal.

    Args:
        solid: the surface.
        heights: distances (V,), inwards where negative.

    Returns:
        The solid, with the volume of its triangles.
    """
    vertices = solid.vertices + heights[:, None] * vertex_normals(solid)
    return replace(solid, vertices=vertices, volume=signed_volume(vertices, solid.faces))


def random_relief(rng: np.random.Generator, solid: Solid) -> Solid:
    """The solid with a random height field: waves, noise, ridges, steps or furrows.

    Args:
        rng: source of every choice.
        solid: the solid, displaced by at most a tenth of its smallest extent.

    Returns:
        The solid.
    """
    extents = np.ptp(solid.vertices, axis=0)
    amplitude = rng.uniform(0.03, 0.1) * extents.min()
    kind = pick(rng, _KINDS)
    # wave vectors of up to three waves across the solid: its vertices cannot represent more
    count = {"waves": 2, "furrows": 1}.get(kind, 8)
    directions = rng.normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    waves = rng.uniform(0.5, 3.0, count)
    phase = rng.uniform(0, 2 * np.pi, count)
    angle = 2 * np.pi * (solid.vertices / extents.max()) @ (directions * waves[:, None]).T + phase
    field = (np.sin(angle) / np.sqrt(waves)).sum(axis=1) / np.sqrt(0.5 * (1 / waves).sum())
    if kind == "ridges":
        field = 1 - 2 * np.abs(np.clip(field, -1, 1))
    elif kind == "steps":
        field = np.round(field * 1.5) / 1.5
    return displaced(solid, amplitude * np.clip(field, -1.5, 1.5)).creased(max(solid.crease, 45.0))
