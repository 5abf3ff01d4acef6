"""Loads any mesh file: read, checked, turned y up, and normalised.

World convention: y up, the centre of the bounding box at the origin, the vertex farthest from it at distance 1. Nothing
is lost silently: `Mesh.warnings` names everything that is not drawn as the file states, and a mesh that cannot be drawn
at all is a `MeshError`.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
import trimesh

from data_gen.meshes.clean import check_faces, clean, decimate, is_smooth, smooth_normals
from data_gen.meshes.files import MAX_FILE_BYTES, MAX_PARTS, MAX_TEXT_BYTES, MESH_SUFFIXES, MeshError, read_bytes
from data_gen.meshes.find import safe_name
from data_gen.meshes.formats.dae import declared_up
from data_gen.meshes.formats.read import read_scene
from data_gen.meshes.materials import ColourSpace, canonical_visual
from data_gen.meshes.model_folder import ModelFolder
from hyperplanes.utilities.files.encoding import sha256

__all__ = [
    "MAX_FACES",
    "Mesh",
    "MeshError",
    "load_mesh",
    "prepare_scene",
    "mesh_parts",
]

MAX_FACES = 2_000_000
"""Most triangles: larger meshes are decimated to as many if that does no damage, 8 times larger ones refused."""

_DECIMATED_FROM = 8
_OUTLIER = 30.0
_TEXT = (".obj", ".off", ".dae", ".gltf")
_Y_FROM_Z = np.array([[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])


@dataclass(frozen=True)
class Mesh:
    """A mesh that can be drawn.

    Attributes:
        name: its name, safe as a file name.
        scene: its geometries in world coordinates (all node transforms are the identity), y up, normalised.
        world_from_file: the similarity `(4, 4)` from the file's coordinates.
        warnings: what was lost or repaired, one line each.
        face_count: number of triangles.
        lost_files: missing textures and material libraries.
        made_of: checksums of its files, as in `model_folder.model_checksums`.
    """

    name: str
    scene: trimesh.Scene
    world_from_file: npt.NDArray[np.float64]
    warnings: tuple[str, ...]
    face_count: int
    lost_files: tuple[str, ...] = ()
    made_of: dict[str, str | None] = field(default_factory=dict)


def load_mesh(
    path: str | Path,
    *,
    up: Literal["y", "z"] | None = None,
    name: str | None = None,
    within: Path | None = None,
) -> Mesh:
    """Read a mesh file.

    Args:
        path: a GLB, glTF, OBJ, PLY, STL, OFF or DAE file.
        up: the axis that points up in the file; by default y, or what a COLLADA file declares.
        name: its name; the file's name by default.
        within: the folder that must contain all files of the mesh; by default the model's own.

    Returns:
        The mesh.

    Raises:
        MeshError: if it cannot be read, holds nothing to draw, or is refused.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in MESH_SUFFIXES:
        raise MeshError(
            f"{path}: expected a file that ends in {', '.join(MESH_SUFFIXES)}, found {suffix!r}; convert it"
        )
    data = read_bytes(path, limit=MAX_TEXT_BYTES if suffix in _TEXT else MAX_FILE_BYTES)
    folder = ModelFolder(path, within)
    scene, colours, lines = read_scene(data, folder)
    mentioned = "; ".join(lines)
    lost = [f"{reference}: {reason}" for reference, reason in folder.lost.items() if reference not in mentioned]
    axis = declared_up(data) if suffix == ".dae" else None
    if axis == "x" and up is None:
        lines.append("declares x up; taken as y up")
    mesh = prepare_scene(
        scene,
        name or safe_name(path.stem),
        up=up or ("z" if axis == "z" else "y"),
        colours=colours,
        warnings=(*lost, *lines, *folder.notes),
        source=str(path),
    )
    made_of = {path.name: sha256(data), **folder.checksums()}
    return replace(mesh, lost_files=tuple(folder.lost), made_of=made_of)


def prepare_scene(
    scene: trimesh.Scene,
    name: str,
    *,
    up: Literal["y", "z"] = "y",
    colours: ColourSpace = "scene",
    warnings: tuple[str, ...] = (),
    source: str | None = None,
    closed: bool = False,
) -> Mesh:
    """Check a scene and convert it to world coordinates; the scene itself is not changed.

    Args:
        scene: geometries and node transforms.
        name: name of the mesh.
        up: the axis that points up in the scene.
        colours: `scene`: vertex and face colours are sRGB, factors of materials linear; `gltf`: vertex colours on top
            of a material are linear, too; `srgb`: all are sRGB. Textures are always sRGB.
        warnings: earlier warnings.
        source: start of messages; the name by default.
        closed: whether all parts are watertight solids wound outwards, so that back faces are not drawn.

    Returns:
        The mesh.

    Raises:
        MeshError: if there is nothing to draw, or too much.
        ValueError: if `up` is neither of the two.
    """
    if up not in ("y", "z"):
        raise ValueError(f"up: expected 'y' or 'z', got {up!r}")
    source = source or name
    found = list(warnings)
    _refuse_too_many(scene, source)
    with np.errstate(all="ignore"):
        parts, scale = _clean_parts(scene, colours, found, source)
    if not parts:
        raise MeshError(f"{source}: expected triangles to draw, found none; {'; '.join(found) or 'export it again'}")
    faces = sum(len(part.faces) for part in parts)
    if faces > MAX_FACES:
        smaller = decimate(parts, MAX_FACES)
        if smaller is None:
            found.append(f"{faces} triangles drawn as they are: textures or face colours would not survive decimation")
        else:
            parts, closed = smaller, False
            found.append(f"decimated from {faces} to {sum(len(part.faces) for part in parts)} triangles")
    world_from_parts = _normalising_transform(parts, scale, up, source, found)
    ready = trimesh.Scene()
    for number, part in enumerate(parts):
        key = f"part_{number:04d}"
        smooth = is_smooth(part)
        normals = smooth_normals(part) if smooth else None
        if normals is not None:
            part.vertex_normals = normals
        moved = _transformed(part, world_from_parts)
        moved.metadata = {"smooth": smooth, "closed": closed, "one_sided": bool(part.metadata.get("one_sided"))}
        ready.add_geometry(moved, geom_name=key, node_name=key)
    return Mesh(
        name=name,
        scene=ready,
        world_from_file=world_from_parts * (scale, scale, scale, 1.0),
        warnings=tuple(dict.fromkeys(found)),
        face_count=sum(len(part.faces) for part in parts),
    )


def mesh_parts(mesh: Mesh) -> list[trimesh.Trimesh]:
    """The parts of a mesh for `MeshRenderer.render`: its geometries, ordered by name."""
    return [mesh.scene.geometry[name] for name in sorted(mesh.scene.geometry)]


def _refuse_too_many(scene: trimesh.Scene, source: str) -> None:
    """Count the parts and the triangles of all instances before any is copied."""
    faces, parts = 0, len(scene.graph.nodes_geometry)
    if parts > MAX_PARTS:
        raise MeshError(f"{source}: expected at most {MAX_PARTS} parts, found {parts}; merge them")
    for node in scene.graph.nodes_geometry:
        faces += len(getattr(scene.geometry[scene.graph[node][1]], "faces", ()))
    if faces > _DECIMATED_FROM * MAX_FACES:
        raise MeshError(
            f"{source}: expected at most {_DECIMATED_FROM * MAX_FACES} triangles before decimation, found {faces}; "
            "simplify the mesh"
        )


def _clean_parts(
    scene: trimesh.Scene, colours: ColourSpace, found: list[str], source: str
) -> tuple[list[trimesh.Trimesh], float]:
    """Clean meshes in the file's axes, one for each visible node, and the scale of their coordinates.

    trimesh's tolerances are absolute, so meshes are cleaned at about unit size. A power of two rounds nothing.

    Raises:
        MeshError: if a face refers to a missing vertex.
    """
    placed: list[tuple[str, trimesh.Trimesh, npt.NDArray[np.float64], Any]] = []
    images: dict[Any, Any] = {}
    for node in scene.graph.nodes_geometry:
        transform, key = scene.graph[node]
        geometry = scene.geometry[key]
        if not isinstance(geometry, trimesh.Trimesh):
            found.append(f"{key}: {type(geometry).__name__} left out, only triangles are drawn")
            continue
        if not len(geometry.faces):
            continue
        transform = np.asarray(transform, dtype=np.float64)
        if not np.isfinite(transform).all():
            found.append(f"{key}: left out, its transform is not finite")
            continue
        visual, lines, visible = canonical_visual(geometry, str(key), colours=colours, images=images)
        found += lines
        if not visible:
            found.append(f"{key}: fully transparent, left out")
            continue
        placed.append((str(key), geometry, transform, visual))
    parts = []
    try:
        for label, geometry, _, _ in placed:
            check_faces(geometry, label)  # of all parts, since each is compared with the others
        scale = _power_of_two([(geometry, transform) for _, geometry, transform, _ in placed])
        factors = np.array([[scale], [scale], [scale], [1.0]])
        meshes = [_transformed(geometry, factors * transform, visual) for _, geometry, transform, visual in placed]
        for (label, *_), mesh in zip(placed, meshes, strict=True):
            part, lines = clean(mesh, label, meshes)
            found += lines
            if part is not None:
                parts.append(part)
    except ValueError as error:
        raise MeshError(f"{source}: {error}; the file is damaged") from error
    return parts, scale


def _power_of_two(placed: list[tuple[trimesh.Trimesh, npt.NDArray[np.float64]]]) -> float:
    """The power of two that scales the largest extent of all faces into [0.5, 1); 1 without faces."""
    corners = [np.zeros((0, 3))]
    for mesh, transform in placed:
        points = np.asarray(mesh.vertices, dtype=np.float64)[np.unique(mesh.faces)]
        points = points @ transform[:3, :3].T + transform[:3, 3]
        points = points[np.isfinite(points).all(axis=1)]
        corners += [points.min(axis=0, keepdims=True), points.max(axis=0, keepdims=True)] if len(points) else []
    extent = float(np.ptp(np.concatenate(corners), axis=0).max()) if len(corners) > 1 else 0.0
    exponent = int(np.frexp(extent)[1]) if np.isfinite(extent) else 0
    return 2.0 ** -min(max(exponent, -1000), 1000)


def _transformed(mesh: trimesh.Trimesh, transform: npt.NDArray[np.float64], visual: Any = None) -> trimesh.Trimesh:
    """A transformed copy; mirroring transforms also reverse the faces."""
    linear = transform[:3, :3]
    vertices = np.asarray(mesh.vertices, dtype=np.float64) @ linear.T + transform[:3, 3]
    faces = np.asarray(mesh.faces)[:, ::-1] if np.linalg.det(linear) < 0 else np.asarray(mesh.faces)
    keywords: dict[str, Any] = {}
    if "vertex_normals" in mesh._cache.cache:
        normals = np.asarray(mesh.vertex_normals, dtype=np.float64) @ np.linalg.pinv(linear)
        length = np.linalg.norm(normals, axis=1, keepdims=True)
        keywords["vertex_normals"] = normals / np.where(length > 0, length, 1.0)
    result = trimesh.Trimesh(vertices, faces, visual=visual or mesh.visual, process=False, **keywords)
    result.metadata.update(
        {key: mesh.metadata[key] for key in ("smooth", "smoothing", "one_sided") if key in mesh.metadata}
    )
    return result


def _normalising_transform(
    parts: list[trimesh.Trimesh], scale: float, up: str, source: str, found: list[str]
) -> npt.NDArray[np.float64]:
    turn = _Y_FROM_Z if up == "z" else np.eye(4)
    points = np.concatenate([part.vertices for part in parts]) @ turn[:3, :3].T
    largest = float(np.abs(points).max())
    if largest / scale > 1e30:
        raise MeshError(
            f"{source}: expected coordinates below 1e30, found {largest / scale:.3g}; export the mesh again"
        )
    low, high = points.min(axis=0), points.max(axis=0)
    centre = (low + high) / 2
    radius = float(np.linalg.norm(points - centre, axis=1).max())
    if not radius > 1e-12 * largest:
        raise MeshError(f"{source}: expected a mesh with an extent, found all vertices in one point; export it again")
    near = np.linalg.norm(points - np.median(points, axis=0), axis=1)
    if near.max() > _OUTLIER * np.quantile(near, 0.9) > 0:
        found.append("a few vertices lie far from all others, so the object is small in its views")
    world_from_parts = turn / radius
    world_from_parts[:3, 3] = -centre / radius
    world_from_parts[3, 3] = 1.0
    return world_from_parts
