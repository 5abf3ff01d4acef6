"""LLFF's layout: poses_bounds.npy beside images (Mildenhall et al., 2019; NeRF's forward-facing scenes)."""

from __future__ import annotations

import re
from functools import partial
from pathlib import Path

import numpy as np
import numpy.typing as npt

from hyperplanes.data.formats.arrays import read_array
from hyperplanes.data.pictures.frames import Frame, Listing, centred_matrix
from hyperplanes.data.pictures.images import PICTURE_SUFFIXES
from hyperplanes.data.pictures.masks import find_masks
from hyperplanes.data.pictures.posed import check_pose
from hyperplanes.utilities.axes import invert_poses
from hyperplanes.utilities.files.reading import DataError, list_files

__all__ = ["FILE", "is_llff", "read_llff"]

FILE = "poses_bounds.npy"
MAX_POSES_BYTES = 64 * 2**20


def is_llff(folder: Path) -> bool:
    """Whether a folder is in LLFF's layout."""
    return (folder / FILE).is_file()


def read_llff(folder: Path, root: Path) -> Listing:
    """The posed images of a scene in LLFF's layout.

    A row of poses_bounds.npy is a 3 x 5 matrix in row-major order and two depths. The columns of the matrix are the
    axes of the camera in the world (down, right, backwards), its centre, and (height, width, focal length). The depths
    are the nearest and the farthest that the image shows. The principal point is the middle of the image. Rows are in
    the order of the sorted names of the images. These lie in images/, or reduced by a factor N in images_N/; the
    largest are read. Masks may lie in masks/ or mask/.

    Returns:
        The images in the order of their names.

    Raises:
        DataError: an array of another shape or with invalid numbers, or not one image per row.
    """
    source = folder / FILE
    rows = _rows(source, root)
    pictures = _pictures(folder, len(rows), root)
    masks = find_masks([folder / "masks", folder / "mask"], pictures, root)
    frames = []
    for path, row, mask in zip(pictures, rows, masks, strict=True):
        matrix = row[:15].reshape(3, 5)
        height, width, focal = matrix[:, 4]
        if not (np.isfinite(matrix).all() and min(height, width, focal) > 0):
            found = f"{height:g}, {width:g}, {focal:g} for {path.name}"
            raise DataError(source, "a positive height, width and focal length in each row", found, "write it again")
        down, right, backwards, centre = matrix[:, :4].T
        world_from_camera = check_pose(np.stack([right, down, -backwards, centre], 1), source, path.name)
        near, far = row[15:]
        frames.append(
            Frame(
                path,
                path.relative_to(folder).as_posix(),
                invert_poses(world_from_camera),
                partial(centred_matrix, focal / width),
                (round(height), round(width)),
                mask=mask,
                depths=(float(near), float(far)) if 0 < near < far < np.inf else None,
            )
        )
    return Listing(frames, source)


def _rows(source: Path, root: Path) -> npt.NDArray[np.float64]:
    """The (view, 17) array of the file."""
    rows = read_array(source, "an array of numbers", MAX_POSES_BYTES, root)
    if (
        not isinstance(rows, np.ndarray)
        or rows.ndim != 2
        or rows.shape[1] != 17
        or not np.issubdtype(rows.dtype, np.number)
    ):
        found = f"{getattr(rows, 'dtype', '')} {getattr(rows, 'shape', 'an archive')}"
        raise DataError(source, "an array (view, 17)", found, "write it again with LLFF's imgs2poses.py")
    return rows.astype(np.float64)


def _pictures(folder: Path, count: int, root: Path) -> list[Path]:
    """The largest images of which there is one per row, sorted by name."""
    scaled = [path for path in folder.iterdir() if path.is_dir() and re.fullmatch(r"images(_\d+)?", path.name)]
    homes = sorted(scaled, key=lambda path: int(path.name.partition("_")[2] or 1))
    found = {}
    for home in homes:
        files = list_files(home, PICTURE_SUFFIXES, root)
        if len(files) == count:
            return files
        found[home.name] = len(files)
    text = ", ".join(f"{number} in {name}" for name, number in found.items()) or "no folder images"
    raise DataError(folder / FILE, f"{count} images, one per row", text, "copy all images to images/")
