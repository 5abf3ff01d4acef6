"""Reflections about planes: of points, and of cameras whose pictures are flipped."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from kornia.geometry.camera import PinholeCamera
from torch import Tensor

from hyperplanes.geometry import cameras as camera
from hyperplanes.geometry.distortion import DistortedCamera
from hyperplanes.utilities.arguments import checked

__all__ = ["Plane", "reflected_cameras"]

UNIT = 1e-4  # by which the length of a normal may differ from 1


@dataclass(frozen=True)
class Plane:
    """The points x of the world with normal · x = offset.

    Attributes:
        normal: of length 1.
        offset: from the origin along it, in world units.

    Raises:
        ValueError: a normal of another length.
    """

    normal: tuple[float, float, float]
    offset: float = 0.0

    def __post_init__(self) -> None:
        length = math.hypot(*self.normal)
        if not (abs(length - 1) < UNIT and math.isfinite(self.offset)):
            raise ValueError(
                f"plane: expected a normal of length 1 and a finite offset, got {self.normal}, {self.offset}"
            )

    @property
    def reflection(self) -> Float[Tensor, "4 4"]:
        """The map of the world that takes each point to its mirror image, in float64.

        >>> (Plane((1.0, 0.0, 0.0), 2.0).reflection @ torch.tensor([5.0, 1.0, 1.0, 1.0]).double()).tolist()
        [-1.0, 1.0, 1.0, 1.0]
        """
        normal = torch.tensor(self.normal, dtype=torch.float64)
        result = torch.eye(4, dtype=torch.float64)
        result[:3, :3] -= 2 * torch.outer(normal, normal)
        result[:3, 3] = 2 * self.offset * normal
        return result


@checked
def reflected_cameras(cameras: PinholeCamera, plane: Plane) -> PinholeCamera:
    """The cameras to which flipped pictures belong, once the world is reflected about a plane.

    What a camera shows of a point in column u is shown by the reflected one of the point's mirror image in column
    W - 1 - u. So the same picture, flipped, is a view of the mirror image of the object.

    Args:
        cameras: with or without lens distortion.
        plane: of the reflection.
    """
    pose, (height, width) = camera.camera_from_world(cameras), camera.image_size(cameras)
    # a reflection of the world and one of the camera's x axis make a rotation again
    flip = torch.diag(torch.tensor([-1.0, 1.0, 1.0, 1.0], dtype=torch.float64))
    moved = (flip @ pose.detach().double().cpu() @ plane.reflection).to(pose)
    matrix = camera.intrinsics(cameras).clone()
    matrix[:, 0, 1] = -matrix[:, 0, 1]
    matrix[:, 0, 2] = width - 1 - matrix[:, 0, 2]
    bare = camera.pinhole(matrix, moved, height, width)
    if not isinstance(cameras, DistortedCamera):
        return bare
    lens = cameras.distortion.clone()
    lens[:, 3] = -lens[:, 3]  # p2, of the tangential part along x
    return DistortedCamera(bare, lens)
