"""Finds the meshes of a folder: any mixture of mesh files, or a ShapeNetCore tree."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path

from data_gen.mesh_files import MESH_SUFFIXES, MeshError

__all__ = ["MeshFile", "find_meshes", "safe_name"]


@dataclass(frozen=True)
class MeshFile:
    """A mesh file that was found.

    Attributes:
        name: Unique in its folder and safe as the name of a file on any system.
        path: The file.
        class_name: Its class (``car``), if the tree tells.
        split: ``train``, ``val`` or ``test``, if the tree or its split file tells.
    """

    name: str
    path: Path
    class_name: str | None = None
    split: str | None = None


def safe_name(text: str) -> str:
    """Turn any text into the name of a file: letters, digits, dot, hyphen and underscore, at most 100 of them.

    Args:
        text: Any text.

    Returns:
        The name; ``mesh`` if nothing of the text is left.

    >>> safe_name("Tisch & Stühle/2.glb")
    'Tisch_Stuhle_2.glb'
    """
    plain = unicodedata.normalize("NFKD", text)
    plain = "".join(letter for letter in plain if not unicodedata.combining(letter))
    return re.sub(r"[^\w.-]+", "_", plain, flags=re.ASCII).strip("._-")[:100] or "mesh"


def find_meshes(folder: str | Path) -> list[MeshFile]:
    """List the meshes under a folder, sorted by name.

    Args:
        folder: A folder with mesh files at any depth.

    Returns:
        The meshes.

    Raises:
        MeshError: If the folder is absent or holds no mesh.
    """
    root = Path(folder)
    if not root.is_dir():
        raise MeshError(f"{root}: expected a folder of meshes, found {'a file' if root.exists() else 'nothing'}")
    paths = sorted(path for path in root.rglob("*") if path.suffix.lower() in MESH_SUFFIXES and path.is_file())
    if not paths:
        raise MeshError(f"{root}: expected mesh files ({', '.join(MESH_SUFFIXES)}), found none")
    return _unique(MeshFile(safe_name(path.relative_to(root).with_suffix("").as_posix()), path) for path in paths)


def _unique(found: Iterable[MeshFile]) -> list[MeshFile]:
    """Give equal names (also equal but for case) a number, and sort."""
    taken: set[str] = set()
    unique = []
    for mesh in found:
        name, number = mesh.name, 1
        while name.casefold() in taken:
            number += 1
            name = f"{mesh.name}_{number}"
        taken.add(name.casefold())
        unique.append(replace(mesh, name=name))
    return sorted(unique, key=lambda mesh: mesh.name)
