"""Masks that lie in a folder of their own, beside photographs that have no alpha."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from itertools import takewhile
from pathlib import Path

from hyperplanes.data.pictures.images import PICTURE_SUFFIXES
from hyperplanes.utilities.files import DataError, check_link

__all__ = ["find_masks", "match_masks"]


def find_masks(folders: Sequence[Path], pictures: Sequence[Path], root: Path) -> list[Path | None]:
    """The mask of each picture, found as `match_masks` does; white is what is kept.

    Args:
        folders: what may hold masks; the first one that exists counts.
        pictures: their files, some of which may be missing.
        root: as in `files.check_regular`.

    Returns:
        A file a picture, None for a picture that is missing, and for all where there is no such folder.

    Raises:
        DataError: some pictures have a mask and others have none, or a link leads out of the root.
    """
    folder = next((folder for folder in folders if folder.is_dir()), None)
    if folder is None or not any(picture.exists() for picture in pictures):
        return [None] * len(pictures)
    masks = match_masks(folder, pictures, root)
    present = [mask for mask, picture in zip(masks, pictures, strict=True) if picture.exists()]
    if not all(present):
        bare = [p.name for m, p in zip(masks, pictures, strict=True) if m is None and p.exists()]
        found = f"{len(present) - len(bare)}, none for {bare[0]}"
        raise DataError(
            folder, f"a mask for each of the {len(present)} pictures", found, "add them, or rename the folder"
        )
    return [mask if picture.exists() else None for mask, picture in zip(masks, pictures, strict=True)]


def match_masks(folder: Path, pictures: Sequence[Path], root: Path | None = None) -> list[Path | None]:
    """The mask of each picture, found by its name or by its number; None for those that have none.

    A mask has the name of its picture with any ending, that with _mask after it, or as COLMAP has it, the name with
    .png after the ending. Of several masks of one name in different folders it is the one whose folders have the same
    names as those of the picture. Where no name fits, there are as many masks as pictures and all names are numbers,
    as NeuS publishes image/000000.png beside mask/000.png, both are taken in the order of their numbers.

    Args:
        folder: what holds masks.
        pictures: their files.
        root: as in `find_masks`; the folder of the masks when None.

    Raises:
        DataError: no mask fits any picture, several of one name have folders that fit one equally well, or a link leads
            out of the root.
    """
    files = sorted(path for path in folder.rglob("*") if path.suffix.lower() in PICTURE_SUFFIXES)
    for path in files:
        check_link(path, root or folder)
    exact, with_ending = defaultdict[str, list[Path]](list), defaultdict[str, list[Path]](list)
    for path in files:
        with_ending[path.stem.removesuffix("_mask")].append(path)
        for name in {path.name, path.stem}:
            exact[name].append(path)
    if not files:
        return [None] * len(pictures)
    masks = []
    for picture in pictures:
        tables = [(table, name) for name in (picture.name, picture.stem) for table in (exact, with_ending)]
        found = next((table[name] for table, name in tables if table.get(name)), [])
        masks.append(_of_the_same_folders(found, picture, folder) if found else None)
    if any(masks):
        return masks
    if (by_number := _by_number(files, pictures)) is None:
        remedy = "rename them as the pictures, or number as many as there are pictures"
        raise DataError(folder, "masks named as the pictures", f"none of them for {pictures[0].name}", remedy)
    return list(by_number)


def _of_the_same_folders(masks: Sequence[Path], picture: Path, folder: Path) -> Path:
    """The mask in folders with the same names as those of a picture, the innermost first; the last of one folder."""

    def shared(mask: Path) -> int:
        pairs = zip(reversed(mask.relative_to(folder).parent.parts), reversed(picture.parent.parts), strict=False)
        return sum(1 for _ in takewhile(lambda pair: pair[0] == pair[1], pairs))

    most = max(map(shared, masks))
    best = [mask for mask in masks if shared(mask) == most]
    if len({mask.parent for mask in best}) > 1:
        raise DataError(
            folder,
            f"one mask for {picture}",
            f"{len(best)}: {', '.join(mask.relative_to(folder).as_posix() for mask in best[:3])}",
            "put the masks into folders with the same names as those of the pictures",
        )
    return best[-1]


def _by_number(masks: Sequence[Path], pictures: Sequence[Path]) -> list[Path] | None:
    """The masks of pictures in the order of their numbers; None where a name is none, or their counts differ."""
    names = [path.stem for path in (*masks, *pictures)]
    if len(masks) != len(pictures) or not all(name.isdecimal() and len(name) < 20 for name in names):
        return None
    order = sorted(range(len(pictures)), key=lambda index: int(pictures[index].stem))
    chosen = dict(zip(order, sorted(masks, key=lambda path: int(path.stem)), strict=True))
    return [chosen[index] for index in range(len(pictures))]
