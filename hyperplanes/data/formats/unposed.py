"""Detect what has no poses (photographs, videos, exports, unfinished captures), and say how posed images are made."""

from __future__ import annotations

from pathlib import Path

from hyperplanes.data.pictures.images import HEIF_SUFFIXES, PICTURE_SUFFIXES, VIDEO_SUFFIXES
from hyperplanes.utilities.files.reading import DataError
from hyperplanes.utilities.messages.shell import command_line

__all__ = ["find_video", "photographs_folder", "refuse_unposed"]

_HOMES = (".", "images", "input", "rgb", "photos", "image", "rgbd", "keyframes/images")
_COUNTED = 10_000  # most entries of a folder that are counted
_FIRST_STAGES = ("pictures", "frames")  # of `hyperplanes capture`, which keeps its stages in capture/ of the scene
_PHOTOGRAPHS = PICTURE_SUFFIXES | HEIF_SUFFIXES
_PACKED = frozenset({".zip", ".r3d"})  # Record3D's .r3d is a ZIP archive


def refuse_unposed(path: Path) -> None:
    """Raise an error that says what to do if posed images can be made from what a path holds.

    Raises:
        DataError: the path holds an unfinished capture, photographs without poses, a video, or an archive.
    """
    packed = _packed(path)
    if packed is not None:
        remedy = f"unpack it ({command_line('unzip', packed, '-d', 'capture')}), then give that folder"
        raise DataError(path, "the folder of an export", f"{packed.name}, which is packed", remedy)
    if any((path / "capture" / f"{stage}.json").is_file() for stage in _FIRST_STAGES):
        remedy = f"continue it: {command_line('hyperplanes', 'capture', 'PHOTOS', '--out', path)}"
        raise DataError(path, "a scene", "an unfinished capture", remedy)
    home, count = _photographs(path)
    if count:
        raise DataError(
            path,
            "camera poses beside the photographs (transforms.json, or a COLMAP model in sparse/0)",
            f"{count} photograph{'s' if count > 1 else ''} and no poses",
            f"find them: {command_line('hyperplanes', 'capture', home, '--out', 'NEW')}, then give NEW",
        )
    if (video := find_video(path)) is not None:
        command = command_line("hyperplanes", "capture", video, "--out", "scene")
        remedy = f"find the poses of its frames: {command}, then give scene"
        raise DataError(path, "posed images", "a video", remedy)


def _packed(path: Path) -> Path | None:
    """The archive at a path: the file itself, or the only file in the folder; None if there is none."""
    if path.is_file():
        return path if path.suffix.lower() in _PACKED else None
    children = [child for _, child in zip(range(2), path.iterdir(), strict=False)] if path.is_dir() else []
    return _packed(children[0]) if len(children) == 1 and children[0].is_file() else None


def photographs_folder(path: Path) -> Path | None:
    """The folder with photographs: the given one, or one such as images/ in it; None if there are none."""
    homes = (path / name for name in _HOMES)
    return next((home for home in homes if home.is_dir() and _count(home)), None)


def find_video(path: Path) -> Path | None:
    """The video at a path: the file itself, or the first one in the folder; None if there is none."""
    files = sorted(path.iterdir()) if path.is_dir() else [path]
    return next((file for file in files if file.suffix.lower() in VIDEO_SUFFIXES and file.is_file()), None)


def _photographs(path: Path) -> tuple[Path, int]:
    """The folder of photographs, and their number."""
    if path.is_file():
        return path.parent, int(path.suffix.lower() in _PHOTOGRAPHS)
    home = photographs_folder(path)
    return (path, 0) if home is None else (home, _count(home))


def _count(home: Path) -> int:
    children = zip(range(_COUNTED), home.iterdir(), strict=False)
    return sum(child.suffix.lower() in _PHOTOGRAPHS for _, child in children)
