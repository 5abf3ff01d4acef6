"""Reflections about planes: of points, and of cameras whose pictures are flipped; and symmetries of objects."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

import torch
from jaxtyping import Float
from kornia.geometry.camera import PinholeCamera
from torch import Tensor

from hyperplanes.geometry import cameras as camera
from hyperplanes.geometry.distortion import DistortedCamera
from hyperplanes.geometry.rays import Sphere
from hyperplanes.utilities.messages.arguments import checked, checked_fields

__all__ = ["Plane", "Symmetry", "reflected_cameras", "rotation_about"]

MOST_PLANES = 64  # of a symmetry
UNIT = 1e-4  # by which the length of a normal may differ from 1


@checked_fields
@dataclass(frozen=True)
class Plane:
    """The points x of the world with normal · x = offset.

    Attributes:
        normal: of length 1.
        offset: signed distance from the origin along the normal, in world units.

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

    @classmethod
    def of_sphere(cls, bounds: Sphere, normal: tuple[float, float, float], offset: float = 0.0) -> Plane:
        """The plane with this normal, `offset` radii from the centre of a sphere."""
        through = sum(a * b for a, b in zip(normal, bounds.centre, strict=True))
        return cls(normal, through + offset * bounds.radius)

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

    def moved(self, motion: Float[Tensor, "4 4"]) -> Plane:
        """The plane moved together with the world by a rigid motion (a float64 matrix)."""
        normal = motion[:3, :3] @ torch.tensor(self.normal, dtype=torch.float64)
        return Plane(_triple(normal), self.offset + float(normal @ motion[:3, 3]))


@checked_fields
@dataclass(frozen=True)
class Symmetry:
    """The mirror planes of an object: one, or several through a vertical axis.

    Several planes meet at equal angles. The object is then also symmetric under rotation by 360° / order about their
    axis (the group C_nv in Schoenflies notation).

    Attributes:
        plane: one of the planes.
        order: number of planes, at most MOST_PLANES.
        axis: a point on their axis; y is up.

    Raises:
        ValueError: no plane or too many, or several where `plane` is not vertical or does not contain the axis.
    """

    plane: Plane
    order: Annotated[int, range(1, MOST_PLANES + 1)] = 1
    axis: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        apart = sum(a * b for a, b in zip(self.plane.normal, self.axis, strict=True)) - self.plane.offset
        through = abs(self.plane.normal[1]) < UNIT and abs(apart) < UNIT * (1 + math.hypot(*self.axis))
        if self.order > 1 and not through:
            raise ValueError(f"symmetry: expected a vertical plane through the axis, got {self.plane} and {self.axis}")

    @property
    def images(self) -> int:
        """Number of symmetric images of the object, including itself: 2 a plane."""
        return 2 * self.order

    @property
    def rotations(self) -> list[Float[Tensor, "4 4"]]:
        """The rotations that map the object onto itself, in float64; the first is the identity."""
        return [rotation_about(self.axis, 2 * math.pi * index / self.order) for index in range(self.order)]

    def moved(self, motion: Float[Tensor, "4 4"]) -> Symmetry:
        """The symmetry moved with the object by a rigid motion (float64), which keeps an axis of planes vertical."""
        axis = motion[:3, :3] @ torch.tensor(self.axis, dtype=torch.float64) + motion[:3, 3]
        return Symmetry(self.plane.moved(motion), self.order, _triple(axis))


def rotation_about(point: tuple[float, float, float], angle: float) -> Float[Tensor, "4 4"]:
    """The rotation of the world about the vertical axis through a point, in float64.

    Args:
        point: on the axis.
        angle: in radians; a quarter turn maps the z axis onto the x axis.
    """
    x, _, z = point
    cos, sin = math.cos(angle), math.sin(angle)
    rows = [[cos, 0, sin, x - cos * x - sin * z], [0, 1, 0, 0], [-sin, 0, cos, z + sin * x - cos * z], [0, 0, 0, 1]]
    return torch.tensor(rows, dtype=torch.float64)


@checked
def reflected_cameras(cameras: PinholeCamera, plane: Plane) -> PinholeCamera:
    """The cameras of horizontally flipped pictures in a world that is reflected about a plane.

    Where a camera shows a point in column u, the reflected camera shows the point's mirror image in column W - 1 - u:
    the flipped picture is a view of the mirrored object.

    Args:
        cameras: with or without lens distortion.
        plane: of the reflection.
    """
    pose, (height, width) = camera.camera_from_world(cameras), camera.image_size(cameras)
    # a reflection of the world and one of the camera's x axis compose to a rotation
    flip = torch.diag(torch.tensor([-1.0, 1.0, 1.0, 1.0], dtype=torch.float64))
    moved = (flip @ pose.cpu().double() @ plane.reflection).to(pose)
    matrix = camera.intrinsics(cameras).clone()
    matrix[:, 0, 1] = -matrix[:, 0, 1]
    matrix[:, 0, 2] = width - 1 - matrix[:, 0, 2]
    bare = camera.pinhole(matrix, moved, height, width)
    if not isinstance(cameras, DistortedCamera):
        return bare
    lens = cameras.distortion.clone()
    lens[:, 3] = -lens[:, 3]  # p2, of the tangential part along x
    return DistortedCamera(bare, lens)


def _triple(values: Tensor) -> tuple[float, float, float]:
    x, y, z = values.tolist()
    return x, y, z
