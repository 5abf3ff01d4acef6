"""Reads PLY and STL files with trimesh, after checks, and OFF files without it.

Each check compares the length of the file with its header. trimesh alone loads an ASCII PLY cut at 24 of 233 places, an
ASCII STL at 5 of 440 and an OFF at 24 of 89, without a warning and with faces missing, and drops the vertex and face
colours of OFF files.
"""

from __future__ import annotations

import io
import re
from typing import Any

import numpy as np
import numpy.typing as npt
import trimesh
from trimesh.exchange.ply import load_ply

from data_gen.meshes.files import MeshError
from data_gen.meshes.model_folder import ModelFolder
from data_gen.meshes.mtl import decode_text
from data_gen.meshes.triangulate import TOO_FEW_CORNERS, fan, retriangulate

__all__ = ["read_off", "read_ply", "read_stl"]

_CUT = "the last line does not end: the file may have been cut"
_PLY_BYTES = {"char": 1, "uchar": 1, "int8": 1, "uint8": 1, "short": 2, "ushort": 2, "int16": 2, "uint16": 2}


def read_stl(data: bytes, folder: ModelFolder) -> tuple[trimesh.Scene, list[str]]:
    """The geometry of an STL file, shaded flat, and warnings; a MeshError if it was cut or holds no triangles."""
    data, warnings = _check_stl(data, folder)
    scene = trimesh.load_scene(io.BytesIO(data), file_type="stl", resolver=folder, process=False)
    for geometry in scene.geometry.values():
        geometry.metadata["smooth"] = False
    return scene, warnings


def _check_stl(data: bytes, folder: ModelFolder) -> tuple[bytes, list[str]]:
    """The file without bytes behind its last triangle, and warnings."""
    count = int.from_bytes(data[80:84], "little") if len(data) >= 84 else 0
    spare = len(data) - 84 - 50 * count
    text = b"" if spare == 0 else data.lower()
    is_text = text.lstrip().startswith(b"solid") and b"facet" in text
    if spare == 0 or (spare > 0 and count and not is_text):
        if count == 0:
            raise MeshError(f"{folder.path}: expected triangles, found an STL with none; export the mesh again")
        data = data[: len(data) - spare]
        colours = np.frombuffer(data[84:], dtype=np.dtype([("numbers", "<f4", 12), ("colour", "<u2")]))["colour"]
        warnings = ["colours of its triangles (an extension of STL) left out"] if (colours & 0x8000).any() else []
        return data, [*warnings, *([f"{spare} bytes behind its last triangle left out"] if spare else [])]
    if not is_text:
        raise MeshError(
            f"{folder.path}: expected {count} triangles in {84 + 50 * count} bytes, found {len(data)} bytes: the "
            "file was cut or is no STL; fetch it again"
        )
    opened, closed = len(re.findall(rb"\bfacet\s", text)), text.count(b"endfacet")
    if opened != closed or opened * 3 != len(re.findall(rb"\bvertex\s", text)) or b"endsolid" not in text:
        raise MeshError(f"{folder.path}: expected {opened} whole facets and endsolid, found {closed}; fetch it again")
    return data, []


def _check_ply(data: bytes, folder: ModelFolder) -> tuple[int, int, list[str]]:
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
    warnings = [_CUT] if ascii_format and not body.endswith(b"\n") else []
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
            need += counts[element] * (_PLY_BYTES.get(words[2], 4) + least * _PLY_BYTES.get(words[3], 4))
        elif words[:1] == ["property"]:
            need += counts[element] * (8 if words[1] in ("double", "float64") else _PLY_BYTES.get(words[1], 4))
    return need


def read_ply(data: bytes, folder: ModelFolder) -> tuple[trimesh.Scene, list[str]]:
    """The geometry of a PLY file, and warnings.

    trimesh cuts every polygon into a fan, gives each triangle the colour of the polygon with the same index, draws
    texture coordinates without a texture dark, and takes the lower 8 bits of 16-bit colours.

    Raises:
        MeshError: if it was cut or holds no faces.
    """
    vertices, faces, warnings = _check_ply(data, folder)
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
            loaded[keyword] = _colours(np.column_stack([columns[each] for each in ("red", "green", "blue")]), alpha)
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


def _cut_polygons(loaded: dict[str, Any], elements: dict[str, Any], folder: ModelFolder) -> int:
    """Triangulate the polygons of a PLY file where a fan is wrong, or triangles need the colour of their polygon.

    Returns:
        The number of faces with fewer than 3 corners.

    Raises:
        MeshError: if a face refers to a missing vertex.
    """
    polygons = _ply_polygons(elements.get("face", {}).get("data"))
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


def _ply_polygons(data: Any) -> Any:
    """The vertex indices of each face, as read by trimesh; None if there are none."""
    names = ("vertex_indices", "vertex_index")
    if isinstance(data, dict):
        return next((data[name] for name in names if name in data), None)
    if isinstance(data, np.ndarray) and data.dtype.names:
        name = next((name for name in names if name in data.dtype.names), data.dtype.names[0])
        return data[name]["f1"] if data[name].dtype.names else None
    return data if isinstance(data, np.ndarray) and data.ndim == 2 else None


def read_off(data: bytes, folder: ModelFolder) -> tuple[trimesh.Scene, list[str]]:
    """The geometry of an OFF file with vertex (COFF) or face colours, and warnings."""
    warnings = [] if data.endswith((b"\n", b"\r")) else [_CUT]
    lines = [line.partition("#")[0].split() for line in decode_text(data).splitlines()]
    lines = [line for line in lines if line]
    if not lines or not re.fullmatch(r"(ST|C|N){0,3}OFF.*", lines[0][0]):
        raise MeshError(
            f"{folder.path}: expected OFF on the first line, found {' '.join(lines[0]) if lines else ''!r:.40}"
        )
    kind = lines[0][0].partition("OFF")[0]
    first = [lines[0][0].partition("OFF")[2], *lines[0][1:]]
    rest = ([numbers] if (numbers := [word for word in first if word]) else []) + lines[1:]
    table, triangles, colours = _off_body(rest, folder, warnings)
    keywords: dict[str, Any] = {}
    skip = 6 if "N" in kind else 3
    more = table.shape[1] - skip - 2 * kind.count("ST")
    if "C" in kind and more >= 3:
        keywords["vertex_colors"] = _colours(table[:, skip : skip + 3], table[:, skip + 3 : skip + 4])
    elif colours is not None:
        keywords["face_colors"] = _colours(colours[:, :3], colours[:, 3:])
    if "C" not in kind and more > 0:
        warnings.append(f"{more} numbers behind each vertex left out: colours need COFF on the first line")
    if "N" in kind:
        keywords["vertex_normals"] = table[:, 3:6]
    mesh = trimesh.Trimesh(table[:, :3], triangles, process=False, **keywords)
    return trimesh.Scene(mesh), warnings


def _off_body(lines: list[list[str]], folder: ModelFolder, warnings: list[str]) -> tuple[Any, Any, Any]:
    """The table of vertices, the triangles and their colours or None."""
    try:
        vertex_count, face_count = int(lines[0][0]), int(lines[0][1])
        last = vertex_count + face_count + 1
        if min(vertex_count, face_count) < 0 or len(lines) < last:
            raise ValueError(f"{vertex_count} vertices and {face_count} faces declared in {len(lines) - 1} lines")
        table = np.array(lines[1 : vertex_count + 1], dtype=np.float64).reshape(vertex_count, -1)
        return table, *_off_faces(lines[vertex_count + 1 : last], table[:, :3], warnings)
    except (ValueError, IndexError) as error:
        raise MeshError(
            f"{folder.path}: expected whole OFF vertices and faces, found {error}; the file is damaged or was cut"
        ) from error


def _off_faces(lines: list[list[str]], positions: npt.NDArray[np.float64], warnings: list[str]) -> tuple[Any, Any]:
    vertex_count = len(positions)
    triangles: list[tuple[int, int, int]] = []
    polygons: list[tuple[int, list[int]]] = []
    colours: list[list[float]] = []
    small = 0
    for line in lines:
        size = int(line[0])
        corners = [int(word) for word in line[1 : size + 1]]
        if len(corners) != size or not all(0 <= corner < vertex_count for corner in corners):
            raise ValueError(" ".join(line)[:60])
        colour = [float(word) for word in line[size + 1 : size + 5]]
        small += size < 3
        if size > 3:
            polygons.append((len(triangles), corners))
        for index in range(1, size - 1):
            triangles.append((corners[0], corners[index], corners[index + 1]))
            colours.append(colour)
    if small:
        warnings.append(f"{small} {TOO_FEW_CORNERS}")
    widths = {len(colour) for colour in colours}
    usable = widths in ({3}, {4})
    if not usable and widths - {0}:
        found = " and ".join(map(str, sorted(widths)))
        warnings.append(f"colours of its faces left out: expected 3 or 4 numbers behind every one, found {found}")
    faces = np.array(triangles, dtype=np.int64).reshape(-1, 3)
    retriangulate(faces, polygons, positions)
    return faces, np.array(colours) if usable else None


def _colours(colours: npt.NDArray[Any], alpha: npt.NDArray[Any] | None) -> npt.NDArray[np.uint8]:
    """RGBA of colours (item, 3) and their alpha (item,) or (item, 0 or 1)."""
    rgba = np.full((len(colours), 4), 255, dtype=np.uint8)
    rgba[:, :3] = _of_255(colours)
    if alpha is not None and alpha.size:
        rgba[:, 3] = _of_255(alpha.reshape(-1))
    return rgba


def _of_255(values: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Values scaled to 0 to 255: floats from 1, or from 255 if any is above 1; integers from the largest of their type.

    Integers of at most 255 are not scaled: many programs write them in wider types.
    """
    values = np.where(np.isfinite(values), values, 0)
    largest = values.max(initial=0)
    if values.dtype.kind == "f":
        top = 255.0 if largest > 1 else 1.0
    else:
        top = float(np.iinfo(values.dtype).max) if largest > 255 else 255.0
    return np.clip(np.round(values * (255.0 / top)), 0, 255)
