"""Finds the meshes of a folder: any mixture of mesh files, or a ShapeNetCore tree."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path

from data_gen.meshes.files import MESH_SUFFIXES, OTHER_SUFFIXES, MeshError
from data_gen.meshes.shapenet import class_of_synset, find_models, is_shapenet, paper_split, read_split_file

__all__ = ["MeshFile", "find_meshes", "find_unreadable", "safe_name"]


@dataclass(frozen=True)
class MeshFile:
    """A mesh file that was found.

    Attributes:
        name: unique in its folder and safe as the name of a file on any system.
        path: the file.
        class_name: its class (`car`), if the tree states it.
        split: `train`, `val` or `test`, if the tree or its split file states it.
    """

    name: str
    path: Path
    class_name: str | None = None
    split: str | None = None


def safe_name(text: str) -> str:
    """Turn any text into the name of a file: letters, digits, dot, hyphen and underscore, at most 100 of them.

    Args:
        text: any text.

    Returns:
        The name; `mesh` if nothing of the text is left.

    >>> safe_name("Tisch & Stühle/2.glb")
    'Tisch_Stuhle_2.glb'
    """
    plain = unicodedata.normalize("NFKD", text)
    plain = "".join(letter for letter in plain if not unicodedata.combining(letter))
    return re.sub(r"[^\w.-]+", "_", plain, flags=re.ASCII).strip("._-")[:100] or "mesh"


def find_meshes(folder: str | Path, *, split_file: str | Path | None = None) -> list[MeshFile]:
    """List the meshes under a folder, sorted by name.

    A ShapeNetCore tree (or one class of it) gives `CLASS_ID` with class and split: the official split if its file is
    given or lies in the folder as `all.csv` (a model that it does not list has none), else that of the paper. Any
    other folder gives every mesh file at any depth, named by its path, without class and split, but for hidden files.

    Args:
        folder: the folder.
        split_file: ShapeNet's official `all.csv`.

    Returns:
        The meshes, their names unique even where case does not count.

    Raises:
        MeshError: if the folder is absent or holds no mesh, or the split file cannot be read.
    """
    root = Path(folder)
    if not root.is_dir():
        raise MeshError(
            f"{root}: expected a folder of meshes, found {'a file' if root.exists() else 'nothing'}; give the folder"
        )
    if is_shapenet(root):
        return _shapenet(root, Path(split_file) if split_file is not None else root / "all.csv", split_file is not None)
    if split_file is not None:
        raise MeshError(
            f"{root}: expected a ShapeNetCore tree for {split_file}, found none; give the folder of synsets"
        )
    paths = sorted(path for path in root.rglob("*") if _is_mesh(path, root))
    if not paths:
        raise MeshError(f"{root}: expected mesh files ({', '.join(MESH_SUFFIXES)}), found none; convert yours to one")
    return _unique(MeshFile(safe_name(path.relative_to(root).with_suffix("").as_posix()), path) for path in paths)


def find_unreadable(folder: str | Path) -> list[Path]:
    """List the files under a folder that are meshes of a format which is not read.

    Args:
        folder: the folder.

    Returns:
        Their paths from the folder on, sorted; none of a ShapeNetCore tree.
    """
    root = Path(folder)
    if is_shapenet(root):
        return []
    return sorted(path.relative_to(root) for path in root.rglob("*") if _is_mesh(path, root, OTHER_SUFFIXES))


def _is_mesh(path: Path, root: Path, suffixes: tuple[str, ...] = MESH_SUFFIXES) -> bool:
    if path.suffix.lower() not in suffixes:
        return False
    hidden = any(part.startswith(".") or part == "__MACOSX" for part in path.relative_to(root).parts)
    return not hidden and path.is_file()


def _shapenet(root: Path, split_path: Path, is_required: bool) -> list[MeshFile]:
    models = find_models(root)
    split = read_split_file(split_path) if is_required or split_path.is_file() else paper_split(models)
    return _unique(
        MeshFile(
            name=safe_name(f"{class_of_synset(model.synset)}_{model.model_id}"),
            path=model.path,
            class_name=class_of_synset(model.synset),
            split=split.get((model.synset, model.model_id)),
        )
        for model in models
    )


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
