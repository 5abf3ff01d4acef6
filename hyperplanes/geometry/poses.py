"""Camera poses: look-at, orbits and Fibonacci spheres, and conversion between OpenGL and OpenCV axes.

OpenCV axes (x right, y down, z forward) unless a name says otherwise.
"""

from __future__ import annotations

import math
from typing import Annotated, TypeAlias

import torch
from jaxtyping import Float
from torch import Tensor

from hyperplanes.utilities.axes import flip_camera_axes
from hyperplanes.utilities.messages.arguments import checked
from hyperplanes.utilities.tensors.precision import without_autocast

__all__ = [
    "farthest_first",
    "fibonacci_sphere",
    "look_at",
    "opencv_from_opengl",
    "opengl_from_opencv",
    "orbit",
    "outermost_first",
]

Count: TypeAlias = Annotated[int, range(1, 2**24)]
"""A number of cameras."""


def opencv_from_opengl(world_from_camera: Float[Tensor, "view 4 4"]) -> Float[Tensor, "view 4 4"]:
    """camera_from_world in OpenCV axes of poses stored as OpenGL camera-to-world (Blender, nerfstudio).

    OpenGL cameras look along -z with y up, so y and z of the camera axes change sign.
    """
    return torch.linalg.inv(flip_camera_axes(world_from_camera))


def opengl_from_opencv(camera_from_world: Float[Tensor, "view 4 4"]) -> Float[Tensor, "view 4 4"]:
    """OpenGL camera-to-world of poses in our convention: the inverse of `opencv_from_opengl`."""
    return flip_camera_axes(torch.linalg.inv(camera_from_world))


@checked
@without_autocast
def look_at(
    eyes: Float[Tensor, "view 3"],
    target: tuple[float, float, float] = (0.0, 0.0, 0.0),
    up: tuple[float, float, float] = (0.0, 1.0, 0.0),
) -> Float[Tensor, "view 4 4"]:
    """camera_from_world of cameras at `eyes` that look at `target`, image top towards `up`.

    Where the viewing direction is parallel to `up`, the world axis after the one nearest to `up` is used instead.

    Raises:
        ValueError: an eye at the target, a number that is not finite, or an `up` of length zero.
    """
    aim, upward = eyes.new_tensor(target), eyes.new_tensor(up)
    if not (torch.isfinite(eyes).all() and torch.isfinite(aim).all()):
        raise ValueError(f"eyes: expected finite positions of eyes and target, got NaN or infinity, target {target}")
    length = upward.norm()
    if not 0 < float(length) < math.inf:
        raise ValueError(f"up: expected a direction, got {up}")
    forward = aim - eyes
    distance = forward.norm(dim=-1, keepdim=True)
    if not torch.isfinite(distance).all():
        raise ValueError(f"eyes: expected distances to the target {target} that are finite when squared, got infinity")
    if (distance <= 1e-7 * (eyes.norm(dim=-1, keepdim=True) + aim.norm())).any():
        raise ValueError(f"eyes: expected every eye away from the target {target}, got one at it")
    forward, upward = forward / distance, upward / length
    # a camera that looks along `up` uses another axis instead
    axis = int(upward.abs().argmax())
    other = torch.zeros_like(upward)
    other[(axis + 1) % 3] = upward[axis].sign()
    vertical = torch.linalg.cross(forward, upward.expand_as(eyes)).norm(dim=-1, keepdim=True) < 1e-6
    # the rows of the rotation: right, down, forward
    right = torch.linalg.cross(forward, torch.where(vertical, other, upward))
    right = right / right.norm(dim=-1, keepdim=True)
    down = torch.linalg.cross(forward, right)
    rotation = torch.stack([right, down, forward], dim=1)
    translation = -(rotation @ eyes[..., None])
    last = eyes.new_tensor([0.0, 0.0, 0.0, 1.0]).expand(len(eyes), 1, 4)
    return torch.cat([torch.cat([rotation, translation], dim=2), last], dim=1)


@checked
def orbit(views: Count, distance: float, elevation: float = math.radians(20.0)) -> Float[Tensor, "view 4 4"]:
    """camera_from_world of `views` cameras evenly around the y axis, looking at the origin.

    Args:
        views: how many.
        distance: from the origin, in world units.
        elevation: above the xz plane, in radians.
    """
    azimuth = torch.arange(views) * (2 * math.pi / views)
    flat = math.cos(elevation)
    up = torch.full_like(azimuth, math.sin(elevation))
    return look_at(distance * torch.stack([flat * azimuth.sin(), up, flat * azimuth.cos()], -1))


@checked
def fibonacci_sphere(views: Count, distance: float, lowest: float = -1.0, highest: float = 1.0) -> Tensor:
    """camera_from_world of cameras spread evenly over a band of the sphere, looking at the origin.

    Args:
        views: how many.
        distance: from the origin, in world units.
        lowest: sine of the lowest elevation.
        highest: sine of the highest elevation.

    Returns:
        (view, 4, 4) poses in the order of a golden-angle spiral from `highest` to `lowest`.

    Raises:
        ValueError: sines out of order or outside [-1, 1].
    """
    if not -1 <= lowest <= highest <= 1:
        raise ValueError(f"lowest, highest: expected -1 <= lowest <= highest <= 1, got {lowest} and {highest}")
    fraction = (torch.arange(views) + 0.5) / views
    height = highest + (lowest - highest) * fraction
    azimuth = torch.arange(views) * (math.pi * (3 - math.sqrt(5)))
    flat = (1 - height**2).clamp_min(0).sqrt()
    return look_at(distance * torch.stack([flat * azimuth.sin(), height, flat * azimuth.cos()], -1))


@without_autocast
def outermost_first(directions: Float[Tensor, "direction 3"], count: int) -> list[int]:
    """As `farthest_first`, starting with the direction farthest from the mean direction.

    Args:
        directions: unit vectors.
        count: how many, at most all.
    """
    return farthest_first(directions, int((directions @ directions.mean(0)).argmin()), count)


@without_autocast
def farthest_first(directions: Float[Tensor, "direction 3"], first: int, count: int) -> list[int]:
    """Farthest-point sampling of directions (Gonzalez 1985).

    >>> farthest_first(torch.tensor([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]]), 0, 2)
    [0, 2]

    Args:
        directions: unit vectors.
        first: index of the direction to start with.
        count: how many, at most all.

    Returns:
        Indices: `first`, then always the direction of the largest angle to the nearest one before; none twice.
    """
    chosen = [first]
    nearest = directions @ directions[first]
    while len(chosen) < count:
        nearest[chosen[-1]] = math.inf  # or it might be chosen again where duplicates are left
        chosen.append(int(nearest.argmin()))
        nearest = torch.maximum(nearest, directions @ directions[chosen[-1]])
    return chosen[:count]
