"""Reads STL files with trimesh, after comparing their length with their header.

trimesh alone loads an ASCII STL cut at 5 of 440 places without a warning and with faces missing.
"""

from __future__ import annotations

import io
import re

import numpy as np
import trimesh

from data_gen.meshes.files import MeshError
from data_gen.meshes.model_folder import ModelFolder

__all__ = ["read_stl"]


def read_stl(data: bytes, folder: ModelFolder) -> tuple[trimesh.Scene, list[str]]:
    """The geometry of an STL file, shaded flat, and warnings; a MeshError if it was cut or holds no triangles."""
    data, warnings = _check(data, folder)
    scene = trimesh.load_scene(io.BytesIO(data), file_type="stl", resolver=folder, process=False)
    for geometry in scene.geometry.values():
        geometry.metadata["smooth"] = False
    return scene, warnings


def _check(data: bytes, folder: ModelFolder) -> tuple[bytes, list[str]]:
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
