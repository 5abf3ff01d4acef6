"""IDR's and NeuS's layout: cameras.npz beside image/ and mask/ (Yariv et al., 2020; DTU and BlendedMVS)."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
import numpy.typing as npt

from hyperplanes.data.formats.arrays import read_arrays
from hyperplanes.data.pictures.frames import Frame, Listing, scaled_matrix
from hyperplanes.data.pictures.images import PICTURE_SUFFIXES, image_size
from hyperplanes.data.pictures.masks import find_masks
from hyperplanes.geometry.rays import Sphere
from hyperplanes.utilities.files.reading import DataError, list_files

__all__ = ["camera_file", "read_idr"]

_FILES = ("cameras.npz", "cameras_sphere.npz")  # IDR's name, and NeuS's
_HOMES = ("image", "images", "rgb")


def camera_file(folder: Path) -> Path | None:
    """The file of cameras of a folder in IDR's layout, or None."""
    return next((folder / name for name in _FILES if (folder / name).is_file()), None)


def read_idr(folder: Path, root: Path) -> Listing:
    """The posed images of a scene in IDR's layout, with cameras.npz or cameras_sphere.npz.

    `world_mat_i` projects homogeneous points of the world to pixels (integer pixel centres). `scale_mat_i` maps the
    unit sphere, in which the object lies, to that world. The cameras are returned in the world of the unit sphere.
    Image i is the i-th of image/ by name. mask/ holds masks of the same names, or numbered in the same order, as
    published.

    Returns:
        The images in the order of their names.

    Raises:
        DataError: no such file, matrices that are missing or singular, or not one image per matrix.
    """
    source = camera_file(folder)
    if source is None:
        raise DataError(folder, "cameras.npz", "nothing", "check the path")
    home = next((folder / name for name in _HOMES if (folder / name).is_dir()), folder)
    pictures = list_files(home, PICTURE_SUFFIXES, root)
    wanted = {f"{kind}_{index}" for kind in ("world_mat", "scale_mat") for index in range(len(pictures) + 1)}
    arrays = read_arrays(source, wanted, root)
    count = sum(name.startswith("world_mat") for name in arrays)
    if not pictures or count != len(pictures):
        more = " or more" if count > len(pictures) else ""
        raise DataError(
            source, f"{count}{more} images, one per world_mat", f"{len(pictures)} in {home}", "copy all images"
        )
    masks = find_masks([folder / "mask", folder / "masks"], pictures, root)
    frames = []
    for index, (path, mask) in enumerate(zip(pictures, masks, strict=True)):
        matrix, pose = _decomposed(arrays, index, source)
        size = image_size(path)
        calibrate = partial(scaled_matrix, matrix, size)
        frames.append(Frame(path, path.relative_to(folder).as_posix(), pose, calibrate, size, mask=mask))
    return Listing(frames, source, bounds=Sphere())


def _decomposed(
    arrays: dict[str, npt.NDArray[np.float64]], index: int, source: Path
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """The calibration and camera_from_world, OpenCV axes, of a projection P = K [R | t]."""
    from scipy.linalg import rq

    parts = []
    for name in (f"world_mat_{index}", f"scale_mat_{index}"):
        value = arrays.get(name, np.eye(4) if name.startswith("scale") else None)
        if value is None or value.shape not in ((3, 4), (4, 4)) or not np.issubdtype(value.dtype, np.number):
            found = "nothing" if value is None else f"{value.dtype} {value.shape}"
            raise DataError(source, f"a 4 x 4 matrix {name}", found, "download or write the file again")
        parts.append(np.vstack([value[:3], [[0.0, 0.0, 0.0, 1.0]]]).astype(np.float64))
    projection = (parts[0] @ parts[1])[:3]
    if not np.isfinite(projection).all() or abs(np.linalg.det(projection[:, :3])) < 1e-12:
        raise DataError(source, f"a projection as world_mat_{index}", "a singular matrix", "write the file again")
    if np.linalg.det(projection[:, :3]) < 0:
        projection = -projection
    matrix, rotation = rq(projection[:, :3])
    signs = np.sign(np.diag(matrix))
    matrix, rotation = matrix * signs, signs[:, None] * rotation
    pose = np.eye(4)
    pose[:3, :3] = rotation
    pose[:3, 3] = np.linalg.solve(matrix, projection[:, 3])
    return matrix / matrix[2, 2], pose
