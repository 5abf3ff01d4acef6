"""Brute-force geometry to compare objects with, and hashes of objects. Imports little, since processes import it."""

from __future__ import annotations

import hashlib

import numpy as np
import trimesh

from data_gen.shapes.parts import Part
from data_gen.shapes.solids import Solid

_TINY = 1e-12


def bare_mesh(solid: Solid) -> trimesh.Trimesh:
    """The geometry as trimesh sees it, vertices as they are (no merging, no repair)."""
    return trimesh.Trimesh(solid.vertices, solid.faces, process=False)


def digest(scene: object) -> str:
    """The hash of vertices, faces, normals, texture coordinates and pixels of an object."""
    arrays = []
    for mesh in scene.geometry.values():
        texture = np.asarray(mesh.visual.material.baseColorTexture)
        arrays += [mesh.vertices, mesh.faces, mesh.vertex_normals, mesh.visual.uv, texture]
    return hashlib.sha256(b"".join(np.ascontiguousarray(array).tobytes() for array in arrays)).hexdigest()


def _crossings(start: np.ndarray, end: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Whether segments (s, 3) -> (s, 3) intersect triangles (t, 3, 3): (s, t), after Moeller and Trumbore."""
    direction = (end - start)[:, None]
    edge1, edge2 = triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    p = np.cross(direction, edge2[None])
    determinant = (p * edge1).sum(-1)
    safe = np.where(np.abs(determinant) < _TINY, 1, determinant)
    offset = start[:, None] - triangles[None, :, 0]
    u = (offset * p).sum(-1) / safe
    q = np.cross(offset, edge1[None])
    v = (direction * q).sum(-1) / safe
    t = (edge2 * q).sum(-1) / safe
    return (np.abs(determinant) >= _TINY) & (u >= 0) & (v >= 0) & (u + v <= 1) & (t >= 0) & (t <= 1)


def _near(points: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Which of the groups of points (n, k, 3) have bounds that intersect the box."""
    return ((points.min(1) <= high) & (points.max(1) >= low)).all(1)


def touch(one: Part, other: Part) -> bool:
    """Whether the surfaces of two parts intersect, or one part contains the other."""
    a, b = one.solid.vertices, other.solid.vertices
    low, high = np.maximum(a.min(0), b.min(0)), np.minimum(a.max(0), b.max(0))
    if (low > high).any():
        return False
    for here, there in ((one.solid, other.solid), (other.solid, one.solid)):
        edges = here.vertices[np.concatenate([here.faces[:, [0, 1]], here.faces[:, [1, 2]], here.faces[:, [2, 0]]])]
        triangles = there.vertices[there.faces]
        edges, triangles = edges[_near(edges, low, high)], triangles[_near(triangles, low, high)]
        if len(edges) and len(triangles) and _crossings(edges[:, 0], edges[:, 1], triangles).any():
            return True
    for here, there in ((one.solid, other.solid), (other.solid, one.solid)):
        point = there.vertices[:1] + 1e-7
        beyond = point + np.array([[11.3, 97.1, 5.7]]) * 10
        if _crossings(point, beyond, here.vertices[here.faces]).sum() % 2:
            return True
    return False


def islands(parts: list[Part]) -> list[list[str]]:
    """Names of the parts of each connected group, the largest group first."""
    left, groups = list(range(len(parts))), []
    while left:
        group, todo = [], [left.pop(0)]
        while todo:
            k = todo.pop()
            group.append(k)
            found = [j for j in left if touch(parts[k], parts[j])]
            left = [j for j in left if j not in found]
            todo += found
        groups.append([parts[k].name for k in group])
    return sorted(groups, key=len, reverse=True)


def _overlap(first: np.ndarray, second: np.ndarray, margin: float) -> bool:
    """Whether two triangles (3, 2) overlap by more than a margin, by separating axes."""
    for triangle in (first, second):
        for k in range(3):
            side = triangle[(k + 1) % 3] - triangle[k]
            normal = np.array([side[1], -side[0]]) / max(np.linalg.norm(side), _TINY)
            a, b = first @ normal, second @ normal
            if min(a.max(), b.max()) - max(a.min(), b.min()) < margin:
                return False
    return True


def fighting(parts: list[Part], gap: float) -> set[tuple[str, str]]:
    """Pairs of parts with overlapping faces of the same direction that are closer than `gap`, in units of the object.

    Faces of one material do not count: whichever of them wins, the pixel is the same.
    """
    names: dict[bytes, int] = {}
    ids = [[names.setdefault(m.image.tobytes(), len(names)) for m in part.materials] for part in parts]
    paint = np.concatenate([np.array(i)[part.chosen] for i, part in zip(ids, parts, strict=True)])
    triangles = np.concatenate([part.solid.vertices[part.solid.faces] for part in parts])
    owner = np.repeat(np.arange(len(parts)), [len(part.solid.faces) for part in parts])
    cross = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    length = np.linalg.norm(cross, axis=1)
    keep = length > 1e-9
    triangles, owner, paint, normals = triangles[keep], owner[keep], paint[keep], cross[keep] / length[keep, None]
    offsets = (triangles[:, 0] * normals).sum(1)
    found: set[tuple[str, str]] = set()
    order = np.argsort(offsets)
    for place, i in enumerate(order):
        j = order[place + 1 : np.searchsorted(offsets[order], offsets[i] + gap, side="right")]
        j = j[(owner[j] != owner[i]) & (paint[j] != paint[i]) & (normals[j] @ normals[i] > 0.99999)]
        axes = np.linalg.svd(normals[i][None])[2][1:].T if len(j) else None
        for other in j:
            if _overlap(triangles[i] @ axes, triangles[other] @ axes, 2 * gap):
                found.add((parts[owner[i]].name, parts[owner[other]].name))
    return found
