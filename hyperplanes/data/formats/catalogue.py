"""The content of a data set in any layout: names, splits, and a function that reads one object."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any

from hyperplanes.data.formats.scenes.transforms_json import read_transforms_task
from hyperplanes.data.pictures.posed import PosedTask
from hyperplanes.utilities.files.reading import LONGEST_NAME, MANIFEST, PROGRESS_FOLDER, DataError, read_json

__all__ = ["SPLITS", "Catalogue", "is_plain", "native", "refuse_unfinished"]

SPLITS = ("train", "val", "test")


@dataclass(frozen=True)
class Catalogue:
    """The objects of a data set.

    Attributes:
        layout: "native", "posed", "srn", "learnit-128", "hyperplanes-200", "nmr", "co3d", "objaverse" or
            "omniobject3d".
        splits: the names of the objects in each of SPLITS, in their order.
        read: returns the images of the object of a name.
        manifest: the content of manifest.json. Without this file: the classes of the objects if known, otherwise empty.
        skipped: a message about each list of objects of which some were skipped.
    """

    layout: str
    splits: dict[str, tuple[str, ...]]
    read: Callable[[str], PosedTask]
    manifest: dict[str, Any] = field(default_factory=dict)
    skipped: tuple[str, ...] = ()


def native(folder: Path, manifest: dict[str, Any]) -> Catalogue:
    """The catalogue of a native data set.

    Returns:
        The catalogue.

    Raises:
        DataError: a manifest of another version, or splits that are not lists of plain names.
    """
    source = folder / MANIFEST
    if manifest.get("version") != 1:
        raise DataError(source, "version 1", repr(manifest.get("version")), "read it with the release that wrote it")
    splits = manifest_splits(source, manifest)

    def read(name: str) -> PosedTask:
        return read_transforms_task(folder / name, name, complete=True, root=folder)

    return Catalogue("native", splits, read, manifest)


def refuse_unfinished(folder: Path) -> None:
    """Refuse a data set whose generation was interrupted: it has no splits yet.

    A data set with a manifest was finished before.

    Raises:
        DataError: `generate` has not finished writing into the folder.
    """
    progress = folder / PROGRESS_FOLDER
    if (folder / MANIFEST).is_file() or not (progress / "configuration.json").is_file():
        return
    source = read_json(progress / "configuration.json").get("source")
    total = source.get("count", source.get("meshes")) if isinstance(source, dict) else None
    written = sum(1 for _ in (progress / "done").glob("*.json"))
    of_all = f" of {total}" if isinstance(total, int) else ""
    found = f"an unfinished one ({written}{of_all} objects)"
    raise DataError(folder, "a finished data set", found, "run the same `hyperplanes generate` command again")


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
    if not 0 < len(name.encode(errors="replace")) <= LONGEST_NAME:
        return False
    return PurePosixPath(name).name == name and name not in {".", ".."} and "\\" not in name and "\0" not in name
