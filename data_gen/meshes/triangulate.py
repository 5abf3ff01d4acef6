"""Cuts polygons into triangles: convex ones as fans, concave ones by ear clipping (mapbox_earcut)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from mapbox_earcut import triangulate_float64

__all__ = ["TOO_FEW_CORNERS", "concave", "fan", "retriangulate", "triangulate"]

TOO_FEW_CORNERS = "faces with fewer than 3 corners left out"
"""The warning about such faces, after their number."""

_FLAT = 1e-3  # largest sine of an angle that counts as straight


def fan(count: int) -> npt.NDArray[np.int64]:
    """The triangles `(count - 2, 3)` of a convex polygon.

    >>> fan(4).tolist()
    [[0, 1, 2], [0, 2, 3]]
    """
    index = np.arange(1, count - 1, dtype=np.int64)
    return np.stack((np.zeros_like(index), index, index + 1), axis=1)


def concave(polygons: npt.NDArray[np.float64]) -> npt.NDArray[np.bool_]:
    """Which polygons have an inward corner, so that a fan would cover area outside.

    Args:
        polygons: corners `(polygon, corner, 3)` of polygons of the same size.

    Returns:
        Whether each is concave `(polygon,)`.

    >>> square = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]
    >>> dart = [[0, 0, 0], [1, 0, 0], [0.2, 0.2, 0], [0, 1, 0]]
    >>> concave(np.array([square, dart])).tolist()
    [False, True]
    """
    edges = np.roll(polygons, -1, axis=1) - polygons
    turns = np.cross(np.roll(edges, 1, axis=1), edges)
    normals = _normals(polygons)
    lengths = np.linalg.norm(edges, axis=2)
    scale = lengths * np.roll(lengths, 1, axis=1) * np.linalg.norm(normals, axis=1)[:, None]
    return (np.einsum("pci,pi->pc", turns, normals) < -_FLAT * scale).any(axis=1)


def triangulate(polygon: npt.NDArray[np.float64]) -> npt.NDArray[np.int64]:
    """Cut a nearly planar polygon `(corner, 3)` into triangles.

    Returns:
        Corner indices `(corner - 2, 3)`, wound as the polygon; unneeded triangles have three equal corners.

    >>> triangulate(np.array([[0.2, 0.2, 0], [0, 1, 0], [0, 0, 0], [1, 0, 0]])).tolist()
    [[2, 3, 0], [2, 0, 1]]
    """
    count = len(polygon)
    if count < 4 or not concave(polygon[None])[0]:
        return fan(count)
    normal = _normals(polygon[None])[0]
    dropped = int(np.abs(normal).argmax())
    kept = [(dropped + 1) % 3, (dropped + 2) % 3]
    flat = np.ascontiguousarray(polygon[:, kept])
    found = triangulate_float64(flat, np.array([count], dtype=np.uint32)).astype(np.int64).reshape(-1, 3)
    if not 0 < len(found) <= count - 2:
        return fan(count)
    a, b, c = flat[found].transpose(1, 0, 2)
    (ux, uy), (vx, vy) = (b - a).T, (c - a).T
    against = (ux * vy - uy * vx) * normal[dropped] < 0.0
    found[against] = found[against][:, ::-1]
    return np.concatenate((found, np.zeros((count - 2 - len(found), 3), dtype=np.int64)))


def retriangulate(
    triangles: npt.NDArray[np.int64], polygons: Sequence[tuple[int, Sequence[int]]], positions: npt.NDArray[np.float64]
) -> None:
    """Replace the fans of concave polygons, in place.

    Args:
        triangles: vertex indices `(triangle, 3)`, a fan for each polygon.
        polygons: for each polygon of four corners or more, the start of its fan and its vertex indices.
        positions: vertices `(vertex, 3)`.
    """
    sizes = np.array([len(corners) for _, corners in polygons], dtype=np.int64)
    for size in np.unique(sizes):
        alike = [polygons[index] for index in np.flatnonzero(sizes == size).tolist()]
        places = np.array([corners for _, corners in alike], dtype=np.int64)
        corners = positions[places]
        for index in np.flatnonzero(concave(corners) & np.isfinite(corners).all(axis=(1, 2))):
            start = alike[index][0]
            triangles[start : start + size - 2] = places[index][triangulate(corners[index])]


def _normals(polygons: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Newell's normals `(polygon, 3)`, not normalised."""
    moved = polygons - polygons[:, :1]
    return np.cross(moved, np.roll(moved, -1, axis=1)).sum(axis=1)
