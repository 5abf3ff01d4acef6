"""OpenCV's camera axes (x right, y down, z forward) and OpenGL's (x right, y up, z backwards): arrays and tensors."""

from __future__ import annotations

from typing import Any

__all__ = ["flip_camera_axes"]


def flip_camera_axes(world_from_camera: Any) -> Any:
    """The same poses (..., 4, 4) in OpenGL's axes where they were in OpenCV's, and the other way round.

    Args:
        world_from_camera: NumPy array or PyTorch tensor; not changed.

    Returns:
        A new array or tensor whose second and third column are negated.

    >>> import numpy as np
    >>> flip_camera_axes(np.eye(4)).diagonal().tolist()
    [1.0, -1.0, -1.0, 1.0]
    """
    result = world_from_camera * 1.0
    result[..., 1:3] *= -1.0
    return result
