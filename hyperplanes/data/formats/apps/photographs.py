"""Where the photographs lie that a program names in its file of cameras, as it found them on another machine."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path, PurePosixPath

from hyperplanes.data.pictures.images import PICTURE_SUFFIXES
from hyperplanes.data.pictures.masks import find_masks
from hyperplanes.utilities.files import DataError, inside, list_files

__all__ = ["find_photographs"]

_HOMES = ("images", "input", "photos", "rgb", ".")


def find_photographs(
    folder: Path, names: Sequence[str], source: Path, root: Path
) -> tuple[list[Path], list[Path | None]]:
    """The files of photographs, and their masks.

    Of each name only the last part counts, its ending only where there is one; of images/, input/, photos/, rgb/ and
    the folder itself that which holds most of them is taken. Masks lie in masks/ in the folder.

    Args:
        folder: what holds the file of cameras.
        names: as that file writes them: paths of any system, file names, or file names without ending.
        source: that file, for messages.
        root: no file may lie outside of it, symbolic links followed.

    Returns:
        A path a name, of a file that need not be there, and a mask or None each.

    Raises:
        DataError: a name that no file can have, two names of one photograph, two photographs of one name without
            ending, or none of the photographs.
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
        remedy = "move those away that the cameras are not of"
        raise DataError(source, f"one photograph {several[0]}", "several, with different endings", remedy)
    paths = [known[home].get(name.lower()) or inside(folder / home, name, source) for name in plain]
    if not any(path.is_file() for path in paths):
        places = ", ".join(f"{name}/" for name in _HOMES[:-1])
        raise DataError(source, f"its photographs beside it or in {places}", f"no {plain[0]}", "copy them there")
    if len(set(paths)) < len(paths):
        twice = next(path.name for path in paths if paths.count(path) > 1)
        raise DataError(source, "a name for each photograph", f"{twice} more than once", "export the cameras again")
    return paths, find_masks([folder / "masks"], paths, root)
