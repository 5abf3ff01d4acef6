"""Write transforms.json with nerfstudio's fields, and read its numbers; with NumPy alone and without images.

On disk, poses are camera-to-world with OpenGL axes (x right, y up, z backwards), and pixel centres are half-integers,
so that a centred principal point is (W / 2, H / 2). In memory, axes are OpenCV's and pixel centres are integers. This
module converts between the two.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from hyperplanes.utilities.axes import flip_camera_axes, invert_poses
from hyperplanes.utilities.files.reading import DataError

__all__ = ["calibration", "number", "opencv_from_opengl", "stated_size", "transforms_document"]

_NOT_PERSPECTIVE = ("is_fisheye", "ortho")  # fields by which instant-ngp marks cameras that are not perspective
_PERSPECTIVE = {"PINHOLE", "SIMPLE_PINHOLE", "OPENCV", "FULL_OPENCV", "SIMPLE_RADIAL", "RADIAL"}


def transforms_document(
    world_from_camera: npt.NDArray[np.float64],
    intrinsics: npt.NDArray[np.float64],
    size: tuple[int, int],
    file_paths: Sequence[str],
    *,
    near_far: tuple[float, float] | None = None,
    sphere: tuple[tuple[float, float, float], float] | None = None,
    alternating: bool = True,
) -> dict[str, Any]:
    """The content of a transforms.json.

    Args:
        world_from_camera: (view, 4, 4) poses, OpenCV axes.
        intrinsics: (view, 3, 3) in pixels, integer pixel centres; equal ones are written once for all frames.
        size: (height, width).
        file_paths: of the images, relative to the file.
        near_far: distances in world units before and beyond which the scene is empty.
        sphere: centre and radius of the sphere around the scene, in world units.
        alternating: name even views in `train_filenames` (support) and odd ones in `test_filenames` (query).

    Returns:
        A dictionary that can be written as JSON.

    Raises:
        ValueError: a camera with skew, for which the file has no field.

    >>> document = transforms_document(np.eye(4)[None], np.diag([2.0, 2.0, 1.0])[None], (1, 1), ["0.png"])
    >>> document["cx"], document["frames"][0]["transform_matrix"][2]
    (0.5, [0.0, 0.0, -1.0, 0.0])
    """
    if (skew := intrinsics[:, 0, 1]).any():
        raise ValueError(f"intrinsics: expected no skew, got {skew[skew != 0][0]:g}")
    poses = flip_camera_axes(world_from_camera) + 0.0
    shared = bool((intrinsics == intrinsics[:1]).all())
    frames = []
    for index, name in enumerate(file_paths):
        frame: dict[str, Any] = {} if shared else _numbers(intrinsics[index])
        frame["file_path"] = name
        frame["transform_matrix"] = poses[index].tolist()
        frames.append(frame)
    document: dict[str, Any] = {"camera_model": "OPENCV", "w": size[1], "h": size[0], "frames": frames}
    if shared:
        document |= _numbers(intrinsics[0])
        document["camera_angle_x"] = 2 * math.atan(size[1] / 2 / float(intrinsics[0, 0, 0]))
    if near_far is not None:
        document["near"], document["far"] = near_far
    if sphere is not None:
        document["scene_sphere"] = {"centre": list(sphere[0]), "radius": sphere[1]}
    if alternating:
        document["train_filenames"] = list(file_paths[::2])
        document["test_filenames"] = list(file_paths[1::2])
    return document


def opencv_from_opengl(world_from_camera: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """camera_from_world (view, 4, 4) with OpenCV axes, from rigid camera-to-world poses with OpenGL axes.

    >>> opencv_from_opengl(np.eye(4)[None])[0].diagonal().tolist()
    [1.0, -1.0, -1.0, 1.0]
    """
    return invert_poses(flip_camera_axes(world_from_camera))


def calibration(
    fields: dict[str, Any], size: tuple[int, int], source: object, *, legacy: bool = False
) -> npt.NDArray[np.float64]:
    """The (3, 3) calibration, integer pixel centres, that a transforms.json or one frame of it states.

    Args:
        fields: the fields of the document, overridden by those of a frame.
        size: (height, width) of the image. The numbers are scaled to it if `w` and `h` state another size.
        source: the file, for messages.
        legacy: take the stated principal point as one at integer pixel centres, as learnit's and the HyperPlanes
            authors' code does, half a pixel away from that of the rendering.

    Returns:
        The matrix in float64.

    Raises:
        DataError: no focal length, one that is not positive, or a camera that is not perspective.
    """
    height, width = size
    model = fields.get("camera_model", "OPENCV")
    if model not in _PERSPECTIVE:
        raise DataError(str(source), "a perspective camera_model", repr(model), "undistort the images first")
    for name in _NOT_PERSPECTIVE:
        if fields.get(name):
            raise DataError(str(source), "perspective cameras", f"{name} set", "undistort the images first")
    stated = _stated(fields, size, source)
    scale = (width / stated[0], height / stated[1])
    if "fl_x" in fields:
        focal_x = number(fields, "fl_x", 0.0, source) * scale[0]
        focal_y = number(fields, "fl_y", focal_x / scale[0], source) * scale[1]
    elif "camera_angle_x" in fields:
        focal_x = width / 2 / math.tan(_angle(fields, "camera_angle_x", source) / 2)
        focal_y = focal_x
        if "camera_angle_y" in fields:
            focal_y = height / 2 / math.tan(_angle(fields, "camera_angle_y", source) / 2)
    else:
        raise DataError(
            str(source), "fl_x or camera_angle_x", f"only {', '.join(sorted(fields)) or 'nothing'}", "add one of them"
        )
    if focal_x <= 0 or focal_y <= 0:
        raise DataError(str(source), "positive focal lengths", f"{focal_x:g}, {focal_y:g}", "correct the file")
    centre_x = number(fields, "cx", stated[0] / 2, source) * scale[0]
    centre_y = number(fields, "cy", stated[1] / 2, source) * scale[1]
    shift = 0.0 if legacy else 0.5
    return np.array([[focal_x, 0.0, centre_x - shift], [0.0, focal_y, centre_y - shift], [0.0, 0.0, 1.0]])


def stated_size(fields: dict[str, Any], source: object) -> tuple[int, int] | None:
    """The (height, width) of images that a file states, None if it does not state both.

    Args:
        fields: as in `calibration`.
        source: the file, for messages.

    Returns:
        Whole pixels. Raises DataError for a size that is not a positive number.
    """
    if "w" not in fields or "h" not in fields:
        return None
    width, height = _stated(fields, (1, 1), source)
    return max(1, round(height)), max(1, round(width))


def _stated(fields: dict[str, Any], size: tuple[int, int], source: object) -> tuple[float, float]:
    """The stated width and height; those of the image if they are absent."""
    stated = number(fields, "w", size[1], source), number(fields, "h", size[0], source)
    if min(stated) <= 0:
        raise DataError(str(source), "positive w and h", f"{stated[0]:g} x {stated[1]:g}", "correct the file")
    return stated


def _numbers(matrix: npt.NDArray[np.float64]) -> dict[str, float]:
    """The fields of a calibration at half-pixel centres, from one at integer pixel centres."""
    return {
        "fl_x": float(matrix[0, 0]),
        "fl_y": float(matrix[1, 1]),
        "cx": float(matrix[0, 2]) + 0.5,
        "cy": float(matrix[1, 2]) + 0.5,
    }


def number(fields: dict[str, Any], name: str, default: float, source: object) -> float:
    """A number that a transforms.json or one frame of it states.

    Args:
        fields: as in `calibration`.
        name: of the field.
        default: the result if the field is absent.
        source: the file, for messages.

    Raises:
        DataError: not a finite number.
    """
    value = fields.get(name, default)
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
        raise DataError(str(source), f"a finite number as {name}", repr(value), "correct the file")
    return float(value)


def _angle(fields: dict[str, Any], name: str, source: object) -> float:
    """A stated angle in radians between 0 and pi."""
    value = number(fields, name, 0.0, source)
    if not 0 < value < math.pi:
        raise DataError(str(source), f"{name} in radians between 0 and pi", f"{value:g}", "correct the file")
    return value
