"""Polycam's raw data: a JSON file with the camera of each photograph, in the world of ARKit."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from hyperplanes.data.formats.calibration import calibrated
from hyperplanes.data.formats.scenes.transforms_document import opencv_from_opengl
from hyperplanes.data.pictures.frames import Frame, Listing
from hyperplanes.data.pictures.masks import find_masks
from hyperplanes.data.pictures.posed import check_pose
from hyperplanes.utilities.files.reading import DataError, check_link, list_files, malformed, read_json

__all__ = ["is_polycam", "read_polycam"]

_STATED = "a camera of Polycam: t_00 to t_23, fx, fy, cx, cy, width, height"


def is_polycam(folder: Path) -> bool:
    """Whether a folder holds the raw data of a Polycam capture, or is its folder keyframes."""
    return _places(folder) is not None


def _places(folder: Path) -> tuple[Path, Path] | None:
    """The folders of cameras and of photographs, preferably the corrected ones; None if there are none."""
    for base in (folder / "keyframes", folder):
        for kind in ("corrected_", ""):
            cameras, pictures = base / f"{kind}cameras", base / f"{kind}images"
            if cameras.is_dir() and pictures.is_dir() and any(cameras.glob("*.json")):
                return cameras, pictures
    return None


def read_polycam(folder: Path, root: Path) -> Listing:
    """The posed images of an unzipped Polycam capture.

    The files are keyframes/corrected_cameras/N.json and corrected_images/N.jpg, which exist once the app has processed
    the capture, otherwise those in cameras and images. t_ij is row i, column j of the pose, which is camera-to-world
    with OpenGL axes. The world is ARKit's, y up. Principal points are at half-pixel centres, as in ARKit. Masks may lie
    in masks/ beside the folder of photographs, or beside keyframes/. (Layout: nerfstudio,
    process_data/polycam_utils.py.)

    Returns:
        The images in the order of their names.

    Raises:
        DataError: a file is missing or malformed.
    """
    found = _places(folder)
    if found is None:
        raise DataError(folder, "keyframes/cameras and keyframes/images", "neither", "export the raw data again")
    cameras, pictures = found
    frames = []
    for path in list_files(cameras, {".json"}, root):
        stated = read_json(path, root)
        with malformed(path, _STATED):
            pose = np.array([[float(stated[f"t_{row}{column}"]) for column in range(4)] for row in range(3)])
            focal, centre = (stated["fx"], stated["fy"]), (stated["cx"], stated["cy"])
            size = int(stated["height"]), int(stated["width"])
            calibrate = calibrated(focal, centre, size, path)
        camera_from_world = opencv_from_opengl(check_pose(pose, path, path.stem)[None])[0]
        named = [pictures / f"{path.stem}{ending}" for ending in (".jpg", ".jpeg", ".png")]
        picture = next((each for each in named if each.is_file()), named[0])
        check_link(picture, root)
        frames.append(Frame(picture, picture.relative_to(folder).as_posix(), camera_from_world, calibrate, size))
    homes = [cameras.parent / "masks", folder / "masks"]
    masks = find_masks(homes, [frame.path for frame in frames], root)
    frames = [replace(frame, mask=mask) for frame, mask in zip(frames, masks, strict=True)]
    return Listing(frames, cameras, up="y")
