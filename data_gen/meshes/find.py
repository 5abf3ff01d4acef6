"""Finds the meshes of a folder: any mixture of mesh files, or a ShapeNetCore tree."""

from __future__ import annotations

import os
import re
import unicodedata
from collections import defaultdict
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path

from data_gen.meshes.files import MESH_SUFFIXES, OTHER_SUFFIXES, MeshError
from data_gen.meshes.shapenet import class_of_synset, find_models, is_shapenet, paper_split, read_split_file
from hyperplanes.utilities.files.encoding import sha256

__all__ = ["FoundMeshes", "MeshFile", "find_meshes", "safe_name"]

_BEST_FIRST = (".glb", ".gltf", ".obj", ".dae", ".ply", ".off", ".stl")
"""Formats in order of how much of an object's look they store; of an object in several, the first is taken."""

_FORMATS = "|".join(suffix.removeprefix(".") for suffix in (*MESH_SUFFIXES, *OTHER_SUFFIXES))
_NAMES_A_FORMAT = re.compile(
    rf"({_FORMATS}|collada|blender)s?([\W_]*(binary|draco|embedded|files?|formats?|mesh(es)?|models?|quantized))*", re.I
)
"""Names of folders in packs of objects: `OBJ format`, `glTF-Binary`, `FBX`, `Blends`."""

_SAME_FORMAT = {"glb": "gltf", "collada": "dae", "blender": "blend"}


@dataclass(frozen=True)
class MeshFile:
    """A mesh file.

    Attributes:
        name: unique in its folder and safe as a file name on any system.
        path: the file.
        class_name: its class (`car`), if the tree states it.
        split: `train`, `val` or `test`, if the tree or its split file states it.
    """

    name: str
    path: Path
    class_name: str | None = None
    split: str | None = None


@dataclass(frozen=True)
class FoundMeshes:
    """The meshes of a folder.

    Attributes:
        meshes: the readable ones, sorted by name; one file per object.
        unreadable: files in unsupported formats, those beside the models of a ShapeNetCore tree, and folders that are
            not searched, as relative paths with the reason.
        duplicates: files that hold the same object as one of `meshes` in another format, likewise.
    """

    meshes: list[MeshFile]
    unreadable: list[tuple[str, str]] = field(default_factory=list)
    duplicates: list[tuple[str, str]] = field(default_factory=list)


def safe_name(text: str) -> str:
    """Turn any text into a file name of at most 100 ASCII letters, digits, dots, hyphens and underscores.

    Few fonts have other letters; those of our contact sheets and of matplotlib do not.

    Returns:
        The name; `mesh` if nothing is left, with a checksum of the text where letters are lost.

    >>> safe_name("Tisch & Stühle/2.glb")
    'Tisch_Stuhle_2.glb'
    >>> safe_name("стол 2.glb"), safe_name("стул 2.glb")
    ('2.glb_db4391bf', '2.glb_a87eab70')
    """
    plain = unicodedata.normalize("NFKD", text)
    plain = "".join(letter for letter in plain if not unicodedata.combining(letter))
    name = re.sub(r"[^\w.-]+", "_", plain, flags=re.ASCII).strip("._-")[:100]
    if name and not any(letter.isalnum() and not letter.isascii() for letter in plain):
        return name
    return f"{name[:91] or 'mesh'}_{sha256(os.fsencode(unicodedata.normalize('NFC', text)))[:8]}"


def find_meshes(
    folder: str | Path,
    *,
    split_file: str | Path | None = None,
    reason_against: Callable[[Path], str | None] = lambda _: None,
) -> FoundMeshes:
    """List the meshes under a folder.

    A ShapeNetCore tree (or one class of it) gives `CLASS_ID` with class and split: the official split if its file is
    given or is the folder's `all.csv` (models that it does not list have none), else that of the paper. Any other
    folder gives every mesh file at any depth except hidden ones, named by its path, without class and split. Files of
    the same name beside each other, or in folders named after formats, are one object, of which the best file is
    taken. Links are followed, to each folder once.

    Args:
        folder: the folder.
        split_file: ShapeNet's official `all.csv`.
        reason_against: gives the reason not to search a subfolder: None to search it, an empty string to skip it
            silently.

    Returns:
        The meshes, with names that are unique even without regard to case, and what is left out.

    Raises:
        MeshError: if the folder is absent or holds no mesh, or the split file cannot be read.
    """
    root = Path(folder)
    if not root.is_dir():
        raise MeshError(
            f"{root}: expected a folder of meshes, found {'a file' if root.exists() else 'nothing'}; give the folder"
        )
    if is_shapenet(root):
        split_path = Path(split_file) if split_file is not None else root / "all.csv"
        return _shapenet(root, split_path, split_file is not None, reason_against)
    if split_file is not None:
        raise MeshError(
            f"{root}: expected a ShapeNetCore tree for {split_file}, found none; give the folder of synsets"
        )
    objects: dict[tuple[str, ...], list[Path]] = defaultdict(list)
    files, unreadable = _mesh_files(root, reason_against)
    plain = {path for path in files if not _object_of(path)[1]}
    for path in files:
        place, _ = _object_of(path)
        # both in the folder of its format and beside that: two objects
        twice = path not in plain and Path(*place[:-1], place[-1] + path.suffix) in plain
        objects[path.parts if twice else place].append(path)
    taken, duplicates = [], []
    for paths in objects.values():
        best = min(paths, key=lambda path: (_rank(path), path))
        if _rank(best) < len(_BEST_FIRST):
            taken.append(best)
            duplicates += [(str(path), f"the same object as {best}, which is taken") for path in paths if path != best]
        else:
            wanted = f"expected one of {', '.join(MESH_SUFFIXES)}"
            unreadable += [(str(path), f"{wanted}, found {path.suffix}; convert it") for path in paths]
    if not taken:
        raise MeshError(f"{root}: expected mesh files ({', '.join(MESH_SUFFIXES)}), found none; convert yours to one")
    named = [MeshFile(safe_name(str(path.with_suffix(""))), root / path) for path in sorted(taken)]
    return FoundMeshes(_unique(named), sorted(unreadable), sorted(duplicates))


def _mesh_files(root: Path, reason_against: Callable[[Path], str | None]) -> tuple[list[Path], list[tuple[str, str]]]:
    """Relative paths of the mesh files under a folder except hidden ones, sorted, and folders that are left out.

    Each folder is searched once: in its place if that is under the root, else through the first link to it.
    """
    found, left_out = [], []
    folders, links, seen = [Path()], [], set()
    while folders or links:
        folder = folders.pop() if folders else links.pop(0)
        try:
            status = os.stat(root / folder)
            if (status.st_dev, status.st_ino) in seen:
                continue
            seen.add((status.st_dev, status.st_ino))
            reason = reason_against(root / folder) if folder.parts else None
            if reason is not None:
                left_out += [(str(folder), reason)] if reason else []
                continue
            with os.scandir(root / folder) as entries:
                inner = sorted(entries, key=lambda entry: entry.name)
        except OSError as error:
            left_out.append((str(folder), f"expected a folder that can be read, found {error.strerror}"))
            continue
        for entry in inner:
            path = folder / entry.name
            if entry.name.startswith(".") or entry.name == "__MACOSX":
                continue
            if entry.is_dir(follow_symlinks=False):
                folders.append(path)
            elif os.path.isdir(entry):
                links.append(path)
            elif path.suffix.lower() in (*MESH_SUFFIXES, *OTHER_SUFFIXES) and os.path.isfile(entry):
                found.append(path)
    return sorted(found), left_out


def _object_of(path: Path) -> tuple[tuple[str, ...], bool]:
    """A key shared by the files of one object, and whether this file lies in a folder named after its format."""

    def format_of(name: str) -> str:
        return _SAME_FORMAT.get(name.lower(), name.lower())

    folders, own = path.parts[:-1], format_of(path.suffix.removeprefix("."))
    left = [
        name for name in folders if (found := _NAMES_A_FORMAT.fullmatch(name)) is None or format_of(found[1]) != own
    ]
    return (*left, path.stem), len(left) < len(folders)


def _rank(path: Path) -> int:
    suffix = path.suffix.lower()
    return _BEST_FIRST.index(suffix) if suffix in _BEST_FIRST else len(_BEST_FIRST)


def _shapenet(
    root: Path, split_path: Path, is_required: bool, reason_against: Callable[[Path], str | None]
) -> FoundMeshes:
    models = find_models(root)
    split = read_split_file(split_path) if is_required or split_path.is_file() else paper_split(models)
    folders = {model.folder for model in models}
    others, left_out = _mesh_files(root, lambda folder: "" if folder in folders else reason_against(folder))
    reason = "expected a model of the ShapeNetCore tree, found another mesh; give the folder that holds it alone"
    meshes = _unique(
        MeshFile(
            name=safe_name(f"{class_of_synset(model.synset)}_{model.model_id}"),
            path=model.path,
            class_name=class_of_synset(model.synset),
            split=split.get((model.synset, model.model_id)),
        )
        for model in models
    )
    return FoundMeshes(meshes, sorted([*left_out, *((str(path), reason) for path in others)]))


def _unique(found: Iterable[MeshFile]) -> list[MeshFile]:
    """Append numbers to names that are equal without regard to case, and sort."""
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
