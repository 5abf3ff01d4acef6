"""Any mesh, ready to be drawn: read, checked, turned y up, and scaled to a known size.

World convention: y up, the centre of the bounding box at the origin, the vertex farthest from it at distance 1
(``fit="sphere"``), or the longest side of the bounding box 2 units long (``fit="cube"``). Nothing is lost silently:
what cannot be drawn as the file says is named in ``Mesh.warnings``, what cannot be drawn at all is a ``MeshError``.
"""

from __future__ import annotations

import io
import logging
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
import trimesh

from data_gen.mesh_files import MESH_SUFFIXES, MeshError, ModelFolder, read_bytes
from data_gen.mesh_folders import MeshFile, find_meshes, safe_name
from data_gen.mesh_surfaces import canonical_visual

__all__ = [
    "MAX_FACES",
    "Mesh",
    "MeshError",
    "MeshFile",
    "find_meshes",
    "load_mesh",
    "prepare_scene",
    "render_ready",
]

MAX_FACES = 2_000_000
"""Triangles of a mesh at most, unless said otherwise."""

_Y_FROM_Z = np.array([[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])


@dataclass(frozen=True)
class Mesh:
    """A mesh that can be drawn.

    Attributes:
        name: Its name, safe as the name of a file.
        scene: Its geometries in world coordinates (all node transforms are the identity), y up, normalised.
        world_from_file: The similarity ``(4, 4)`` that took the file's coordinates here.
        warnings: What was lost or repaired, one line each.
        face_count: Triangles.
    """

    name: str
    scene: trimesh.Scene
    world_from_file: npt.NDArray[np.float64]
    warnings: tuple[str, ...]
    face_count: int


def load_mesh(
    path: str | Path,
    *,
    up: Literal["y", "z"] = "y",
    name: str | None = None,
    max_faces: int = MAX_FACES,
    fit: Literal["sphere", "cube"] = "sphere",
) -> Mesh:
    """Read a mesh file.

    Args:
        path: A GLB, glTF, OBJ, PLY, STL, OFF or DAE file.
        up: The axis that points up in the file.
        name: What to call it; the file's name by default.
        max_faces: Triangles at most.
        fit: What is normalised to radius 1: the bounding sphere, or half the longest side of the bounding box.

    Returns:
        The mesh.

    Raises:
        MeshError: If it cannot be read, holds nothing to draw, or is refused.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in MESH_SUFFIXES:
        raise MeshError(
            f"{path}: expected a file that ends in {', '.join(MESH_SUFFIXES)}, found {suffix or 'no ending'!r}"
        )
    data = read_bytes(path)
    folder = ModelFolder(path)
    logging.getLogger("trimesh").setLevel(logging.CRITICAL)
    try:
        scene = trimesh.load_scene(io.BytesIO(data), file_type=suffix[1:], resolver=folder, process=False)
    except Exception as error:
        if folder.refused is not None:
            raise folder.refused from error
        raise MeshError(
            f"{path}: expected a {suffix[1:].upper()} mesh, found {type(error).__name__}: {error}"
        ) from error
    if folder.refused is not None:
        raise folder.refused
    lost = [f"{reference}: {reason}" for reference, reason in folder.lost.items()]
    return prepare_scene(
        scene,
        name or safe_name(path.stem),
        up=up,
        max_faces=max_faces,
        fit=fit,
        srgb=suffix not in (".glb", ".gltf"),
        warnings=(*lost, *folder.notes),
        source=str(path),
    )


def prepare_scene(
    scene: trimesh.Scene,
    name: str,
    *,
    up: Literal["y", "z"] = "y",
    max_faces: int = MAX_FACES,
    fit: Literal["sphere", "cube"] = "sphere",
    srgb: bool = False,
    warnings: tuple[str, ...] = (),
    source: str | None = None,
) -> Mesh:
    """Check a scene and bring it into world coordinates; the scene itself is not changed.

    Args:
        scene: Geometries and node transforms.
        name: What to call the mesh.
        up: The axis that points up in the scene.
        max_faces: Triangles at most.
        fit: What is normalised to radius 1: the bounding sphere, or half the longest side of the bounding box.
        srgb: Whether plain colours are sRGB (most files) or linear (glTF, and pyrender's own convention).
        warnings: What is already known to be lost.
        source: What messages begin with; the name by default.

    Returns:
        The mesh.

    Raises:
        MeshError: If there is nothing to draw, or too much.
        ValueError: If ``up`` or ``fit`` is none of the two.
    """
    if up not in ("y", "z"):
        raise ValueError(f"up: expected 'y' or 'z', received {up!r}")
    if fit not in ("sphere", "cube"):
        raise ValueError(f"fit: expected 'sphere' or 'cube', received {fit!r}")
    source = source or name
    found = list(warnings)
    parts: list[trimesh.Trimesh] = []
    for node in scene.graph.nodes_geometry:
        transform, key = scene.graph[node]
        geometry = scene.geometry[key]
        if not isinstance(geometry, trimesh.Trimesh):
            found.append(f"{key}: {type(geometry).__name__} left out, only triangles are drawn")
            continue
        baked = _bake(geometry, np.asarray(transform, dtype=np.float64))
        visual, lines, visible = canonical_visual(baked, key, srgb=srgb)
        found += lines
        if not visible:
            found.append(f"{key}: fully transparent, left out")
            continue
        baked.visual = visual
        if len(baked.faces):
            parts.append(baked)
    if not parts:
        raise MeshError(f"{source}: expected triangles, found none; " + ("; ".join(found) or "export the mesh again"))
    faces = sum(len(part.faces) for part in parts)
    if faces > max_faces:
        raise MeshError(f"{source}: expected at most {max_faces} triangles, found {faces}; simplify the mesh")
    world_from_file = _normalising(parts, up, fit, source)
    ready = trimesh.Scene()
    for part in parts:
        moved = _bake(part, world_from_file)
        ready.add_geometry(moved, geom_name=f"part{len(ready.geometry)}")
    return Mesh(name, ready, world_from_file, tuple(dict.fromkeys(found)), faces)


def render_ready(mesh: Mesh) -> list[tuple[trimesh.Trimesh, npt.NDArray[np.float64], bool]]:
    """List what to hand to a renderer.

    Args:
        mesh: The mesh.

    Returns:
        Each geometry, its pose ``world_from_geometry`` ``(4, 4)``, and whether to shade it smoothly.
    """
    ready = []
    for node in sorted(mesh.scene.graph.nodes_geometry):
        pose, key = mesh.scene.graph[node]
        geometry = mesh.scene.geometry[key]
        ready.append((geometry, np.asarray(pose), geometry.visual.kind != "face"))
    return ready


def _bake(mesh: trimesh.Trimesh, transform: npt.NDArray[np.float64]) -> trimesh.Trimesh:
    """A copy in the coordinates that the transform leads to; a mirroring one also turns the faces around."""
    linear = transform[:3, :3]
    vertices = mesh.vertices @ linear.T + transform[:3, 3]
    mirrored = np.linalg.det(linear) < 0
    faces = np.asarray(mesh.faces)[:, ::-1] if mirrored else np.asarray(mesh.faces)
    keywords: dict[str, Any] = {}
    if "vertex_normals" in mesh._cache.cache:
        normals = np.asarray(mesh.vertex_normals) @ np.linalg.pinv(linear)
        length = np.linalg.norm(normals, axis=1, keepdims=True)
        keywords["vertex_normals"] = normals / np.where(length > 0, length, 1.0)
    return trimesh.Trimesh(vertices, faces, visual=mesh.visual.copy(), process=False, **keywords)


def _normalising(parts: list[trimesh.Trimesh], up: str, fit: str, source: str) -> npt.NDArray[np.float64]:
    turn = _Y_FROM_Z if up == "z" else np.eye(4)
    points = np.concatenate([part.vertices[np.unique(part.faces)] for part in parts]) @ turn[:3, :3].T
    if not np.isfinite(points).all() or np.abs(points).max() > 1e30:
        raise MeshError(f"{source}: expected finite coordinates below 1e30, found others; export the mesh again")
    low, high = points.min(axis=0), points.max(axis=0)
    centre = (low + high) / 2
    radius = np.linalg.norm(points - centre, axis=1).max() if fit == "sphere" else (high - low).max() / 2
    if not radius > 1e-12:
        raise MeshError(f"{source}: expected a mesh with an extent, found all vertices in one point")
    world_from_file = turn / radius
    world_from_file[:3, 3] = -centre / radius
    world_from_file[3, 3] = 1.0
    return world_from_file
