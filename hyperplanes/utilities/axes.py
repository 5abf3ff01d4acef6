"""Poses: OpenCV's camera axes (x right, y down, z forward) and OpenGL's (x right, y up, z backwards), inverses."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

__all__ = ["flip_camera_axes", "invert_poses"]


def flip_camera_axes(world_from_camera: Any) -> Any:
    """The same poses (..., 4, 4) in OpenGL's axes where they were in OpenCV's, and the other way round.

    Args:
        world_from_camera: NumPy array or PyTorch tensor; not changed.

    Returns:
        A new array or tensor whose second and third column are negated.

    >>> flip_camera_axes(np.eye(4)).diagonal().tolist()
    [1.0, -1.0, -1.0, 1.0]
    """
    result = world_from_camera * 1.0
    result[..., 1:3] *= -1.0
    return result


def invert_poses(poses: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """camera_from_world (..., 4, 4) of rigid world_from_camera, and the other way round; no system is solved.

    >>> pose = np.eye(4)
    >>> pose[:3, 3] = 1, 2, 3
    >>> invert_poses(pose)[:3, 3].tolist()
    [-1.0, -2.0, -3.0]
    """
    result = np.zeros_like(poses)
    result[..., :3, :3] = rotation = np.swapaxes(poses[..., :3, :3], -1, -2)
    result[..., :3, 3:] = -rotation @ poses[..., :3, 3:]
    result[..., 3, 3] = 1.0
    return result
