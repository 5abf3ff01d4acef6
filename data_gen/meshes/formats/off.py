"""Reads OFF files.

trimesh loads an OFF file cut at 24 of 89 places without a warning and with faces missing, and drops vertex and face
colours.
"""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import numpy.typing as npt
import trimesh

from data_gen.meshes.files import UNFINISHED, MeshError, decode_text
from data_gen.meshes.formats.colours import rgba_bytes
from data_gen.meshes.model_folder import ModelFolder
from data_gen.meshes.triangulate import TOO_FEW_CORNERS, retriangulate

__all__ = ["read_off"]


def read_off(data: bytes, folder: ModelFolder) -> tuple[trimesh.Scene, list[str]]:
    """The geometry of an OFF file with vertex (COFF) or face colours, and warnings."""
    warnings = [] if data.endswith((b"\n", b"\r")) else [UNFINISHED]
    lines = [line.partition("#")[0].split() for line in decode_text(data).splitlines()]
    lines = [line for line in lines if line]
    if not lines or not re.fullmatch(r"(ST|C|N){0,3}OFF.*", lines[0][0]):
        raise MeshError(
            f"{folder.path}: expected OFF on the first line, found {' '.join(lines[0]) if lines else ''!r:.40}"
        )
    kind = lines[0][0].partition("OFF")[0]
    first = [lines[0][0].partition("OFF")[2], *lines[0][1:]]
    rest = ([numbers] if (numbers := [word for word in first if word]) else []) + lines[1:]
    table, triangles, colours = _body(rest, folder, warnings)
    keywords: dict[str, Any] = {}
    skip = 6 if "N" in kind else 3
    more = table.shape[1] - skip - 2 * kind.count("ST")
    if "C" in kind and more >= 3:
        keywords["vertex_colors"] = rgba_bytes(table[:, skip : skip + 3], table[:, skip + 3 : skip + 4])
    elif colours is not None:
        keywords["face_colors"] = rgba_bytes(colours[:, :3], colours[:, 3:])
    if "C" not in kind and more > 0:
        warnings.append(f"{more} numbers behind each vertex left out: colours need COFF on the first line")
    if "N" in kind:
        keywords["vertex_normals"] = table[:, 3:6]
    mesh = trimesh.Trimesh(table[:, :3], triangles, process=False, **keywords)
    return trimesh.Scene(mesh), warnings


def _body(lines: list[list[str]], folder: ModelFolder, warnings: list[str]) -> tuple[Any, Any, Any]:
    """The table of vertices, the triangles and their colours or None."""
    try:
        vertex_count, face_count = int(lines[0][0]), int(lines[0][1])
        last = vertex_count + face_count + 1
        if min(vertex_count, face_count) < 0 or len(lines) < last:
            raise ValueError(f"{vertex_count} vertices and {face_count} faces declared in {len(lines) - 1} lines")
        table = np.array(lines[1 : vertex_count + 1], dtype=np.float64).reshape(vertex_count, -1)
        return table, *_faces(lines[vertex_count + 1 : last], table[:, :3], warnings)
    except (ValueError, IndexError) as error:
        raise MeshError(
            f"{folder.path}: expected whole OFF vertices and faces, found {error}; the file is damaged or was cut"
        ) from error


def _faces(lines: list[list[str]], positions: npt.NDArray[np.float64], warnings: list[str]) -> tuple[Any, Any]:
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
