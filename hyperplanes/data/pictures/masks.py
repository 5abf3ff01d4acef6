"""Masks that lie in a folder of their own, beside photographs that have no alpha."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from hyperplanes.data.pictures.images import PICTURE_SUFFIXES
from hyperplanes.utilities.files import DataError

__all__ = ["find_masks"]


def find_masks(folder: Path, pictures: Sequence[Path]) -> list[Path | None] | None:
    """The mask of each picture, found by its name.

    A mask is called as its picture with any ending, or as COLMAP has it, as its picture with .png after it; white is
    what is kept.

    Args:
        folder: what may hold masks.
        pictures: their files, some of which may be missing.

    Returns:
        A file a picture, None for a picture that is missing; None where there is no such folder.

    Raises:
        DataError: some pictures have a mask and others have none.
    """
    if not folder.is_dir():
        return None
    root = folder.resolve()
    files = sorted(path for path in folder.rglob("*") if path.suffix.lower() in PICTURE_SUFFIXES)
    files = [path for path in files if path.resolve().is_relative_to(root)]
    by_name = {path.name: path for path in files} | {path.stem: path for path in files}
    masks = [by_name.get(picture.name) or by_name.get(picture.stem) for picture in pictures]
    present = [mask for mask, picture in zip(masks, pictures, strict=True) if picture.is_file()]
    if present and not any(present):
        raise DataError(folder, "masks named as the pictures", f"none of them for {pictures[0].name}", "rename them")
    if not all(present):
        bare = [p.name for m, p in zip(masks, pictures, strict=True) if m is None and p.is_file()]
        found = f"{len(present) - len(bare)}, none for {bare[0]}"
        raise DataError(
            folder, f"a mask for each of the {len(present)} pictures", found, "add them, or rename the folder"
        )
    return [mask if picture.is_file() else None for mask, picture in zip(masks, pictures, strict=True)]
