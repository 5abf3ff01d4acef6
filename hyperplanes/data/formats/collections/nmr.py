"""NMR's renderings of ShapeNet, 24 views an object, as DVR published them (Niemeyer et al., 2020; pixelNeRF).

CLASS/softras_train.lst, softras_val.lst and softras_test.lst list the objects. CLASS/OBJECT/ holds image/0000.png,
optionally mask/0000.png, and cameras.npz. In it, world_mat_i is camera_from_world with OpenCV axes, and camera_mat_i
projects to [-1, 1] along each axis of the image.
"""

from __future__ import annotations

import zipfile
from functools import partial
from pathlib import Path

import numpy as np
import numpy.typing as npt

from hyperplanes.data.formats.arrays import read_arrays
from hyperplanes.data.formats.catalogue import SPLITS, Catalogue, is_plain
from hyperplanes.data.formats.text_numbers import LARGEST_TEXT
from hyperplanes.data.pictures.frames import Frame, Listing, assemble, scaled_matrix
from hyperplanes.data.pictures.images import PICTURE_SUFFIXES
from hyperplanes.data.pictures.masks import find_masks
from hyperplanes.data.pictures.posed import PosedTask, check_pose
from hyperplanes.utilities.files.reading import DataError, list_files, read_text

__all__ = ["catalogue", "is_nmr", "read_nmr"]

LISTS = "softras_{split}.lst"
RIGID = 1e-2  # largest difference of R R^T from the identity; IDR's world_mat contains the focal length in pixels


def is_nmr(folder: Path) -> bool:
    """Whether a folder holds one object of NMR's renderings: IDR's files, but with separate poses and calibrations."""
    path = folder / "cameras.npz"
    if not (path.is_file() and (folder / "image").is_dir() and zipfile.is_zipfile(path)):
        return False
    try:
        arrays = read_arrays(path, {"world_mat_0", "camera_mat_0", "scale_mat_0"})
    except DataError:
        return False
    world = arrays.get("world_mat_0")
    if world is None or "camera_mat_0" not in arrays or "scale_mat_0" in arrays or world.shape not in ((3, 4), (4, 4)):
        return False
    return bool(np.abs(world[:3, :3] @ world[:3, :3].T - np.eye(3)).max() < RIGID)


def read_nmr(folder: Path, root: Path) -> Listing:
    """The posed images of one object; the world is ShapeNet's, y up.

    Returns:
        The images in the order of their names, with principal points in their middle.

    Raises:
        DataError: no image, or cameras that are missing or invalid.
    """
    source = folder / "cameras.npz"
    pictures = list_files(folder / "image", PICTURE_SUFFIXES, root)
    if not pictures:
        raise DataError(folder / "image", "images", "none", "download the object again")
    wanted = {f"{kind}_{index}" for kind in ("world_mat", "camera_mat") for index in range(len(pictures))}
    arrays = read_arrays(source, wanted, root)
    masks = find_masks([folder / "mask"], pictures, root)
    frames = []
    for index, (path, mask) in enumerate(zip(pictures, masks, strict=True)):
        pose = check_pose(_matrix(arrays, f"world_mat_{index}", source), source, path.name)
        x, y = np.abs(np.diagonal(_matrix(arrays, f"camera_mat_{index}", source))[:2]).astype(np.float64)
        matrix = np.array([[x, 0.0, 0.5], [0.0, y, 0.5], [0.0, 0.0, 1.0]])  # for an image of 2 x 2 pixels
        frames.append(Frame(path, f"image/{path.name}", pose, partial(scaled_matrix, matrix, (2, 2)), mask=mask))
    return Listing(frames, source)


def catalogue(folder: Path) -> Catalogue | None:
    """The catalogue of a folder of classes, or of one class; None if it has no list of objects.

    Returns:
        The catalogue with the splits of the lists. Views alternate between support and query. Objects without a folder
        are skipped and counted.

    Raises:
        DataError: a list with names that are not plain file names, or no folder of any object.
    """
    homes = [folder] if _lists(folder) else [child for child in sorted(folder.iterdir()) if _lists(child)]
    if not homes:
        return None
    paths: dict[str, Path] = {}
    splits: dict[str, tuple[str, ...]] = dict.fromkeys(SPLITS, ())
    skipped, objects = [], {}
    for home in homes:
        for split, path in _lists(home).items():
            names = [name.strip() for name in read_text(path, LARGEST_TEXT, folder).splitlines() if name.strip()]
            if wrong := [name for name in names if not is_plain(name)]:
                raise DataError(path, "a plain name of a folder in every line", repr(wrong[0])[:60], "correct the list")
            found = {name: home / name for name in names if (home / name).is_dir()}
            if len(found) < len(names):
                skipped.append(f"{path}: skipped {len(names) - len(found)} of {len(names)} objects without a folder")
            paths |= found
            splits[split] += tuple(found)
            objects |= {name: {"class": home.resolve().name} for name in found}
    if not paths:
        raise DataError(folder, "the objects that its lists name", "none of their folders", "download them again")

    def read(name: str) -> PosedTask:
        return PosedTask.alternating(assemble(read_nmr(paths[name], folder))[0], name)

    return Catalogue("nmr", splits, read, {"objects": objects}, tuple(skipped))


def _lists(folder: Path) -> dict[str, Path]:
    """The lists of objects in the folder of a class, by split."""
    paths = {split: folder / LISTS.format(split=split) for split in SPLITS}
    return {split: path for split, path in paths.items() if path.is_file()}


def _matrix(arrays: dict[str, npt.NDArray[np.float64]], name: str, source: Path) -> npt.NDArray[np.float64]:
    """The matrix of that name, checked to be one."""
    value = arrays.get(name)
    if value is None or value.ndim != 2 or min(value.shape) < 2 or not np.issubdtype(value.dtype, np.number):
        found = "nothing" if value is None else f"{value.dtype} {value.shape}"
        raise DataError(source, f"a matrix {name}", found, "download the object again")
    return value
