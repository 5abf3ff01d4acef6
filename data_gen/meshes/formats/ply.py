"""Reads PLY files with trimesh, after comparing their length with their header.

trimesh alone loads an ASCII PLY cut at 24 of 233 places without a warning and with faces missing.
"""

from __future__ import annotations

import io
import re
from typing import Any

import numpy as np
import trimesh
from trimesh.exchange.ply import load_ply

from data_gen.meshes.files import UNFINISHED, MeshError, decode_text
from data_gen.meshes.formats.colours import rgba_bytes
from data_gen.meshes.model_folder import ModelFolder
from data_gen.meshes.triangulate import TOO_FEW_CORNERS, fan, retriangulate

__all__ = ["read_ply"]

_BYTES = {"char": 1, "uchar": 1, "int8": 1, "uint8": 1, "short": 2, "ushort": 2, "int16": 2, "uint16": 2}


def read_ply(data: bytes, folder: ModelFolder) -> tuple[trimesh.Scene, list[str]]:
    """The geometry of a PLY file, and warnings.

    trimesh cuts every polygon into a fan, gives each triangle the colour of the polygon with the same index, draws
    texture coordinates without a texture dark, and takes the lower 8 bits of 16-bit colours.

    Raises:
        MeshError: if it was cut or holds no faces.
    """
    vertices, faces, warnings = _check(data, folder)
    if not faces:
        raise MeshError(f"{folder.path}: expected faces, found {vertices} points only; make a surface of them first")
    loaded = load_ply(io.BytesIO(data), resolver=folder)
    elements = loaded["metadata"].pop("_ply_raw")
    if loaded.pop("entities", None) is not None:  # edges, whose points replaced the vertices
        loaded["vertices"] = np.column_stack([elements["vertex"]["data"][axis] for axis in "xyz"])
    for name, keyword in (("vertex", "vertex_colors"), ("face", "face_colors")):
        if loaded.get(keyword) is not None:
            columns = elements[name]["data"]
            alpha = columns["alpha"] if "alpha" in elements[name]["properties"] else None
            loaded[keyword] = rgba_bytes(np.column_stack([columns[each] for each in ("red", "green", "blue")]), alpha)
    small = _cut_polygons(loaded, elements, folder) if "vertices" in loaded else 0
    if small:
        warnings.append(f"{small} {TOO_FEW_CORNERS}")
    texture = re.search(rb"^comment\s+TextureFile\s+(.+)$", data[:65536], re.MULTILINE | re.IGNORECASE)
    if texture is None or folder.lost:
        loaded.pop("visual", None)
    mesh = trimesh.Trimesh(**loaded | {"process": False})
    if len(mesh.faces) < faces - small:
        raise MeshError(
            f"{folder.path}: expected {faces - small} faces, found {len(mesh.faces)}: the file was cut; fetch it again"
        )
    if texture and folder.lost:
        warnings.append(f"drawn without its texture {decode_text(texture.group(1)).strip()}")
    return trimesh.Scene(mesh), warnings


def _check(data: bytes, folder: ModelFolder) -> tuple[int, int, list[str]]:
    """Numbers of vertices and faces in the header, checked against the size of the file, and warnings."""
    head, mark, body = data.partition(b"end_header")
    if not data.startswith(b"ply") or not mark:
        raise MeshError(f"{folder.path}: expected a PLY header to end_header, found none; fetch it again")
    header = decode_text(head)
    body = body.lstrip(b"\r")[1:]
    counts = {name: int(count) for name, count in re.findall(r"^element\s+(\w+)\s+(\d+)", header, re.MULTILINE)}
    ascii_format = re.search(r"^format\s+ascii", header, re.MULTILINE) is not None
    total = sum(counts.values())
    held = body.count(b"\n") + (not body.endswith(b"\n")) if ascii_format else len(body)
    if total > held:
        what = "lines" if ascii_format else "bytes"
        raise MeshError(
            f"{folder.path}: expected {total} elements, found {held} {what}: the file was cut; fetch it again"
        )
    if not ascii_format and (need := _fixed_bytes(header, counts)) > len(body):
        raise MeshError(f"{folder.path}: expected {need} bytes or more, found {len(body)}: it was cut; fetch it again")
    warnings = [UNFINISHED] if ascii_format and not body.endswith(b"\n") else []
    left_out = sorted(set(counts) - {"vertex", "face"})
    warnings += [f"{counts[name]} elements {name!r} left out" for name in left_out if counts[name]]
    return counts.get("vertex", 0), counts.get("face", 0), warnings


def _fixed_bytes(header: str, counts: dict[str, int]) -> int:
    """The fewest bytes that the elements of a binary PLY file take, with three indices per face."""
    need, element = 0, ""
    for words in (line.split() for line in header.splitlines()):
        if words[:1] == ["element"]:
            element = words[1]
        elif words[:1] == ["property"] and words[1] == "list":
            least = 3 if element == "face" and words[-1].startswith("vertex_ind") else 0
            need += counts[element] * (_BYTES.get(words[2], 4) + least * _BYTES.get(words[3], 4))
        elif words[:1] == ["property"]:
            need += counts[element] * (8 if words[1] in ("double", "float64") else _BYTES.get(words[1], 4))
    return need


def _cut_polygons(loaded: dict[str, Any], elements: dict[str, Any], folder: ModelFolder) -> int:
    """Triangulate the polygons of a PLY file where a fan is wrong, or triangles need the colour of their polygon.

    Returns:
        The number of faces with fewer than 3 corners.

    Raises:
        MeshError: if a face refers to a missing vertex.
    """
    polygons = _polygons(elements.get("face", {}).get("data"))
    if polygons is None:
        return 0
    sizes = np.array([len(polygon) for polygon in polygons], dtype=np.int64)
    small = int((sizes < 3).sum())
    vertices = np.asarray(loaded["vertices"], dtype=np.float64)
    if small == len(sizes) or (sizes == 3).all():
        return small
    if len(vertices) != elements["vertex"]["length"]:
        return small  # split at the seams of its texture
    starts = np.cumsum(np.maximum(sizes - 2, 0)) - np.maximum(sizes - 2, 0)
    fans = [np.asarray(polygon, dtype=np.int64)[fan(len(polygon))] for polygon in polygons if len(polygon) > 2]
    triangles = np.concatenate(fans)
    if triangles.min() < 0 or triangles.max() >= len(vertices):
        raise MeshError(
            f"{folder.path}: expected faces on its {len(vertices)} vertices, found one on vertex {triangles.max()}; "
            "the file is damaged"
        )
    before = triangles.copy()
    larger = [(int(starts[index]), list(polygons[index])) for index in np.flatnonzero(sizes > 3)]
    retriangulate(triangles, larger, vertices)
    colours = loaded.get("face_colors")
    if colours is not None and len(colours) == len(polygons):
        loaded["face_colors"] = np.asarray(colours)[np.repeat(np.arange(len(sizes)), np.maximum(sizes - 2, 0))]
    elif (before == triangles).all():
        return small
    loaded["faces"] = triangles
    return small


def _polygons(data: Any) -> Any:
    """The vertex indices of each face, as read by trimesh; None if there are none."""
    names = ("vertex_indices", "vertex_index")
    if isinstance(data, dict):
        return next((data[name] for name in names if name in data), None)
    if isinstance(data, np.ndarray) and data.dtype.names:
        name = next((name for name in names if name in data.dtype.names), data.dtype.names[0])
        return data[name]["f1"] if data[name].dtype.names else None
    return data if isinstance(data, np.ndarray) and data.ndim == 2 else None
