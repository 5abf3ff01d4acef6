"""Poses: OpenCV (x right, y down, z forward) and OpenGL camera axes (x right, y up, z backwards), and inverses."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

__all__ = ["flip_camera_axes", "invert_poses"]


def flip_camera_axes(world_from_camera: Any) -> Any:
    """Poses (..., 4, 4) converted from OpenCV's camera axes to OpenGL's, or back.

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
    """The inverses of rigid transforms (..., 4, 4), in closed form: camera_from_world of world_from_camera, or back.

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
