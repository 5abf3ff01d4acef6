"""Masks in a folder of their own, for photographs without alpha."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from itertools import takewhile
from pathlib import Path

from hyperplanes.data.pictures.images import PICTURE_SUFFIXES
from hyperplanes.utilities.files.reading import DataError, check_link

__all__ = ["find_masks", "match_masks"]


def find_masks(folders: Sequence[Path], pictures: Sequence[Path], root: Path) -> list[Path | None]:
    """The mask of each image, found as by `match_masks`; white marks the object.

    Args:
        folders: which may hold masks; the first one that exists and is not empty is used.
        pictures: the image files, some of which may be missing.
        root: as in `reading.check_regular`.

    Returns:
        A file for each image; None for a missing image, and for all images if there is no such folder.

    Raises:
        DataError: the folder lacks the mask of an image, or a link leads out of the root.
    """
    folder = next((folder for folder in folders if folder.is_dir() and any(folder.iterdir())), None)
    if folder is None or not any(picture.exists() for picture in pictures):
        return [None] * len(pictures)
    masks = match_masks(folder, pictures, root)
    present = [mask for mask, picture in zip(masks, pictures, strict=True) if picture.exists()]
    if not all(present):
        bare = [p.name for m, p in zip(masks, pictures, strict=True) if m is None and p.exists()]
        found = f"{len(present) - len(bare)}, none for {bare[0]}"
        raise DataError(
            folder, f"a mask for each of the {len(present)} images", found, "add the others, or rename the folder"
        )
    return [mask if picture.exists() else None for mask, picture in zip(masks, pictures, strict=True)]


def match_masks(folder: Path, pictures: Sequence[Path], root: Path | None = None) -> list[Path | None]:
    """The mask of each image, matched by name or by number; None for an image without a mask.

    The mask of NAME.jpg may be called NAME or NAME_mask with any suffix or, as in COLMAP, NAME.jpg.png. If several
    folders hold masks of that name, the one whose parent folders match those of the image best is taken. If no name
    matches any image, but there are as many masks as images and all names are numbers, they are paired in numerical
    order; NeuS, for example, publishes image/000000.png with mask/000.png.

    Args:
        folder: the folder with the masks, which are searched in its subfolders too.
        pictures: the image files.
        root: as in `find_masks`; if None, the folder of the masks.

    Returns:
        A file or None for each image; only None if the folder holds no masks.

    Raises:
        DataError: no mask matches any image, the parent folders of several masks match those of an image equally well,
            or a link leads out of the root.
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
        remedy = "name the masks as the images, or number as many masks as there are numbered images"
        raise DataError(folder, "masks named as the images", f"none for {pictures[0].name}", remedy)
    return list(by_number)


def _of_the_same_folders(masks: Sequence[Path], picture: Path, folder: Path) -> Path:
    """The mask whose parent folders, from the innermost on, match most of those of an image; the last in its folder."""

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
            "put the masks into folders with the same names as those of the images",
        )
    return best[-1]


def _by_number(masks: Sequence[Path], pictures: Sequence[Path]) -> list[Path] | None:
    """The masks paired with images in numerical order; None if a name is no number, or their counts differ."""
    names = [path.stem for path in (*masks, *pictures)]
    if len(masks) != len(pictures) or not all(name.isdecimal() and len(name) < 20 for name in names):
        return None
    order = sorted(range(len(pictures)), key=lambda index: int(pictures[index].stem))
    chosen = dict(zip(order, sorted(masks, key=lambda path: int(path.stem)), strict=True))
    return [chosen[index] for index in range(len(pictures))]
