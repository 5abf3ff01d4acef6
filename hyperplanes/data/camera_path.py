"""Camera paths that nerfstudio's viewer and its Blender add-on write: the cameras of the frames of a video.

A file has `render_width`, `render_height`, `seconds` and a list `camera_path` of frames. A frame has `camera_to_world`,
16 numbers in row-major order with OpenGL axes, and `fov`, the vertical field of view in degrees. nerfstudio's viewer
writes a path in the world of the trained model, which is rotated, translated and scaled relative to the data;
dataparser_transforms.json beside the model's config.yml holds this transform.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from kornia.geometry.camera import PinholeCamera

from hyperplanes.data.formats.scenes.transforms_document import opencv_from_opengl
from hyperplanes.data.pictures.posed import check_pose
from hyperplanes.geometry import cameras as camera
from hyperplanes.utilities.files.reading import DataError, read_json
from hyperplanes.utilities.messages.arguments import checked

__all__ = ["CameraPath", "read_camera_path"]

MOST_FRAMES, MOST_PIXELS = 100_000, 1 << 26
EXPORT = "export the path again"


@dataclass(frozen=True)
class CameraPath:
    """The cameras of a video.

    Attributes:
        cameras: one a frame, in the world of the posed images.
        seconds: duration of the video.
        notes: what the file asks for that is not supported.
    """

    cameras: PinholeCamera
    seconds: float
    notes: tuple[str, ...] = ()


@checked
def read_camera_path(
    path: str | Path,
    transforms: str | Path | None = None,
    scene: Mapping[str, Any] | None = None,
    origin: Sequence[float] = (0.0, 0.0, 0.0),
) -> CameraPath:
    """The cameras of a path that nerfstudio wrote.

    Args:
        path: the JSON file.
        transforms: nerfstudio's dataparser_transforms.json, which maps the world of the data to that of the path. If
            None, the path is in the world of the data.
        scene: the content of the transforms.json of the data. Its `applied_transform` and `applied_scale` map the world
            that `transforms` starts from to the world of the data.
        origin: origin of the returned cameras' world, in the world of the data (`Posed.origin`).

    Returns:
        Perspective cameras with the principal point in the middle. The duration is that of 24 frames per second if the
        file does not state it.

    Raises:
        DataError: a malformed file, cameras that are not perspective, or too many frames or pixels.
    """
    path = Path(path)
    document = read_json(path)
    frames = document.get("camera_path")
    if not isinstance(frames, list) or not frames or not all(isinstance(frame, dict) for frame in frames):
        raise DataError(path, "camera_path, a list of one or more frames", repr(frames)[:40], EXPORT)
    if len(frames) > MOST_FRAMES:
        raise DataError(path, f"at most {MOST_FRAMES} frames", str(len(frames)), "take a shorter path")
    kind = document.get("camera_type", "perspective")
    if not isinstance(kind, str) or kind.lower() != "perspective":
        raise DataError(path, "camera_type perspective", repr(kind)[:40], "choose it in the viewer")
    size = _number(document, "render_height", path, "a size"), _number(document, "render_width", path, "a size")
    height, width = (max(1, round(value)) for value in size)
    if height * width > MOST_PIXELS:
        raise DataError(path, f"at most {MOST_PIXELS} pixels a frame", f"{width}x{height}", "choose a lower resolution")
    poses, focal = np.zeros((len(frames), 4, 4)), np.zeros(len(frames))
    for index, frame in enumerate(frames):
        poses[index] = _pose(frame.get("camera_to_world"), path, index)
        # the focal length in pixels, from the vertical field of view
        angle = _number(frame, "fov", path, f"frame {index}: degrees")
        if angle >= 180:
            raise DataError(path, f"frame {index}: a fov below 180 degrees", f"{angle:g}", EXPORT)
        focal[index] = height / 2 / math.tan(math.radians(angle) / 2)
    if transforms is not None:
        poses = _to_data(poses, Path(transforms), scene or {})
    poses[:, :3, 3] -= np.asarray(origin)
    matrices = np.tile(np.eye(3), (len(frames), 1, 1))
    matrices[:, 0, 0] = matrices[:, 1, 1] = focal
    matrices[:, :2, 2] = (width - 1) / 2, (height - 1) / 2
    world = torch.from_numpy(opencv_from_opengl(poses)).float()
    cameras = camera.pinhole(torch.from_numpy(matrices).float(), world, height, width)
    left_out = {"crop": "its crop is", "render_time": "its times are"}
    notes = tuple(
        f"{what} left out"
        for name, what in left_out.items()
        if document.get(name) is not None or frames[0].get(name) is not None
    )
    seconds = len(frames) / 24.0 if "seconds" not in document else _number(document, "seconds", path, "a time")
    return CameraPath(cameras, seconds, notes)


def _number(fields: Mapping[str, Any], name: str, path: Path, what: str) -> float:
    value = fields.get(name)
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0 < value < math.inf:
        raise DataError(path, f"{what} above 0 as {name}", repr(value)[:40], EXPORT)
    return float(value)


def _pose(values: Any, path: Path, index: int) -> npt.NDArray[np.float64]:
    """A camera-to-world pose, from 16 numbers in row-major order or from a list of rows."""
    if isinstance(values, list) and len(values) == 16 and not any(isinstance(value, list) for value in values):
        values = [values[row : row + 4] for row in range(0, 16, 4)]
    return check_pose(values, path, f"{index} of camera_path")


def _to_data(poses: npt.NDArray[np.float64], path: Path, scene: Mapping[str, Any]) -> npt.NDArray[np.float64]:
    """Poses in the world of the data, from poses in nerfstudio's world.

    nerfstudio maps a position p to scale * (R p + t), where p is in the world before `applied_transform`.
    """
    document = read_json(path)
    original = check_pose(document.get("transform"), path, "transform")
    scale = _number(document, "scale", path, "a factor")
    applied = scene.get("applied_transform")
    if applied is not None:
        original = original @ np.linalg.inv(check_pose(applied, "transforms.json", "applied_transform"))
    scale /= _number({"applied_scale": 1.0, **scene}, "applied_scale", path, "a factor")
    moved = poses.copy()
    moved[:, :3, 3] /= scale
    return np.linalg.inv(original) @ moved
