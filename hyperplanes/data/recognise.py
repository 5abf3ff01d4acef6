"""Which layout lies at a path."""

from __future__ import annotations

from pathlib import Path

from hyperplanes.data import colmap, npz, srn
from hyperplanes.data.catalogue import FORMAT, Catalogue, native
from hyperplanes.data.posed import PosedTask
from hyperplanes.data.transforms_json import find_transforms, read_transforms_task
from hyperplanes.files import DataError, read_json

__all__ = ["find_catalogue", "posed_folder", "read_posed_task"]


def find_catalogue(path: str | Path, *, legacy: bool = False) -> Catalogue:
    """The catalogue of whatever lies at a path.

    A manifest.json that names its layout decides; else the folder's content does: a posed scene (one object, in the
    test split), SRN's, learnit's or the HyperPlanes authors' layout, or a folder of posed scenes (all in the test
    split).

    Args:
        path: a folder, or a transforms file.
        legacy: of learnit's and the authors' layouts, as in `npz.read_npz`.

    Returns:
        The catalogue; no picture has been read yet.

    Raises:
        DataError: nothing that is known lies there.
    """
    path = Path(path)
    if path.is_file() and path.suffix == ".json":
        return posed_folder(path.parent)
    if not path.is_dir():
        raise DataError(path, "the folder of a data set", "nothing", "check the path, or run hyperplanes generate")
    manifest = read_json(path / "manifest.json") if (path / "manifest.json").is_file() else {}
    if manifest.get("format") == FORMAT and manifest.get("layout", "native") == "native":
        return native(path, manifest)
    found = srn.catalogue(path, manifest) or npz.catalogue(path, manifest, legacy=legacy)
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


def posed_folder(folder: Path) -> Catalogue:
    """One posed scene as a data set of one test object."""
    name = folder.resolve().name
    splits = {"train": (), "val": (), "test": (name,)}
    return Catalogue("posed", splits, lambda _: read_posed_task(folder, name))


def read_posed_task(folder: Path, name: str) -> PosedTask:
    """Support and query of a posed scene: transforms files, or a COLMAP model whose views alternate."""
    if find_transforms(folder):
        return read_transforms_task(folder, name)
    return PosedTask.alternating(colmap.read_colmap(folder), name)
