"""Repairs the geometry of a mesh, with warnings: faces that cannot be drawn, normals that cannot be used.

trimesh's `process=True` does not report what it removes or merges, and checks neither winding nor normals.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import trimesh
from scipy.spatial import KDTree
from trimesh.grouping import unique_rows
from trimesh.visual import ColorVisuals, TextureVisuals

from data_gen.meshes.materials import select_vertices, visual_of

__all__ = ["check_faces", "CREASE", "clean", "decimate", "is_smooth", "smooth_normals"]

CREASE = 40.0
"""Angle between two faces, in degrees, from which on an edge is sharp if a file has no normals."""

_MOSTLY = 0.1
_COINCIDENT = 1e-4  # of the diagonal of a solid's bounding box
_HULL_FILLED = 0.7  # share of an outline hull's diagonal that the parts inside fill
_MOST_FACES_TO_CLOSE = 500_000


def check_faces(mesh: trimesh.Trimesh, label: str) -> None:
    """Refuse faces that refer to missing vertices.

    Raises:
        ValueError: a face refers to a missing vertex.
    """
    faces, count = np.asarray(mesh.faces, dtype=np.int64), len(mesh.vertices)
    if len(faces) and not (0 <= faces.min() and faces.max() < count):
        raise ValueError(f"{label}: expected faces on its {count} vertices, found one on vertex {faces.max()}")


def clean(
    mesh: trimesh.Trimesh, label: str, parts: Sequence[trimesh.Trimesh]
) -> tuple[trimesh.Trimesh | None, list[str]]:
    """Remove faces that cannot be drawn and vertices without faces, and make normals agree with faces.

    Changes that do not affect pictures, removing faces without area and flipping single normals, give no warning unless
    there are so many that the file must be damaged. If more than a tenth of the faces have the three corners of an
    earlier face, in either winding, they are removed: the remaining ones are visible from both sides, and the normals
    of two opposite faces would cancel.

    A solid that is wound inside out is flipped, unless that is intended: it is the inner side of another part on which
    it lies, or the one-sided hull around others that draws cartoon outlines.

    Args:
        mesh: a mesh with a canonical visual and valid faces (`check_faces`); it is not changed.
        label: its name in warnings.
        parts: all parts of the object, in the same coordinates.

    Returns:
        The mesh, or None if no face is left; and warnings.
    """
    warnings: list[str] = []
    vertices, faces = np.asarray(mesh.vertices, dtype=np.float64), np.asarray(mesh.faces, dtype=np.int64)
    finite = np.isfinite(vertices[faces]).all(axis=(1, 2))
    if not finite.all():
        warnings.append(
            f"{label}: {int((~finite).sum())} of {len(faces)} faces left out, on vertices that are not finite"
        )
    kept = np.flatnonzero(finite)
    flat = _degenerate(vertices, faces[kept])
    if flat.any() and flat.mean() > _MOSTLY:
        warnings.append(f"{label}: {int(flat.sum())} of {len(faces)} faces without area left out")
    kept = kept[~flat]
    first = _first_of_their_corners(faces[kept])
    if len(first) < (1.0 - _MOSTLY) * len(kept) and visual_of(mesh).kind != "face":
        kept = kept[first]
    if not len(kept):
        return None, warnings
    kept_faces = faces[kept]
    if _inside_out(vertices, kept_faces) and not _meant_inwards(mesh, vertices[np.unique(kept_faces)], parts):
        warnings.append(f"{label}: wound inside out, its faces are turned")
        kept_faces = kept_faces[:, ::-1]
    used, corners = np.unique(kept_faces, return_inverse=True)
    normals = _normals(mesh, label, kept_faces, used, warnings)
    return _part(mesh, used, kept, corners.reshape(-1, 3), normals), warnings


def is_smooth(mesh: trimesh.Trimesh) -> bool:
    """Whether a mesh should be shaded with interpolated normals.

    A mesh with its own normals is, one with face colours is not. Otherwise the file decides (smoothing groups of an
    OBJ), and finally the number of edges sharper than CREASE.
    """
    if visual_of(mesh).kind == "face":
        return False
    if "vertex_normals" in mesh._cache.cache:
        return True
    if "smooth" in mesh.metadata:
        return bool(mesh.metadata["smooth"])
    angles = np.asarray(_welded(mesh)[0].face_adjacency_angles)
    return len(angles) > 0 and float((angles > np.radians(CREASE)).mean()) < _MOSTLY


def smooth_normals(mesh: trimesh.Trimesh) -> npt.NDArray[np.float64] | None:
    """Normals `(vertex, 3)` of a mesh without its own, equal on both sides of texture seams.

    Returns:
        The normals; None if the mesh has its own, or no seams.
    """
    if "vertex_normals" in mesh._cache.cache:
        return None
    welded, vertices = _welded(mesh)
    return None if vertices is None else np.asarray(welded.vertex_normals)[vertices]


def _welded(mesh: trimesh.Trimesh) -> tuple[trimesh.Trimesh, npt.NDArray[np.int64] | None]:
    """A mesh with merged texture seams but separate smoothing groups, and the new index of each old vertex."""
    if not isinstance(mesh.visual, TextureVisuals) or mesh.visual.uv is None:
        return mesh, None
    groups = mesh.metadata.get("smoothing", np.zeros(len(mesh.vertices)))
    keys = np.column_stack((mesh.vertices, groups))
    unique, vertices = np.unique(keys, axis=0, return_inverse=True)
    if len(unique) == len(keys):
        return mesh, None
    vertices = vertices.reshape(-1)
    return trimesh.Trimesh(unique[:, :3], vertices[mesh.faces], process=False), vertices


def decimate(parts: list[trimesh.Trimesh], max_faces: int) -> list[trimesh.Trimesh] | None:
    """Simplify the parts that can be without damage: those of one colour, or with vertex colours.

    Args:
        parts: clean meshes.
        max_faces: most triangles in total.

    Returns:
        The parts with at most that many triangles, or None where textures or face colours forbid it.
    """
    import fast_simplification

    simple = [_is_simple(part) for part in parts]
    fixed = sum(len(part.faces) for part, free in zip(parts, simple, strict=True) if not free)
    free_faces = sum(len(part.faces) for part, free in zip(parts, simple, strict=True) if free)
    if free_faces == 0 or max_faces - fixed < 4 * sum(simple):
        return None
    share = (max_faces - fixed) / free_faces
    result = []
    for part, free in zip(parts, simple, strict=True):
        target = max(int(len(part.faces) * share), 4)
        if not free or len(part.faces) <= target:
            result.append(part)
            continue
        merged = trimesh.Trimesh(part.vertices, part.faces, process=True)
        points, faces = fast_simplification.simplify(
            np.asarray(merged.vertices, dtype=np.float64), np.asarray(merged.faces, dtype=np.int32), target_count=target
        )[:2]
        visual = visual_of(part)
        nearest = np.asarray(KDTree(np.asarray(part.vertices)).query(points)[1])
        if isinstance(visual, TextureVisuals):
            visual = select_vertices(visual, nearest)
        else:
            visual = ColorVisuals(vertex_colors=np.asarray(visual.vertex_colors)[nearest])
        small = trimesh.Trimesh(points, faces, visual=visual, process=False)
        small.metadata |= {"smooth": is_smooth(part), "one_sided": bool(part.metadata.get("one_sided"))}
        result.append(small)
    return result if sum(len(part.faces) for part in result) <= max_faces else None


def _is_simple(mesh: trimesh.Trimesh) -> bool:
    if visual_of(mesh).kind == "face":
        return False
    material = getattr(mesh.visual, "material", None)
    return not any(
        getattr(material, slot, None) is not None for slot in ("baseColorTexture", "emissiveTexture", "normalTexture")
    )


def _degenerate(vertices: npt.NDArray[Any], faces: npt.NDArray[Any]) -> npt.NDArray[np.bool_]:
    if not len(faces):
        return np.zeros(0, dtype=bool)
    corners = vertices[faces]
    scale = float(np.abs(corners - corners[0, 0]).max()) or 1.0
    edges = (corners - corners[:, :1]) / scale
    return np.linalg.norm(np.cross(edges[:, 1], edges[:, 2]), axis=1) <= 1e-16


def _first_of_their_corners(faces: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """Indices of the faces, in order, without those that have the three vertices of an earlier one."""
    return np.sort(unique_rows(np.sort(faces, axis=1))[0])


def _normals(
    mesh: trimesh.Trimesh, label: str, faces: npt.NDArray[Any], used: npt.NDArray[Any], warnings: list[str]
) -> npt.NDArray[np.float64] | None:
    """Unit normals of the used vertices, consistent with the winding; None if the file has none."""
    if "vertex_normals" not in mesh._cache.cache:
        return None
    vertices = np.asarray(mesh.vertices, dtype=np.float64)
    scale = float(np.abs(vertices[used]).max()) or 1.0
    corners = vertices[faces] / scale
    facing = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    around = np.zeros_like(vertices)
    for column in range(3):
        np.add.at(around, faces[:, column], facing)
    around = _unit(around[used])
    given = np.asarray(mesh.vertex_normals, dtype=np.float64)[used]
    given = _unit(np.where(np.isfinite(given), given, 0.0))
    missing = ~given.any(axis=1)
    if missing.any():
        warnings.append(f"{label}: {int(missing.sum())} of {len(used)} normals missing; those of its faces taken")
        given[missing] = around[missing]
    against = (given * around).sum(axis=1) < -0.1
    given[against] *= -1.0
    if against.mean() > _MOSTLY:
        warnings.append(f"{label}: {int(against.sum())} of {len(used)} normals point into the surface; turned")
    return given


def _unit(vectors: npt.NDArray[Any]) -> npt.NDArray[np.float64]:
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.divide(vectors, length, out=np.zeros_like(vectors, dtype=np.float64), where=length > 1e-30)


def _part(
    mesh: trimesh.Trimesh,
    used: npt.NDArray[Any],
    kept: npt.NDArray[Any],
    faces: npt.NDArray[Any],
    normals: npt.NDArray[np.float64] | None,
) -> trimesh.Trimesh:
    visual = visual_of(mesh)
    if isinstance(visual, TextureVisuals):
        visual = select_vertices(visual, used)
    elif visual.kind == "face":
        visual = ColorVisuals(face_colors=np.asarray(visual.face_colors)[kept])
    else:
        visual = ColorVisuals(vertex_colors=np.asarray(visual.vertex_colors)[used])
    result = trimesh.Trimesh(mesh.vertices[used], faces, vertex_normals=normals, visual=visual, process=False)
    result.metadata.update({key: mesh.metadata[key] for key in ("smooth", "one_sided") if key in mesh.metadata})
    if "smoothing" in mesh.metadata:
        result.metadata["smoothing"] = mesh.metadata["smoothing"][used]
    return result


def _meant_inwards(mesh: trimesh.Trimesh, points: npt.NDArray[Any], parts: Sequence[trimesh.Trimesh]) -> bool:
    """Whether a solid wound inwards is the inner side of another part, or a one-sided hull around others."""
    low, high = points.min(axis=0), points.max(axis=0)
    size = float(np.linalg.norm(high - low))
    slack = _COINCIDENT * size
    inside = []
    for other in parts:
        first, last = np.asarray(other.bounds)
        if other is mesh or (last < low - slack).any() or (first > high + slack).any():
            continue
        vertices = np.asarray(other.vertices)
        near = vertices[((vertices >= low - slack) & (vertices <= high + slack)).all(axis=1)]
        if len(near) == len(vertices):
            inside.append(near)
        if len(near) and (KDTree(near).query(points)[0] <= slack).mean() > 0.5:
            return True
    if not inside or not mesh.metadata.get("one_sided"):
        return False
    return float(np.linalg.norm(np.ptp(np.concatenate(inside), axis=0))) > _HULL_FILLED * size


def _inside_out(vertices: npt.NDArray[Any], faces: npt.NDArray[Any]) -> bool:
    """Whether the faces enclose a volume and are all wound inwards."""
    if len(faces) > _MOST_FACES_TO_CLOSE:
        return False
    corners = vertices[faces] - vertices[faces[0, 0]]
    if np.einsum("ij,ij->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) >= 0:
        return False
    closed = trimesh.Trimesh(vertices, faces, process=True)
    return bool(closed.is_watertight and closed.is_winding_consistent)
