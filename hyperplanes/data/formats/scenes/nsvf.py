"""NSVF's layout: intrinsics.txt, bbox.txt, pose/ and rgb/, with the split in the file names (Liu et al., 2020)."""

from __future__ import annotations

import re
from functools import partial
from pathlib import Path

import numpy as np
import numpy.typing as npt

from hyperplanes.data.formats.text_numbers import read_numbers, read_rows
from hyperplanes.data.pictures.frames import Frame, Listing, assemble, scaled_matrix
from hyperplanes.data.pictures.images import PICTURE_SUFFIXES
from hyperplanes.data.pictures.posed import PosedTask, check_pose
from hyperplanes.geometry.rays import Sphere
from hyperplanes.utilities.axes import invert_poses
from hyperplanes.utilities.files.reading import DataError, list_files

__all__ = ["is_nsvf", "read_nsvf", "read_nsvf_task"]

_REMEDY = "download the scene again"


def is_nsvf(folder: Path) -> bool:
    """Whether a folder holds one scene in NSVF's layout: SRN's folders, with file names that begin with the split."""
    if not ((folder / "intrinsics.txt").is_file() and (folder / "rgb").is_dir() and (folder / "pose").is_dir()):
        return False
    names = [path.name for path in (folder / "rgb").iterdir() if path.suffix.lower() in PICTURE_SUFFIXES]
    return bool(names) and all(re.match(r"[012]_", name) for name in names)


def read_nsvf(folder: Path, root: Path) -> Listing:
    """The posed images of a scene in NSVF's layout.

    pose/*.txt are camera-to-world poses with OpenCV axes. intrinsics.txt is a 3 x 3 or 4 x 4 calibration, or begins
    with "f cx cy"; its principal point is at half-pixel centres. bbox.txt, if it exists, holds the corners of a box
    around the scene.

    Returns:
        The images, sorted by name: those of the training, validation and test splits.

    Raises:
        DataError: a file is missing or malformed.
    """
    pictures = list_files(folder / "rgb", PICTURE_SUFFIXES, root)
    if not pictures:
        raise DataError(folder / "rgb", "images", "none", _REMEDY)
    matrix, size = _intrinsics(folder / "intrinsics.txt", root)
    calibrate = (lambda _: matrix) if size is None else partial(scaled_matrix, matrix, size)
    frames = []
    for path in pictures:
        pose_file = folder / "pose" / f"{path.stem}.txt"
        world_from_camera = check_pose(read_numbers(pose_file, [16], root).reshape(4, 4), pose_file, path.stem)
        frames.append(Frame(path, f"rgb/{path.name}", invert_poses(world_from_camera), calibrate, size))
    return Listing(frames, folder, bounds=_box(folder / "bbox.txt", root))


def read_nsvf_task(folder: Path, name: str, downscale: int | None, root: Path) -> PosedTask:
    """Support and query of a scene: the training images 0_*, and the test images 2_* or, without these, 1_*.

    Views alternate between support and query if one of the two would be empty.
    """
    scene = assemble(read_nsvf(folder, root), downscale)[0]
    splits = [[at for at, each in enumerate(scene.names) if Path(each).name[0] == digit] for digit in "012"]
    query = splits[2] or splits[1]
    if not splits[0] or not query:
        return PosedTask.alternating(scene, name)
    return PosedTask.split(scene, splits[0], query, name)


def _intrinsics(path: Path, root: Path) -> tuple[npt.NDArray[np.float64], tuple[int, int] | None]:
    """The calibration, integer pixel centres, and (height, width) if the file states it, otherwise None."""
    lines = read_rows(path, "a calibration in numbers", root)
    size = None
    values = np.array([value for line in lines for value in line])
    if len(lines) in (3, 4) and all(len(line) == len(lines) for line in lines):
        matrix = values.reshape(len(lines), -1)[:3, :3].copy()
    elif len(values) == 16:
        matrix = values.reshape(4, 4)[:3, :3].copy()
    elif lines and len(lines[0]) >= 3:
        focal, x, y = lines[0][:3]
        matrix = np.array([[focal, 0.0, x], [0.0, focal, y], [0.0, 0.0, 1.0]])
        if len(lines[-1]) == 2 and min(lines[-1]) >= 1:
            size = round(lines[-1][0]), round(lines[-1][1])
    else:
        raise DataError(path, "a 4 x 4 matrix, or f cx cy", f"{len(values)} numbers", _REMEDY)
    if not np.isfinite(matrix).all() or min(matrix[0, 0], matrix[1, 1]) <= 0:
        raise DataError(path, "finite numbers and positive focal lengths", f"{matrix.tolist()}", _REMEDY)
    matrix[2] = [0.0, 0.0, 1.0]
    matrix[:2, 2] -= 0.5
    return matrix, size


def _box(path: Path, root: Path) -> Sphere | None:
    """The sphere around the box, None if there is no file."""
    if not path.exists():
        return None
    values = read_numbers(path, [6, 7], root)  # the seventh is the side of a voxel
    low, high = values[:3], values[3:6]
    if not (high > low).all():
        raise DataError(path, "a box: lowest corner, then the highest", f"{values.tolist()}", _REMEDY)
    x, y, z = ((low + high) / 2).tolist()
    return Sphere((x, y, z), float(np.linalg.norm(high - low) / 2))
