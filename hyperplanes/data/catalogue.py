"""What a data set holds, whatever its layout: names, splits, and how to read one object."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any

from hyperplanes.data.errors import DataError
from hyperplanes.data.files import read_json
from hyperplanes.data.posed import PosedTask
from hyperplanes.data.transforms_json import find_transforms, read_transforms_task

__all__ = ["FORMAT", "SPLITS", "Catalogue", "find_catalogue", "native"]

FORMAT = "hyperplanes-dataset"
"""The value of "format" in a native manifest.json."""

SPLITS = ("train", "val", "test")


@dataclass(frozen=True)
class Catalogue:
    """The objects of a data set.

    Attributes:
        layout: "native", "posed", "srn", "learnit-128" or "hyperplanes-200".
        splits: the names of each of SPLITS, in their order.
        read: from a name to its pictures.
        manifest: what manifest.json says, empty without one.
    """

    layout: str
    splits: dict[str, tuple[str, ...]]
    read: Callable[[str], PosedTask]
    manifest: dict[str, Any] = field(default_factory=dict)


def find_catalogue(path: str | Path) -> Catalogue:
    """The catalogue of whatever lies at a path.

    A manifest.json that names its layout decides; else the folder's content does: a posed scene (one object, in the
    test split), SRN's, learnit's or the HyperPlanes authors' layout, or a folder of posed scenes (all in the test
    split).

    Args:
        path: a folder, or a transforms file.

    Returns:
        The catalogue; no picture has been read yet.

    Raises:
        DataError: nothing that is known lies there.
    """
    from hyperplanes.data import colmap, npz, srn

    path = Path(path)
    if path.is_file() and path.suffix == ".json":
        return posed_folder(path.parent)
    if not path.is_dir():
        raise DataError(path, "the folder of a data set", "nothing", "check the path, or run hyperplanes generate")
    manifest = read_json(path / "manifest.json") if (path / "manifest.json").is_file() else {}
    if manifest.get("format") == FORMAT and manifest.get("layout", "native") == "native":
        return native(path, manifest)
    for layout in (srn, npz):
        found = layout.catalogue(path, manifest)
        if found is not None:
            return found
    if find_transforms(path) or colmap.find_model(path) is not None:
        return posed_folder(path)
    children = sorted(child.name for child in path.iterdir() if child.is_dir() and find_transforms(child))
    if children:
        splits = {"train": (), "val": (), "test": tuple(children)}
        return Catalogue("posed", splits, lambda name: read_transforms_task(path / name, name))
    found_names = ", ".join(sorted(child.name for child in path.iterdir())[:5]) or "an empty folder"
    raise DataError(path, "a data set or posed images", found_names, "generate one with hyperplanes generate")


def native(folder: Path, manifest: dict[str, Any]) -> Catalogue:
    """The catalogue of a native data set.

    Args:
        folder: what holds manifest.json.
        manifest: its content.

    Returns:
        The catalogue.

    Raises:
        DataError: a manifest of another version, or splits that are not lists of plain names.
    """
    source = folder / "manifest.json"
    if manifest.get("version") != 1:
        raise DataError(source, "version 1", repr(manifest.get("version")), "read it with the release that wrote it")
    splits = manifest_splits(source, manifest)
    return Catalogue("native", splits, lambda name: read_transforms_task(folder / name, name), manifest)


def manifest_splits(source: Path, manifest: dict[str, Any]) -> dict[str, tuple[str, ...]]:
    """The names in each split of a manifest, checked to be plain file names.

    Raises:
        DataError: no splits, or names that are not plain file names.
    """
    splits = manifest.get("splits")
    if not isinstance(splits, dict):
        raise DataError(source, "splits, a list of names each", repr(splits)[:40], "generate the data set again")
    result = {}
    for split in SPLITS:
        names = splits.get(split, [])
        if not isinstance(names, list) or not all(isinstance(name, str) and is_plain(name) for name in names):
            raise DataError(source, f"plain names in splits.{split}", repr(names)[:60], "correct the manifest")
        result[split] = tuple(names)
    return result


def is_plain(name: str) -> bool:
    """Whether a name is a single path component.

    >>> is_plain("car_0001"), is_plain("../car"), is_plain("")
    (True, False, False)
    """
    return PurePosixPath(name).name == name and name not in {"", ".", ".."} and "\\" not in name and "\0" not in name


def posed_folder(folder: Path) -> Catalogue:
    """One posed scene as a data set of one test object."""
    name = folder.resolve().name
    splits = {"train": (), "val": (), "test": (name,)}
    return Catalogue("posed", splits, lambda _: read_posed_task(folder, name))


def read_posed_task(folder: Path, name: str) -> PosedTask:
    """Support and query of a posed scene: transforms files, or a COLMAP model whose views alternate."""
    from hyperplanes.data import colmap

    if find_transforms(folder):
        return read_transforms_task(folder, name)
    return PosedTask.alternating(colmap.read_colmap(folder), name)
