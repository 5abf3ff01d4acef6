"""SRN's layout: OBJECT/intrinsics.txt, rgb/*.png, pose/*.txt (Sitzmann et al., 2019; pixelNeRF's cars and chairs)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from hyperplanes.data.formats.catalogue import SPLITS, Catalogue
from hyperplanes.data.formats.text_numbers import read_numbers, read_rows
from hyperplanes.data.pictures.bounds import stated_bounds
from hyperplanes.data.pictures.frames import scaled_matrix
from hyperplanes.data.pictures.images import image_size, read_image, without_haze
from hyperplanes.data.pictures.posed import Posed, PosedTask, check_pose, posed
from hyperplanes.geometry.rays import Sphere
from hyperplanes.utilities.axes import invert_poses
from hyperplanes.utilities.files.reading import MANIFEST, DataError, list_files, malformed

__all__ = ["catalogue", "is_srn", "read_srn"]

_SUFFIXES = {".png", ".jpg", ".jpeg"}


def is_srn(folder: Path) -> bool:
    """Whether a folder holds one object in SRN's layout."""
    return (folder / "intrinsics.txt").is_file() and (folder / "rgb").is_dir() and (folder / "pose").is_dir()


def read_srn(folder: Path, root: Path, bounds: Sphere | None = None) -> Posed:
    """The posed images of one object.

    Poses are camera-to-world with OpenCV axes. If the images have no transparent pixels and every border pixel is
    white, the masks are the pixels that are not exactly white, as in pixelNeRF. The principal point is at half-pixel
    centres. It and the focal length are scaled if the images have another size than the file states.

    Args:
        folder: with intrinsics.txt, rgb and pose.
        root: no file may lie outside it, symbolic links followed.
        bounds: of the scene; if None, they are estimated.

    Returns:
        The images in the order of their names.

    Raises:
        DataError: a file is missing or malformed.
    """
    pictures = list_files(folder / "rgb", _SUFFIXES, root)
    if not pictures:
        raise DataError(folder / "rgb", "images", "none", "download the object again")
    poses = [folder / "pose" / f"{path.stem}.txt" for path in pictures]
    size = image_size(pictures[0])
    pixels = [read_image(path, size) for path in pictures]
    rgba = [picture for picture, _ in pixels]
    alpha = any(has_alpha and (picture[..., 3] < 255).any() for picture, has_alpha in pixels)
    if alpha:
        for picture in rgba:
            picture[..., 3] = without_haze(picture[..., 3])
    # objects rendered over white, without alpha: exactly white pixels are background
    if not alpha and all(_white_border(picture) for picture in rgba):
        alpha = True
        for picture in rgba:
            picture[..., 3] = np.where((picture[..., :3] == 255).all(-1), 0, 255)
    world_from_camera = np.stack(
        [check_pose(read_numbers(path, [16], root).reshape(4, 4), path, path.stem) for path in poses]
    )
    matrix = _intrinsics(folder / "intrinsics.txt", size, root)
    return posed(
        rgba,
        invert_poses(world_from_camera),
        np.tile(matrix, (len(poses), 1, 1)),
        has_alpha=alpha,
        bounds=bounds,
        names=tuple(f"rgb/{path.name}" for path in pictures),
        source=folder,
    )


def catalogue(folder: Path, manifest: dict[str, Any]) -> Catalogue | None:
    """The catalogue of a folder with CLASS_train, CLASS_val and CLASS_test, or of one of these, or of one object.

    Returns:
        The catalogue, whose views alternate between support and query; None if the folder is in another layout.
    """
    if is_srn(folder):
        homes = {"test": [folder]}
    else:
        homes = {split: [] for split in SPLITS}
        for child in sorted(path for path in folder.iterdir() if path.is_dir()):
            split = child.name.rpartition("_")[2]
            if split in homes:
                homes[split] += _objects(child)
        if not any(homes.values()) and (alone := _objects(folder)):
            split = folder.resolve().name.rpartition("_")[2]
            homes[split if split in homes else "test"] = alone
    if not any(homes.values()):
        return None
    paths = {path.name: path for found in homes.values() for path in found}
    splits = {split: tuple(path.name for path in homes.get(split, [])) for split in SPLITS}
    bounds = stated_bounds(manifest, folder / MANIFEST)

    def read(name: str) -> PosedTask:
        return PosedTask.alternating(read_srn(paths[name], folder, bounds), name)

    return Catalogue("srn", splits, read, manifest)


def _objects(folder: Path) -> list[Path]:
    """The folders of the objects in a folder."""
    found = sorted(child for child in folder.iterdir() if child.is_dir() and is_srn(child))
    if not found:  # SRN's published chairs are nested one level deeper
        found = [deeper for child in sorted(folder.glob("*_2.0_*")) for deeper in _objects(child)]
    return found


def _white_border(picture: npt.NDArray[np.uint8]) -> bool:
    """Whether all pixels at the border of an image are white."""
    rows, columns = picture[[0, -1], :, :3], picture[:, [0, -1], :3]
    return bool((rows == 255).all() and (columns == 255).all())


def _intrinsics(path: Path, size: tuple[int, int], root: Path) -> npt.NDArray[np.float64]:
    """The calibration, integer pixel centres, of images of (height, width)."""
    expected = "f cx cy first and height width last"
    lines = read_rows(path, expected, root)
    with malformed(path, expected):
        focal, centre_x, centre_y = lines[0][:3]
        height, width = (lines[4] if len(lines) > 4 else lines[-1])[:2]
    if not np.isfinite([focal, centre_x, centre_y, height, width]).all() or min(focal, height, width) <= 0:
        raise DataError(path, "finite and positive numbers", f"{lines}", "download it again")
    matrix = np.array([[focal, 0.0, centre_x - 0.5], [0.0, focal, centre_y - 0.5], [0.0, 0.0, 1.0]])
    return scaled_matrix(matrix, (height, width), size)
