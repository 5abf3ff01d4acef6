"""Ray casting against triangles: Embree finds the face, double precision the point on it.

Embree works in single precision. It only decides which face a ray hits first; the point is computed from the plane of
the face in double precision, so points are exact at any camera distance. Where an inner and an outer side coincide, the
outer one is hit; an inner side of a culled surface is hit only where nothing else is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from data_gen.rendering.surfaces import COINCIDENT, ShadedSurface

__all__ = ["Hits", "RayCaster", "pixel_rays"]

Floats = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Hits:
    """The first hits of rays.

    Attributes:
        rays: index `(hit,)` of the ray.
        faces: index `(hit,)` of the face among those of all surfaces.
        distances: multiple `(hit,)` of the ray's direction at the hit.
        points: the hit points `(hit, 3)`, world axes.
        corners: barycentric weights `(hit, 3)` of the face's corners.
    """

    rays: Indices
    faces: Indices
    distances: Floats
    points: Floats
    corners: Floats


class RayCaster:
    """Casts rays at surfaces.

    Args:
        surfaces: the surfaces; faces are numbered through them in order.

    Attributes:
        facets: face normals `(face, 3)` by the winding, not normalised.
        gradients: gradients `(face, 2, 3)` of the barycentric weights of each face's second and third corner.
        owner: index `(face,)` of the surface of each face.
        first_face: index `(surface,)` of each surface's first face.
    """

    def __init__(self, surfaces: Sequence[ShadedSurface]) -> None:
        triangles = np.concatenate([surface.positions[surface.faces] for surface in surfaces])
        counts = [len(surface.faces) for surface in surfaces]
        self.owner = np.repeat(np.arange(len(surfaces)), counts)
        self.first_face = np.concatenate(([0], np.cumsum(counts)[:-1])).astype(np.int64)
        self._start = triangles[:, 0]
        edges = triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
        self.facets = np.cross(*edges)
        area = np.sum(self.facets**2, axis=1, keepdims=True)
        gradients = np.stack((np.cross(edges[1], self.facets), np.cross(self.facets, edges[0])), axis=1)
        self.gradients = np.divide(gradients, area[..., None], out=np.zeros_like(gradients), where=area[..., None] > 0)
        self._triangles = np.ascontiguousarray(triangles, dtype=np.float32)
        self._culled = np.repeat([surface.culled for surface in surfaces], counts)
        self._fills = np.repeat([surface.opaque for surface in surfaces], counts)
        self._all = _EmbreeFaces(self._triangles, np.arange(len(triangles)))
        self._origin = b""
        self._seen: dict[bool, _EmbreeFaces] = {}

    def cast(self, origin: Floats, directions: Floats, after: Floats | None = None) -> Hits:
        """Find the first face on each ray.

        Args:
            origin: origin of all rays `(3,)`.
            directions: their directions `(ray, 3)`, of any length.
            after: multiples of the directions `(ray,)` from which on hits count, or None for 0.

        Returns:
            The hits, in the order of the rays; rays without a hit are left out.
        """
        starts = np.broadcast_to(origin, directions.shape) if after is None else origin + after[:, None] * directions
        faces = self._first(origin, starts, directions)
        rays = np.flatnonzero(faces >= 0)
        faces = faces[rays]
        faces, distances = self._outer_where_coincident(origin, starts[rays], directions[rays], faces)
        met = np.isfinite(distances)
        if not met.all():
            rays, faces, distances = rays[met], faces[met], distances[met]
        points = origin + distances[:, None] * directions[rays]
        corners = np.einsum("rci,ri->rc", self.gradients[faces], points - self._start[faces])
        corners = np.clip(np.concatenate((1.0 - corners.sum(axis=1, keepdims=True), corners), axis=1), 0.0, 1.0)
        return Hits(rays, faces, distances, points, corners)

    def _first(self, origin: Floats, starts: Floats, directions: Floats) -> Indices:
        """The first face (ray,) on each ray, the culled ones after all others; -1 where there is none."""
        if not self._culled.any():
            return self._all.first(starts, directions)
        faces = self._seen_from(origin, only_outer=False).first(starts, directions)
        missed = np.flatnonzero(faces < 0)
        behind = self._all.first(starts[missed], directions[missed])
        faces[missed] = np.where(self._fills[behind], behind, -1)
        return faces

    def _seen_from(self, origin: Floats, *, only_outer: bool) -> _EmbreeFaces:
        """The faces whose outer side faces a point, and unless only those, also others that are not culled."""
        if self._origin != origin.tobytes():  # all rays of a view have one origin
            self._origin, self._seen = origin.tobytes(), {}
        if only_outer not in self._seen:
            seen = np.einsum("fi,fi->f", self.facets, origin - self._start) > 0.0
            numbers = np.flatnonzero(seen if only_outer else seen | ~self._culled)
            self._seen[only_outer] = _EmbreeFaces(self._triangles[numbers], numbers)
        return self._seen[only_outer]

    def _outer_where_coincident(
        self, origin: Floats, starts: Floats, directions: Floats, faces: Indices
    ) -> tuple[Indices, Floats]:
        """The faces, with inner sides replaced by coincident outer ones, and their distances."""
        distances = self._distances(origin, directions, faces)
        inner = np.flatnonzero(np.einsum("ri,ri->r", self.facets[faces], directions) > 0.0)
        if len(inner) == 0:
            return faces, distances
        found = self._seen_from(origin, only_outer=True).first(starts[inner], directions[inner])
        inner, found = inner[found >= 0], found[found >= 0]
        beyond = self._distances(origin, directions[inner], found)
        near = beyond <= distances[inner] + COINCIDENT
        faces[inner[near]], distances[inner[near]] = found[near], beyond[near]
        return faces, distances

    def _distances(self, origin: Floats, directions: Floats, faces: Indices) -> Floats:
        """Multiples of the directions at which rays meet the planes of faces; infinite for parallel ones."""
        facets = self.facets[faces]
        height = np.einsum("ri,ri->r", facets, directions)
        start = np.einsum("ri,ri->r", self._start[faces] - origin, facets)
        return np.divide(start, height, out=np.full(len(faces), np.inf), where=height != 0.0)


class _EmbreeFaces:
    """Triangles (face, 3, 3) in an Embree scene, and their numbers (face,)."""

    def __init__(self, triangles: npt.NDArray[np.float32], numbers: Indices) -> None:
        from embreex.mesh_construction import TriangleMesh
        from embreex.rtcore_scene import EmbreeScene

        self._numbers = np.append(numbers, -1)
        self._scene = EmbreeScene(robust=True)
        self._mesh = TriangleMesh(self._scene, triangles) if len(triangles) else None

    def first(self, starts: Floats, directions: Floats) -> Indices:
        """The number of the first face (ray,) on each ray, -1 where there is none."""
        if self._mesh is None:
            return np.full(len(directions), -1, dtype=np.int64)
        found = self._scene.run(
            np.ascontiguousarray(starts, dtype=np.float32), np.ascontiguousarray(directions, dtype=np.float32)
        )
        return self._numbers[found]


def pixel_rays(pose: Floats, intrinsics: Floats, columns: Floats, rows: Floats) -> Floats:
    """Rays through points of the image, scaled to unit depth along the camera's z axis.

    Args:
        pose: world_from_camera `(4, 4)`, OpenCV axes.
        intrinsics: pinhole matrix `(3, 3)` in pixels, integer pixel centres.
        columns: x coordinates `(column,)` in pixels.
        rows: y coordinates `(row,)` in pixels.

    Returns:
        Directions `(row x column, 3)` in world axes, rows first.
    """
    matrix = pose[:3, :3] @ np.linalg.inv(intrinsics)
    down = np.asarray(rows, dtype=np.float64)[:, None] * matrix[:, 1] + matrix[:, 2]
    across = np.asarray(columns, dtype=np.float64)[:, None] * matrix[:, 0]
    return (down[:, None] + across).reshape(-1, 3)
