"""Read posed images from COLMAP's sparse models, text or binary."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import numpy.typing as npt

from hyperplanes.data.pictures.frames import Frame, Listing, scaled_matrix
from hyperplanes.data.pictures.images import image_size
from hyperplanes.data.pictures.masks import find_masks
from hyperplanes.data.pictures.posed import check_pose
from hyperplanes.data.pictures.undistort import COEFFICIENTS
from hyperplanes.utilities.files.reading import DataError, check_link, inside, malformed, read_bytes, read_text

__all__ = ["find_model", "image_names", "read_colmap"]

# COLMAP's number, name and parameters of the supported camera models
_MODELS = {
    0: ("SIMPLE_PINHOLE", ("f", "cx", "cy")),
    1: ("PINHOLE", ("fx", "fy", "cx", "cy")),
    2: ("SIMPLE_RADIAL", ("f", "cx", "cy", "k1")),
    3: ("RADIAL", ("f", "cx", "cy", "k1", "k2")),
    4: ("OPENCV", ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")),
    6: ("FULL_OPENCV", ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")),
}
_OTHER_MODELS = {  # names for messages
    **{5: "OPENCV_FISHEYE", 7: "FOV", 8: "SIMPLE_RADIAL_FISHEYE", 9: "RADIAL_FISHEYE", 10: "THIN_PRISM_FISHEYE"},
    11: "RAD_TAN_THIN_PRISM_FISHEYE",
}
_PARAMETERS = dict(_MODELS.values())
_PLACES = ("sparse", "dense/sparse", "dense", "distorted/sparse", "colmap/sparse", "colmap")


@dataclass(frozen=True)
class _Camera:
    size: tuple[int, int]
    matrix: npt.NDArray[np.float64]
    coefficients: tuple[float, ...]


@dataclass(frozen=True)
class _Image:
    number: int
    name: str
    camera: int
    camera_from_world: npt.NDArray[np.float64]


def find_model(folder: str | Path) -> Path | None:
    """The folder with the files cameras and images of a sparse model; None if there is none.

    It is searched where COLMAP and tools that call it write it: in the folder itself, sparse, dense/sparse, dense,
    distorted/sparse, colmap/sparse and colmap, or in their numbered subfolders such as sparse/0. If a reconstruction
    has several models, the one with the largest file of images is taken.

    >>> find_model("no such folder") is None
    True
    """
    folder = Path(folder)
    if _is_model(folder):
        return folder
    for place in _PLACES:
        parts = [path for path in sorted((folder / place).glob("[0-9]*")) if _is_model(path)]
        if parts:
            return max(parts, key=_count)
        if _is_model(folder / place):
            return folder / place
    return None


def read_colmap(folder: Path, root: Path) -> Listing:
    """The posed images of a COLMAP reconstruction.

    The world is COLMAP's, which has OpenCV axes. COLMAP's principal points are at half-pixel centres. The images lie in
    images/ or input/ beside the model or above it; a folder whose images have the size of the cameras is preferred,
    then the nearest one. Cameras with distortion (SIMPLE_RADIAL, RADIAL, OPENCV, FULL_OPENCV) keep their calibration,
    and their images are undistorted. Masks may lie in masks/ beside the folder of images.

    Args:
        folder: the project, or the model itself.
        root: the model may not lie outside it, symbolic links followed. An image may lie neither outside it nor outside
            the folder of images.

    Returns:
        The images, sorted by name.

    Raises:
        DataError: no model, an unsupported camera model such as a fisheye, a truncated file, or missing images.
    """
    model = find_model(folder)
    if model is None:
        raise DataError(folder, "cameras and images, .bin or .txt", "neither", "check the path")
    paths, cameras, images = _read(model, root)
    if not images:
        raise DataError(paths[1], "registered images", "none", "reconstruct again")
    images = sorted(images, key=lambda image: image.name)
    absent = [image.name for image in images if image.camera not in cameras]
    if absent:
        raise DataError(paths[0], f"the camera of {absent[0]}", "none", "export the model again with COLMAP")
    home = _pictures_folder(folder, model, images, cameras, paths[1], root)
    frames = []
    for image in images:
        seen = cameras[image.camera]
        frames.append(
            Frame(
                _picture(home, image.name, paths[1], root),
                image.name,
                check_pose(image.camera_from_world, paths[1], image.name),
                partial(scaled_matrix, seen.matrix, seen.size),
                seen.size,
                seen.coefficients,
            )
        )
    masks = find_masks([home.parent / "masks"], [frame.path for frame in frames], root)
    frames = [replace(frame, mask=mask) for frame, mask in zip(frames, masks, strict=True)]
    return Listing(frames, paths[1])


def image_names(model: Path, root: Path) -> dict[int, str]:
    """The names of a model's registered images by their numbers; raises DataError if a file is malformed.

    Args:
        model: the folder that `find_model` returned.
        root: no file may lie outside it, symbolic links followed.
    """
    return {image.number: image.name for image in _read(model, root)[2]}


def _read(model: Path, root: Path) -> tuple[tuple[Path, Path], dict[int, _Camera], list[_Image]]:
    """The files of cameras and images of a model, and their content."""
    binary = (model / "images.bin").is_file() and (model / "cameras.bin").is_file()
    suffix = ".bin" if binary else ".txt"
    paths = model / f"cameras{suffix}", model / f"images{suffix}"
    for path in paths:
        check_link(path, root)
    with malformed(model, "a whole COLMAP model"):
        if binary:
            return paths, _cameras_binary(paths[0]), _images_binary(paths[1])
        return paths, _cameras_text(paths[0]), _images_text(paths[1])


def _picture(home: Path, name: str, source: Path, root: Path) -> Path:
    """The path of an image, which lies in its folder or, through a symbolic link, elsewhere in the root."""
    if ".." not in Path(name).parts and home.resolve().is_relative_to(root.resolve()):
        return inside(root.resolve(), str(home.resolve().relative_to(root.resolve()) / name), source)
    return inside(home, name, source)


def _is_model(folder: Path) -> bool:
    return any(
        all((folder / f"{name}{suffix}").is_file() for name in ("cameras", "images")) for suffix in (".bin", ".txt")
    )


def _count(model: Path) -> int:
    """The size of a model: the bytes of its file of images."""
    return max((model / name).stat().st_size for name in ("images.bin", "images.txt") if (model / name).is_file())


def _pictures_folder(
    folder: Path, model: Path, images: list[_Image], cameras: dict[int, _Camera], source: Path, root: Path
) -> Path:
    """The folder with most of the images: images or input, beside the model or up to four folders above it.

    If several have as many, the one with most images of their camera's size is taken, then the nearest: a model of
    undistorted images lies beside these and below the original ones.
    """
    roots = [model, *list(model.absolute().parents)[:4]]
    homes = [root / name for root in roots for name in ("images", "input")] + [folder, model]
    chosen = images[:: max(1, len(images) // 20)]

    def fit(home: Path) -> tuple[int, int]:
        paths = {_picture(home, image.name, source, root): cameras[image.camera].size for image in chosen}
        there = [path for path in paths if path.is_file()]
        return len(there), sum(image_size(path) == paths[path] for path in there)

    return max((home for home in homes if home.is_dir()), key=fit)


def _camera(model: str, width: int, height: int, values: list[float], path: Path) -> _Camera:
    """A camera from the name of its model and its parameters, with the principal point at integer pixel centres."""
    if model not in _PARAMETERS:
        known = ", ".join(_PARAMETERS)
        raise DataError(path, f"one of the camera models {known}", model, "run COLMAP's image_undistorter")
    named = dict(zip(_PARAMETERS[model], values, strict=True))
    focal = named.get("fx", named.get("f", 0.0)), named.get("fy", named.get("f", 0.0))
    matrix = np.array([[focal[0], 0.0, named["cx"] - 0.5], [0.0, focal[1], named["cy"] - 0.5], [0.0, 0.0, 1.0]])
    return _Camera((height, width), matrix, tuple(named.get(name, 0.0) for name in COEFFICIENTS))


def _pose(quaternion: npt.NDArray[np.float64], translation: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """camera_from_world of a quaternion w, x, y, z and a translation."""
    from scipy.spatial.transform import Rotation

    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = Rotation.from_quat(quaternion[[1, 2, 3, 0]]).as_matrix(), translation
    return pose


def _lines(path: Path) -> Iterator[list[str]]:
    """The words of each line that is not a comment; an empty line has none."""
    for line in read_text(path).splitlines():
        if not line.startswith("#"):
            yield line.split()


def _cameras_text(path: Path) -> dict[int, _Camera]:
    return {
        int(words[0]): _camera(words[1], int(words[2]), int(words[3]), [float(word) for word in words[4:]], path)
        for words in _lines(path)
        if words
    }


def _images_text(path: Path) -> list[_Image]:
    images = []
    lines = _lines(path)
    for words in lines:
        if not words:
            continue
        numbers = np.array(words[1:8], dtype=np.float64)
        images.append(_Image(int(words[0]), " ".join(words[9:]), int(words[8]), _pose(numbers[:4], numbers[4:])))
        next(lines, None)  # the points of this image, possibly none
    return images


def _cameras_binary(path: Path) -> dict[int, _Camera]:
    data, at = read_bytes(path), 8
    cameras = {}
    for _ in range(struct.unpack_from("<Q", data)[0]):
        number, model, width, height = struct.unpack_from("<iiQQ", data, at)
        name, parameters = _MODELS.get(model, (_OTHER_MODELS.get(model, f"number {model}"), ()))
        values = struct.unpack_from(f"<{len(parameters)}d", data, at + 24)
        cameras[number] = _camera(name, width, height, list(values), path)
        at += 24 + 8 * len(parameters)
    return cameras


def _images_binary(path: Path) -> list[_Image]:
    data, at = read_bytes(path), 8
    images = []
    for _ in range(struct.unpack_from("<Q", data)[0]):
        values = struct.unpack_from("<i7di", data, at)
        end = data.index(b"\0", at + 64)
        pose = _pose(np.array(values[1:5]), np.array(values[5:8]))
        images.append(_Image(values[0], data[at + 64 : end].decode(), values[8], pose))
        at = end + 9 + 24 * struct.unpack_from("<Q", data, end + 1)[0]
    if at > len(data):
        raise ValueError(f"{path.name} ends early")
    return images
