"""Record3D's exports: a JSON file with a pose for each of the numbered photographs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from hyperplanes.data.formats.calibration import calibrated
from hyperplanes.data.formats.scenes.transforms_document import opencv_from_opengl
from hyperplanes.data.pictures.frames import Frame, Listing
from hyperplanes.data.pictures.masks import find_masks
from hyperplanes.data.pictures.posed import check_pose
from hyperplanes.utilities.files.reading import DataError, check_link, malformed, read_json

__all__ = ["is_record3d", "read_record3d"]

_PLACES = (("metadata", "rgbd"), ("metadata.json", "rgb"), ("metadata.json", "rgbd"))
_UNIT = 1e-2  # largest difference of the length of a quaternion from 1


def is_record3d(folder: Path) -> bool:
    """Whether a folder holds an export of Record3D: an unzipped .r3d file, or EXR and JPG files."""
    return _places(folder) is not None


def _places(folder: Path) -> tuple[Path, Path] | None:
    """The file of poses and the folder of photographs; None if they do not exist."""
    pairs = ((folder / file, folder / home) for file, home in _PLACES)
    return next(((file, home) for file, home in pairs if file.is_file() and home.is_dir()), None)


def read_record3d(folder: Path, root: Path) -> Listing:
    """The posed images of a video of Record3D.

    Pose i belongs to rgbd/i.jpg (in an unzipped .r3d, beside `metadata`) or rgb/i.jpg (in an export as EXR and JPG,
    beside `metadata.json`). It is a quaternion x, y, z, w and a position, camera-to-world with OpenGL axes. The world
    has the axes of the first camera, so its up direction is unknown. The calibration is K in column-major order, or
    (fx, fy, cx, cy) of each frame in `perFrameIntrinsicCoeffs`. Masks may lie in masks/. (Layout: its author in the
    issues 27, 33 and 83 of marek-simonik/record3d; instant-ngp, scripts/record3d2nerf.py.)

    Returns:
        The images in the order of their numbers.

    Raises:
        DataError: a file is missing or malformed.
    """
    found = _places(folder)
    if found is None:
        raise DataError(folder, "metadata and rgbd/, or metadata.json and rgb/", "neither", "export the video again")
    path, home = found
    document = read_json(path, root)
    with malformed(path, "poses (seven numbers each), K, w and h, as Record3D writes them"):
        poses = np.array(document["poses"], dtype=np.float64)
        size = int(document["h"]), int(document["w"])
        if poses.ndim != 2 or poses.shape[1] != 7 or not len(poses):
            raise DataError(path, "poses, seven numbers each", f"shape {poses.shape}", "export the video again")
        intrinsics = _intrinsics(document, len(poses))
        calibrations = [calibrated(row[:2], row[2:], size, path) for row in intrinsics]
    pictures = [home / f"{index}.jpg" for index in range(len(poses))]
    pictures = [each if each.exists() else each.with_suffix(".png") for each in pictures]
    for picture in pictures:
        check_link(picture, root)
    masks = find_masks([folder / "masks"], pictures, root)
    opengl = [_pose(row, path, index) for index, row in enumerate(poses)]
    frames = [
        Frame(picture, picture.relative_to(folder).as_posix(), pose, calibrate, size, mask=mask)
        for picture, pose, calibrate, mask in zip(
            pictures, opencv_from_opengl(np.stack(opengl)), calibrations, masks, strict=True
        )
    ]
    return Listing(frames, path)


def _intrinsics(document: dict[str, Any], count: int) -> npt.NDArray[np.float64]:
    """fx, fy, cx, cy of each frame."""
    stated = document.get("perFrameIntrinsicCoeffs")
    if isinstance(stated, list) and len(stated) == count:
        return np.array(stated, dtype=np.float64).reshape(count, 4)
    matrix = np.array(document["K"], dtype=np.float64).reshape(3, 3).T
    return np.tile(matrix[[0, 1, 0, 1], [0, 1, 2, 2]], (count, 1))


def _pose(row: npt.NDArray[np.float64], path: Path, index: int) -> npt.NDArray[np.float64]:
    """The (4, 4) pose from a quaternion x, y, z, w and a position."""
    from scipy.spatial.transform import Rotation

    length = float(np.linalg.norm(row[:4]))
    if not abs(length - 1) < _UNIT:
        raise DataError(
            f"{path}, pose {index}", "a unit quaternion and a position", f"length {length:.3g}", "export it again"
        )
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = Rotation.from_quat(row[:4]).as_matrix(), row[4:]
    return check_pose(pose, path, str(index))
