"""The folder of one model: gives a mesh loader its materials, textures and buffers, and no other files.

All names in a mesh file are resolved here. Nothing outside the given folder, and nothing from the network, is opened.
trimesh's FilePathResolver drops ShapeNet's `../images/x.jpg` without a warning, or may open any file.
"""

from __future__ import annotations

import os
import re
import unicodedata
import urllib.parse
from collections.abc import Iterable, Iterator
from functools import cached_property
from pathlib import Path, PurePosixPath

from trimesh.resolvers import Resolver

from data_gen.meshes.files import MAX_FILE_BYTES, MAX_PIXELS, MeshError, check_image, read_bytes
from hyperplanes.utilities.files.encoding import sha256

__all__ = ["MAX_REFERENCES", "ModelFolder", "model_checksums", "model_root", "without_comment"]

MAX_REFERENCES = 2000
"""Most different names of other files in a mesh. Looking for a missing one takes about 1 ms."""

_CODE_PAGES = ("cp1252", "cp437", "cp932", "gb18030", "cp1251")

_MTL_OPTION = re.compile(
    r"^\s*-(?:(?:blendu|blendv|cc|clamp|imfchan|type|texres|boost|bm)\s+\S+|(?:o|s|t)(?:\s+[-+.\deE]+){1,3}"
    r"|mm\s+\S+\s+\S+)\s+"
)


def without_comment(name: str) -> str:
    """A name in a text file without a comment: a # after a space and what follows. Names may contain # otherwise.

    >>> without_comment("wood.png # the floor"), without_comment("C#4")
    ('wood.png', 'C#4')
    """
    return re.split(r"\s#", name, maxsplit=1)[0].rstrip()


def model_root(path: Path) -> Path:
    """The folder that holds all files of a model.

    Returns:
        `ID` for ShapeNet's `ID/models/model_normalized.obj`, whose textures are in `ID/images`; `NAME` for Gazebo's
        `NAME/meshes/x.dae` if there is a `NAME/materials`; else the folder of the file.
    """
    folder = path.parent.resolve()
    of_shapenet = (folder.name, path.name) == ("models", "model_normalized.obj")
    of_gazebo = folder.name.lower() == "meshes" and (folder.parent / "materials").is_dir()
    return folder.parent if of_shapenet or of_gazebo else folder


def model_checksums(path: Path, names: Iterable[str], within: Path) -> dict[str, str | None]:
    """Checksums of the files of a model, without parsing them.

    Args:
        path: the mesh file.
        names: of other files, as the mesh refers to them; may include that of the mesh file itself.
        within: as in `ModelFolder`.

    Returns:
        The checksums of the mesh, by its file name, and of the file that each name refers to, None for missing files.
        Empty for a model that would be refused.
    """
    try:
        others = ModelFolder(path, within).checksums(name for name in names if name != path.name)
        return {path.name: sha256(path.read_bytes()), **others}
    except (MeshError, OSError):
        return {}


class ModelFolder(Resolver):
    """Gives a mesh loader the other files of its model, from one folder only.

    Names are accepted as they occur in files: with backslashes, percent-encoded, in the wrong case, behind MTL options
    (`-s 1 1 1 wood.png`), before comments, or as `model://NAME/rest`, which refers to a folder NAME, or else to the
    model's own. A missing file is looked for by the last part of its name, as in Blender: beside the mesh, and in the
    folders that usually hold textures. That is noted.

    Args:
        path: the mesh file; messages begin with its name.
        within: the folder that must contain all files; `model_root(path)` when None, and if the file is not in it.

    A missing file, or a texture that cannot be decoded, is a FileNotFoundError and noted in `lost`.

    Attributes:
        lost: why each requested name could not be opened.
        notes: remarks for the user about names that were found elsewhere.
        refused: the first reason to refuse the whole model, if any, since loaders swallow exceptions.
    """

    def __init__(self, path: Path, within: Path | None) -> None:
        self.path = path
        self.folder = path.parent.resolve()
        self.root = model_root(path) if within is None else within.resolve()
        if not self.folder.is_relative_to(self.root):
            self.root = model_root(path)
        self.pixels_left = MAX_PIXELS
        self.lost: dict[str, str] = {}
        self.notes: list[str] = []
        self.refused: MeshError | None = None
        self._bytes: dict[Path, bytes] = {}
        self._places: dict[str, Path | None] = {}
        self._images: set[Path] = set()

    def get(self, name: str) -> bytes:
        """The content of a file for a loader: one that was read before, or a texture."""
        found = self._find(name)
        return self._bytes[found] if found in self._bytes else self.get_image(name)

    def read(self, name: str, *, limit: int = MAX_FILE_BYTES) -> bytes:
        """The content of a file of the model other than a texture, of at most `limit` bytes.

        Raises:
            FileNotFoundError: if the file is missing or empty; noted in `lost`.
            MeshError: if it lies outside the model's folder or is too large; noted in `refused`.
        """
        found = self._find(name)
        try:
            if found not in self._bytes:
                if found.stat().st_size == 0:
                    self.lost.setdefault(name, "an empty file")
                    raise FileNotFoundError(name)
                self._bytes[found] = read_bytes(found, limit=limit)
        except MeshError as error:
            self.refused = self.refused or error
            raise
        return self._bytes[found]

    def get_image(self, name: str) -> bytes:
        """The content of a texture of the model, decoded once to check that it is intact."""
        found = self._find(name)
        if found not in self._images:
            self.count_pixels(self.read(name), name)
            self._images.add(found)
        return self._bytes[found]

    def _find(self, name: str) -> Path:
        try:
            found = self.locate(name)
        except MeshError as error:
            self.refused = self.refused or error
            raise
        if found is None:
            outside = _is_absolute(name.strip().strip('"'))
            self.lost.setdefault(name, "absolute path not followed" if outside else "not found")
            raise FileNotFoundError(name)
        return found

    def count_pixels(self, data: bytes, name: str) -> None:
        """Check a texture and count its pixels.

        Raises:
            FileNotFoundError: if it cannot be decoded; noted in `lost`.
            MeshError: if the textures are too large.
        """
        try:
            self.pixels_left -= check_image(data, f"{self.path}: {name}", limit=self.pixels_left)
        except MeshError as error:
            self.refused = self.refused or error
            raise
        except ValueError as error:
            self.lost.setdefault(name, str(error))
            raise FileNotFoundError(f"{name}: {error}") from error

    def locate(self, name: str) -> Path | None:
        """Find a file of the model without reading it.

        Absolute paths are never opened; a file of that name beside the mesh is.

        Returns:
            The file, or None if there is none.

        Raises:
            MeshError: if the name leaves the model's folder, or the mesh refers to too many files.
        """
        if name not in self._places:
            if len(self._places) >= MAX_REFERENCES:
                raise MeshError(
                    f"{self.path}: expected at most {MAX_REFERENCES} references to other files, found more; merge its "
                    "materials"
                )
            self._places[name] = self._locate(name)
        return self._places[name]

    def checksums(self, names: Iterable[str] | None = None) -> dict[str, str | None]:
        """The checksum of the file that each name refers to, None for missing files.

        Args:
            names: how the mesh refers to files; all names requested so far when None.
        """
        places = {name: self.locate(name) for name in (list(self._places) if names is None else names)}
        return {
            name: None if place is None else sha256(self._bytes.get(place) or place.read_bytes())
            for name, place in places.items()
        }

    def _locate(self, name: str) -> Path | None:
        plain = name.strip().strip('"')
        if "\0" in plain:
            return None
        candidates = list(_candidates(plain))
        places = [*self._of_named_model(plain), *(self.folder / each for each in candidates if not _is_absolute(each))]
        for place in places:
            found = self._file(place)
            if found is not None:
                return found
        for last in dict.fromkeys(PurePosixPath(each.replace("\\", "/")).name for each in candidates):
            for folder in self._usual_folders:
                found = self._file(folder / last) if last else None
                if found is not None:
                    why = "absolute path not followed" if _is_absolute(plain) else "not there"
                    self._note(f"{plain}: {why}, {found.relative_to(self.root).as_posix()} taken")
                    return found
        if any(self._leaves(place) for place in places):
            raise MeshError(
                f"{self.path}: expected references inside {self.root.name}/, found {plain!r}, which leaves it; put the "
                "file beside the mesh"
            )
        return None

    def _of_named_model(self, name: str) -> Iterator[Path]:
        """Possible places of `model://NAME/rest`: in a folder NAME above the mesh, or beside one of those."""
        parts = name.partition("://")[2].split("/")
        if not name.startswith("model://") or len(parts) < 2 or parts[0] in ("", ".", ".."):
            return
        for above in (self.folder, *self.folder.parents):
            if not above.is_relative_to(self.root):
                return
            if above.name == parts[0]:
                yield above.joinpath(*parts[1:])
            yield above.joinpath(*parts)

    @cached_property
    def _usual_folders(self) -> list[Path]:
        """Those that exist, listed once: a mesh may name thousands of textures."""
        names = ("", "textures", "texture", "images", "maps", "materials/textures")
        places = dict.fromkeys((self.folder, model_root(self.path)))
        return [folder / name for folder in places for name in names if os.path.isdir(folder / name)]

    def _leaves(self, place: Path) -> bool:
        try:
            return not place.resolve().is_relative_to(self.root)
        except (OSError, RuntimeError):
            return False

    def _file(self, place: Path) -> Path | None:
        """The file at a place inside the root, or one whose name differs in case; None if there is none."""
        try:
            path = place.resolve()
            if not path.is_relative_to(self.root):
                return None
            return path if path.is_file() else self._other_case(path)
        except (OSError, RuntimeError):
            return None

    def _other_case(self, path: Path) -> Path | None:
        if path == self.root or not path.parent.is_dir():
            return None
        wanted = _plain_case(path.name)
        for entry in sorted(path.parent.iterdir()):
            if _plain_case(entry.name) == wanted and entry.is_file():
                return entry if entry.resolve().is_relative_to(self.root) else None
        return None

    def _note(self, text: str) -> None:
        if text not in self.notes:
            self.notes.append(text)

    def keys(self) -> Iterator[str]:
        """Names of the files beside the mesh, as the interface of trimesh's resolvers requires."""
        yield from sorted(entry.name for entry in self.folder.iterdir())

    def write(self, name: str, data: str | bytes) -> None:
        """Raise a PermissionError: models are read-only."""
        raise PermissionError(f"{name}: the folder of a model is only read")

    def namespaced(self, namespace: str) -> ModelFolder:
        """The same folder, since names do not change."""
        return self


def _candidates(name: str) -> Iterator[str]:
    """Relative paths that a name may mean, most likely first."""
    uri = re.match(r"^(?:model|package|file)://(.*)$", name)
    if uri:
        parts = [part for part in uri.group(1).split("/") if part]
        yield "/".join(parts[1:])
        yield "/".join(parts[-1:])
        return
    plain = name.replace("\\", "/")
    yield name
    yield plain
    yield urllib.parse.unquote(plain)
    unprefixed = plain
    while (option := _MTL_OPTION.match(unprefixed)) is not None:
        unprefixed = unprefixed[option.end() :]
    for bare in dict.fromkeys((unprefixed.strip(), without_comment(unprefixed).strip())):
        if bare != plain:
            yield bare
        yield from _other_code_pages(bare)


def _other_code_pages(name: str) -> Iterator[str]:
    """A name that was read as Latin-1, in the code pages of other systems."""
    if name.isascii():
        return
    for page in _CODE_PAGES:
        try:
            yield name.encode("latin-1").decode(page)
        except UnicodeError:
            continue


def _plain_case(name: str) -> str:
    """A name without differences between file systems: case and the encoding of accents."""
    return unicodedata.normalize("NFC", name).casefold()


def _is_absolute(name: str) -> bool:
    return name.startswith(("/", "\\", "~")) or re.match(r"^[A-Za-z]:[\\/]", name) is not None
