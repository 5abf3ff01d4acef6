"""Posed cameras of one size that look at a generated object.

Conventions: OpenCV camera axes (x right, y down, z forward), a world with y up, `world_from_camera` poses, intrinsics
in pixels with INTEGER pixel centres, so a centred principal point is `((W - 1) / 2, (H - 1) / 2)`. Objects are
expected inside the sphere of radius 1 around the origin, at which every camera looks.

A rig uses NumPy alone, and `Rig.cameras` makes Kornia cameras of it: worker processes take 0.7 s of processor time to
start, and importing torch and Kornia would add 1.4 s to each.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:
    import torch
    from kornia.geometry.camera import PinholeCamera

__all__ = ["DEFAULT_DISTANCE", "OBJECT_RADIUS", "Array", "Rig", "fitting_field_of_view", "look_at_origin", "aimed"]

Array = npt.NDArray[np.float64]

OBJECT_RADIUS = 1.0
"""Radius of the sphere around the origin that holds every normalised object, in world units."""

DEFAULT_DISTANCE = 3.0
"""Distance of the cameras from the origin, in world units."""

_MARGIN = 1.04


@dataclass(frozen=True)
class Rig:
    """Posed cameras of one size.

    Attributes:
        world_from_camera: camera poses `(view, 4, 4)`, OpenCV axes, in world units.
        intrinsics: pinhole matrices `(view, 3, 3)` without skew, in pixels, integer pixel centres. One `(3, 3)` is
            accepted and repeated for every view.
        width: image width in pixels.
        height: image height in pixels.
        near: distance along a ray before which there is no object, in world units.
        far: distance along a ray beyond which there is no object, in world units.

    Raises:
        ValueError: if a shape is wrong, a number is not finite, a camera has skew, a pose is not a rigid motion, or
            near and far are out of order.
    """

    world_from_camera: Array
    intrinsics: Array
    width: int
    height: int
    near: float
    far: float

    def __post_init__(self) -> None:
        poses = np.ascontiguousarray(self.world_from_camera, dtype=np.float64)
        if poses.ndim != 3 or poses.shape[1:] != (4, 4) or len(poses) == 0:
            raise ValueError(f"world_from_camera: expected shape (view, 4, 4) with view >= 1, got {poses.shape}")
        intrinsics = np.asarray(self.intrinsics, dtype=np.float64)
        if intrinsics.shape not in {(3, 3), (len(poses), 3, 3)}:
            raise ValueError(f"intrinsics: expected shape (3, 3) or ({len(poses)}, 3, 3), got {intrinsics.shape}")
        intrinsics = np.array(np.broadcast_to(intrinsics, (len(poses), 3, 3)))
        if not (np.isfinite(poses).all() and np.isfinite(intrinsics).all()):
            raise ValueError("world_from_camera, intrinsics: expected finite numbers, got NaN or infinity")
        if (skew := intrinsics[:, 0, 1]).any():  # neither OpenGL's projection nor a transforms.json has any
            raise ValueError(f"intrinsics: expected no skew, got {skew[skew != 0][0]:g}")
        rotations = poses[:, :3, :3]
        error = np.abs(rotations @ rotations.transpose(0, 2, 1) - np.eye(3)).max()
        if error > 1e-6 or np.linalg.det(rotations).min() < 0:
            raise ValueError(
                "world_from_camera: expected rotations without scale or mirroring, got "
                f"|R R^T - 1| up to {error:.2g} and determinants from {np.linalg.det(rotations).min():.3g}"
            )
        if self.width < 1 or self.height < 1:
            raise ValueError(f"width, height: expected at least 1 pixel, got {self.width} x {self.height}")
        if not 0 < self.near < self.far:
            raise ValueError(f"near, far: expected 0 < near < far, got {self.near} and {self.far}")
        poses.flags.writeable = False
        intrinsics.flags.writeable = False
        object.__setattr__(self, "world_from_camera", poses)
        object.__setattr__(self, "intrinsics", intrinsics)

    def __len__(self) -> int:
        """Return the number of views."""
        return len(self.world_from_camera)

    def cameras(self, dtype: torch.dtype | None = None) -> PinholeCamera:
        """The cameras for `hyperplanes.geometry`.

        Args:
            dtype: of the cameras; float64 by default.

        Returns:
            A batch of Kornia cameras.
        """
        from torch import as_tensor

        from hyperplanes.geometry.cameras import pinhole

        extrinsics = as_tensor(np.linalg.inv(self.world_from_camera), dtype=dtype)
        return pinhole(as_tensor(self.intrinsics.copy(), dtype=dtype), extrinsics, self.height, self.width)


def fitting_field_of_view(distance: float) -> float:
    """Field of view at which the unit sphere just fits, with a margin of 4 %.

    Args:
        distance: distance of the camera from the centre of the sphere, more than 1.04.

    Returns:
        The full angle in degrees, `2 asin(1.04 / distance)`.

    Raises:
        ValueError: if the camera is too near for any angle, or infinitely far.

    >>> round(fitting_field_of_view(3.0), 3)
    40.567
    """
    if not _MARGIN * OBJECT_RADIUS < distance < math.inf:
        wanted = f"a finite number of more than {_MARGIN} (the object's radius is 1)"
        raise ValueError(f"distance: expected {wanted}, got {distance}")
    return math.degrees(2.0 * math.asin(_MARGIN * OBJECT_RADIUS / distance))


def look_at_origin(centres: npt.ArrayLike) -> Array:
    """Poses of cameras that look at the origin with the world's y axis up in the picture.

    As `hyperplanes.geometry.poses.look_at`, in NumPy and with exact centres; a test compares the two.

    Args:
        centres: camera positions `(view, 3)`, none of them the origin.

    Returns:
        `world_from_camera` `(view, 4, 4)`, OpenCV axes. Vertically above or below the origin, the world's z
        axis is up in the picture.

    >>> look_at_origin([[0.0, 0.0, 3.0]])[0].round().astype(int).tolist()
    [[1, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 3], [0, 0, 0, 1]]
    """
    positions = np.asarray(centres, dtype=np.float64)
    forward = -positions / np.linalg.norm(positions, axis=-1, keepdims=True)
    up = np.where(np.linalg.norm(forward[:, ::2], axis=-1, keepdims=True) >= 1e-6, [[0.0, 1.0, 0.0]], [[0.0, 0.0, 1.0]])
    right = np.cross(forward, up)
    right /= np.linalg.norm(right, axis=-1, keepdims=True)
    poses = np.zeros((len(positions), 4, 4))
    poses[:, :3, 0] = right
    poses[:, :3, 1] = np.cross(forward, right)
    poses[:, :3, 2] = forward
    poses[:, :3, 3] = positions
    poses[:, 3, 3] = 1.0
    return poses + 0.0  # no negative zeros on disk


def aimed(directions: Array, resolution: int, distance: float, field_of_view: float | None) -> Rig:
    """Cameras that look at the origin from given directions (view, 3); other arguments as in `make_rig`."""
    if resolution < 1:
        raise ValueError(f"resolution: expected at least 1 pixel, got {resolution}")
    fitting = fitting_field_of_view(distance)
    angle = fitting if field_of_view is None else field_of_view
    if not 0.0 < angle < 180.0:
        raise ValueError(f"field_of_view: expected more than 0 and less than 180 degrees, got {field_of_view}")
    focal, middle = resolution / 2.0 / math.tan(math.radians(angle) / 2.0), (resolution - 1) / 2.0
    intrinsics = np.array([[focal, 0.0, middle], [0.0, focal, middle], [0.0, 0.0, 1.0]])
    near, far = distance - OBJECT_RADIUS, distance + OBJECT_RADIUS
    return Rig(look_at_origin(directions * distance), intrinsics, resolution, resolution, near, far)
