"""Find the photographs that a program names in its file of cameras, often by their paths on another machine."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path, PurePosixPath

from hyperplanes.data.pictures.images import PICTURE_SUFFIXES
from hyperplanes.data.pictures.masks import find_masks
from hyperplanes.utilities.files.reading import DataError, inside, list_files

__all__ = ["find_photographs"]

_HOMES = ("images", "input", "photos", "rgb", ".")


def find_photographs(
    folder: Path, names: Sequence[str], source: Path, root: Path
) -> tuple[list[Path], list[Path | None]]:
    """The files of photographs, and their masks.

    Only the file name in each path is used. It may lack the suffix. The photographs are taken from the one of images/,
    input/, photos/, rgb/ and the folder itself that holds most of them. Masks lie in masks/ in the folder.

    Args:
        folder: that holds the file of cameras.
        names: as that file writes them: paths of any operating system, file names, or file names without a suffix.
        source: that file, for messages.
        root: no file may lie outside it, symbolic links followed.

    Returns:
        For each name a path, at which a file need not exist; and for each a mask or None.

    Raises:
        DataError: an impossible file name, two names for one photograph, a name without suffix that fits two
            photographs, or none of the photographs.
    """
    plain = [PurePosixPath(name.replace("\\", "/")).name for name in names]
    listed = {home: list_files(folder / home, PICTURE_SUFFIXES, root) for home in _HOMES if (folder / home).is_dir()}
    known = {
        home: {path.stem.lower(): path for path in files} | {path.name.lower(): path for path in files}
        for home, files in listed.items()
    }
    home = max(known, key=lambda each: sum(name.lower() in known[each] for name in plain))
    stems = Counter(path.stem.lower() for path in listed[home])
    if several := [name for name in plain if stems[name.lower()] > 1]:
        remedy = "remove those that the cameras do not belong to"
        raise DataError(source, f"one photograph {several[0]}", "several, with different endings", remedy)
    paths = [known[home].get(name.lower()) or inside(folder / home, name, source) for name in plain]
    if not any(path.is_file() for path in paths):
        places = ", ".join(f"{name}/" for name in _HOMES[:-1])
        raise DataError(source, f"its photographs beside it or in {places}", f"no {plain[0]}", "copy them there")
    if len(set(paths)) < len(paths):
        twice = next(path.name for path in paths if paths.count(path) > 1)
        raise DataError(source, "a name for each photograph", f"{twice} more than once", "export the cameras again")
    return paths, find_masks([folder / "masks"], paths, root)
