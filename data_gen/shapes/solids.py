"""Watertight solids with a known volume: lofts, lathes and sweeps, and what can be done with any solid.

A `Solid` has its exact volume, computed from its parameters and not from its triangles, so that holes or reversed faces
show up as a difference between the two. Right-handed axes, y up. Faces are counter-clockwise
seen from outside.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from data_gen.shapes.profiles import polygon_area, triangulate

__all__ = ["Solid", "collapsed", "lathe", "loft", "merged", "rotation", "signed_volume", "skin", "sweep"]

_AXES = {"x": (1, 2, 0), "y": (2, 0, 1), "z": (0, 1, 2)}
"""World axis of the (first, second) coordinate of an outline and of the direction it is drawn along; cyclic, so that
counter-clockwise stays counter-clockwise seen from the far end."""


@dataclass(frozen=True)
class Solid:
    """A closed triangle mesh.

    Attributes:
        vertices: corners (V, 3).
        faces: indices (F, 3) into `vertices`.
        uv: texture coordinates of each face's corners (F, 3, 2), inside [0, 1].
        cells: (F, 2): the step along the solid and the step around it that a face belongs to; (-1, 0) and (-1, 1) for
            the first and the last cap.
        volume: exact volume of the polyhedron, in the cubed unit of the vertices.
        crease: edges sharper than this many degrees are shaded as edges, others smoothly.
    """

    vertices: np.ndarray
    faces: np.ndarray
    uv: np.ndarray
    cells: np.ndarray
    volume: float
    crease: float = 35.0

    def moved(self, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Solid:
        """The solid shifted by (x, y, z)."""
        return replace(self, vertices=self.vertices + np.array([x, y, z]))

    def turned(self, axis: str, degrees: float) -> Solid:
        """The solid turned about a world axis through the origin, counter-clockwise seen from the axis' tip."""
        return self.transformed(rotation(axis, degrees))

    def scaled(self, x: float, y: float, z: float) -> Solid:
        """The solid stretched about the origin."""
        return self.transformed(np.diag([x, y, z]))

    def mirrored(self) -> Solid:
        """The solid reflected in the plane x = 0."""
        return self.scaled(-1.0, 1.0, 1.0)

    def transformed(self, linear: np.ndarray, offset: np.ndarray | float = 0.0) -> Solid:
        """The solid under the map p -> linear p + offset; one that reflects reverses the faces, which stay outside."""
        determinant = float(np.linalg.det(linear))
        order = slice(None, None, -1 if determinant < 0 else 1)
        return replace(
            self,
            vertices=self.vertices @ linear.T + offset,
            faces=self.faces[:, order],
            uv=self.uv[:, order],
            volume=self.volume * abs(determinant),
        )

    def creased(self, degrees: float) -> Solid:
        """The solid shaded with another crease angle, in degrees."""
        return replace(self, crease=degrees)

    def projected(self, axis: str) -> Solid:
        """The solid with texture coordinates projected along an axis onto its bounding rectangle.

        Args:
            axis: "x" maps (z, y) to (u, v), "y" maps (x, z), "z" maps (x, y).

        Returns:
            The same mesh; (0, 0) is the corner of smallest coordinates.
        """
        columns = {"x": [2, 1], "y": [0, 2], "z": [0, 1]}[axis]
        plane = self.vertices[:, columns]
        low, high = plane.min(axis=0), plane.max(axis=0)
        return replace(self, uv=((plane - low) / (high - low))[self.faces])

    def repeated(self, times: int) -> Solid:
        """The solid with its texture repeated around it.

        Args:
            times: how often; a divisor of the number of steps around.

        Returns:
            The same mesh; the caps keep their texture coordinates.

        Raises:
            ValueError: if the steps around cannot be divided evenly.
        """
        side = self.cells[:, 0] >= 0
        around = int(self.cells[side, 1].max()) + 1
        if around % times:
            raise ValueError(f"times: expected a divisor of the {around} steps around, got {times}")
        tile = self.cells[:, 1] * times // around
        uv = self.uv.copy()
        uv[side, :, 0] = np.clip(uv[side, :, 0] * times - tile[side, None], 0, 1)
        return replace(self, uv=uv)


def rotation(axis: str, degrees: float) -> np.ndarray:
    """Rotation matrix (3, 3) about a world axis, counter-clockwise seen from the axis' tip."""
    first, second, along = _AXES[axis]
    cosine, sine = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    matrix = np.zeros((3, 3))
    matrix[along, along] = 1
    matrix[first, first] = matrix[second, second] = cosine
    matrix[second, first], matrix[first, second] = sine, -sine
    return matrix


def signed_volume(vertices: np.ndarray, faces: np.ndarray) -> float:
    """Volume inside triangles (F, 3) that are counter-clockwise seen from outside, by the divergence theorem."""
    a, b, c = vertices[faces].transpose(1, 0, 2)
    return float(np.einsum("fk,fk->", a, np.cross(b, c)) / 6)


def merged(solids: Sequence[Solid]) -> Solid:
    """Several solids as one; its volume is the sum of theirs, and where they overlap is counted twice."""
    starts = np.cumsum([0, *(len(solid.vertices) for solid in solids[:-1])])
    return Solid(
        np.concatenate([solid.vertices for solid in solids]),
        np.concatenate([solid.faces + start for solid, start in zip(solids, starts, strict=True)]),
        np.concatenate([solid.uv for solid in solids]),
        np.concatenate([solid.cells for solid in solids]),
        sum(solid.volume for solid in solids),
        solids[0].crease,
    )


def skin(rings: np.ndarray, wrap: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Triangles between successive rings; each quadrilateral is cut along its shorter diagonal.

    Args:
        rings: points (k, n, 3).
        wrap: whether the last ring is joined with the first.

    Returns:
        Faces (F, 3) into the flattened rings, uv (F, 3, 2), cells (F, 2), and which quadrilaterals (k or k - 1, n)
        are cut from their first to their third corner.
    """
    count, around = rings.shape[:2]
    spans = count if wrap else count - 1
    i, j = np.meshgrid(np.arange(spans), np.arange(around), indexing="ij")
    i1, j1 = (i + 1) % count, (j + 1) % around
    rising = ((rings[i, j] - rings[i1, j1]) ** 2).sum(-1)
    falling = ((rings[i, j1] - rings[i1, j]) ** 2).sum(-1)
    forward = rising <= falling * (1 + 1e-9)
    corners = np.stack([i * around + j, i * around + j1, i1 * around + j1, i1 * around + j], -1)
    u, v = np.stack([j, j + 1, j + 1, j], -1) / around, np.stack([i, i, i + 1, i + 1], -1) / spans
    order = np.where(forward[..., None], [0, 1, 2, 0, 2, 3], [0, 1, 3, 1, 2, 3])
    faces = np.take_along_axis(corners, order, -1).reshape(-1, 3)
    uv = np.stack([np.take_along_axis(u, order, -1), np.take_along_axis(v, order, -1)], -1).reshape(-1, 3, 2)
    cells = np.repeat(np.stack([i, j], -1).reshape(-1, 2), 2, axis=0)
    return faces, uv, cells, forward


def collapsed(solid: Solid, starts: Sequence[int], around: int) -> Solid:
    """The solid with rings of `around` vertices that begin at some indices each made one point, their first vertex.

    Faces that lose their area are dropped, as are vertices without a face.
    """
    faces = solid.faces
    for start in starts:
        faces = np.where((faces >= start) & (faces < start + around), start, faces)
    keep = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    used, faces = np.unique(faces[keep], return_inverse=True)
    return replace(
        solid,
        vertices=solid.vertices[used],
        faces=faces.reshape(-1, 3),
        uv=solid.uv[keep],
        cells=solid.cells[keep],
    )


def _cap(outline: np.ndarray, start: int, last: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Faces, uv and cells of the planar end over an outline (n, 2) whose vertices begin at index `start`."""
    triangles = triangulate(outline)
    low, high = outline.min(axis=0), outline.max(axis=0)
    uv = ((outline - low) / (high - low))[triangles]
    if not last:
        triangles, uv = triangles[:, ::-1], uv[:, ::-1]
    return triangles + start, uv, np.tile([-1, int(last)], (len(triangles), 1))


def _closed(
    rings: np.ndarray, first: np.ndarray, last: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Skin and both caps of an open row of rings: faces, uv, cells, and the cuts of the quadrilaterals."""
    faces, uv, cells, forward = skin(rings, wrap=False)
    start = (len(rings) - 1) * rings.shape[1]
    bottom, top = _cap(first, 0, last=False), _cap(last, start, last=True)
    return (
        np.concatenate([faces, bottom[0], top[0]]),
        np.concatenate([uv, bottom[1], top[1]]),
        np.concatenate([cells, bottom[2], top[2]]),
        forward,
    )


def loft(sections: Sequence[np.ndarray] | np.ndarray, stations: Sequence[float] | np.ndarray, axis: str = "z") -> Solid:
    """Skin drawn over parallel outlines, closed by flat caps.

    The volume between two sections is the prismatoid's, h / 6 (A0 + 4 Am + A1), where the middle section runs through
    the midpoints of the edges and of the diagonals that cut the side faces.

    Args:
        sections: outlines (k, n, 2), counter-clockwise. Their coordinates are (x, y) for axis "z", (z, x) for "y",
            (y, z) for "x".
        stations: positions (k,) of the sections along the axis, increasing.
        axis: "x", "y" or "z".

    Returns:
        The solid; u runs around the outline, v along the axis.

    Raises:
        ValueError: if there are fewer than two sections or the stations do not increase.
    """
    outlines, heights = np.asarray(sections, dtype=float), np.asarray(stations, dtype=float)
    if outlines.ndim != 3 or len(outlines) < 2 or len(outlines) != len(heights):
        raise ValueError(f"expected k >= 2 outlines (k, n, 2) and k stations, got {outlines.shape} and {heights.shape}")
    if not (np.diff(heights) > 0).all():
        raise ValueError(f"expected increasing stations, got {heights.tolist()}")
    rings = np.empty((*outlines.shape[:2], 3))
    first, second, along = _AXES[axis]
    rings[..., first], rings[..., second], rings[..., along] = outlines[..., 0], outlines[..., 1], heights[:, None]
    faces, uv, cells, forward = _closed(rings, outlines[0], outlines[-1])
    following = np.roll(outlines, -1, axis=1)
    diagonals = np.where(forward[..., None], outlines[:-1] + following[1:], following[:-1] + outlines[1:]) / 2
    middle = np.stack([(outlines[:-1] + outlines[1:]) / 2, diagonals], axis=2).reshape(len(heights) - 1, -1, 2)
    ends = polygon_area(outlines)
    volume = np.sum(np.diff(heights) * (ends[:-1] + 4 * polygon_area(middle) + ends[1:]) / 6)
    return Solid(rings.reshape(-1, 3), faces, uv, cells, float(volume))


def lathe(profile: Sequence[tuple[float, float]] | np.ndarray, segments: int = 16, ring: bool = False) -> Solid:
    """Profile turned about the y axis in equal steps.

    The volume is n sin(2 pi / n) / 2 times the integral of r^2 dy along the profile (Pappus' rule for a regular polygon
    in place of the circle).

    Args:
        profile: points (k, 2) of (radius, height). An open profile runs from the bottom to the top of the outer side;
            its ends are closed by flat discs, or by a tip where the radius is 0. A ring's profile is a
            counter-clockwise closed outline away from the axis.
        segments: steps of a turn.
        ring: whether the profile is a closed outline (a torus, a tyre, the shell of a shade).

    Returns:
        The solid; u runs around the axis, v along the profile.

    Raises:
        ValueError: if a radius inside an open profile, or any radius of a ring, is not positive.
    """
    points = np.asarray(profile, dtype=float)
    inner = points[:, 0] if ring else points[1:-1, 0]
    if (inner <= 0).any() or (points[:, 0] < 0).any():
        raise ValueError(f"expected positive radii (zero at the ends of an open profile only), got {points.tolist()}")
    closed_points = np.concatenate([points, points[:1]]) if ring else points
    (r0, r1), rise = (closed_points[:-1, 0], closed_points[1:, 0]), np.diff(closed_points[:, 1])
    volume = segments * np.sin(2 * np.pi / segments) / 2 * float(np.sum(rise * (r0**2 + r0 * r1 + r1**2)) / 3)
    angles = np.arange(segments) * (2 * np.pi / segments)
    circle = np.stack([np.cos(angles), np.sin(angles)], 1)  # (z, x): counter-clockwise seen from above
    rings = np.empty((len(points), segments, 3))
    rings[..., 2], rings[..., 0] = np.moveaxis(points[:, None, :1] * circle, -1, 0)
    rings[..., 1] = points[:, None, 1]
    if ring:
        faces, uv, cells, _ = skin(rings, wrap=True)
        return Solid(rings.reshape(-1, 3), faces, uv, cells, volume)
    faces, uv, cells, _ = _closed(rings, circle, circle)
    tips = [start for end, start in ((0, 0), (-1, (len(points) - 1) * segments)) if points[end, 0] == 0]
    return collapsed(Solid(rings.reshape(-1, 3), faces, uv, cells, volume), tips, segments)


def sweep(path: Sequence[Sequence[float]] | np.ndarray, outline: np.ndarray, up: Sequence[float] = (0, 1, 0)) -> Solid:
    """Outline carried along a polyline with mitred corners.

    Every piece is a prism cut by two planes, so its volume is the outline's area times the length of the line through
    the centroids; with the centroid on the path, area times path length.

    Args:
        path: points (k, 3).
        outline: section (n, 2), counter-clockwise, with its centroid at the origin: (sideways, upwards).
        up: rough direction of the outline's second axis, not along the path.

    Returns:
        The solid; u runs around the outline, v along the path.

    Raises:
        ValueError: if the outline's centroid is not at the origin.
    """
    points = np.asarray(path, dtype=float)
    shoelace = outline[:, 0] * np.roll(outline[:, 1], -1) - np.roll(outline[:, 0], -1) * outline[:, 1]
    area = float(polygon_area(outline))
    centroid = ((outline + np.roll(outline, -1, axis=0)) * shoelace[:, None]).sum(axis=0) / (6 * area)
    if np.abs(centroid).max() > 1e-6 * np.abs(outline).max():
        raise ValueError(f"expected an outline with its centroid at the origin, got {centroid.tolist()}")
    steps = np.diff(points, axis=0)
    directions = steps / np.linalg.norm(steps, axis=1, keepdims=True)
    side = np.cross(np.asarray(up, dtype=float), directions[0])
    side /= np.linalg.norm(side)
    ring = points[0] + outline[:, :1] * side + outline[:, 1:] * np.cross(directions[0], side)
    rings = [ring]
    for k, direction in enumerate(directions):
        following = directions[k + 1] if k + 1 < len(directions) else direction
        normal = direction + following
        travel = (points[k + 1] - rings[-1]) @ normal / (direction @ normal)
        rings.append(rings[-1] + travel[:, None] * direction)
    solid = np.stack(rings)
    faces, uv, cells, _ = _closed(solid, outline, outline)
    length = float(np.linalg.norm(steps, axis=1).sum())
    return Solid(solid.reshape(-1, 3), faces, uv, cells, area * length)
