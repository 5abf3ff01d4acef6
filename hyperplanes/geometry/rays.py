"""Rays through pixels, with near and far from the bounding sphere of the scene."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import torch
from jaxtyping import Float
from kornia.geometry.camera import PinholeCamera
from torch import Tensor

from hyperplanes.geometry import cameras as camera
from hyperplanes.geometry.distortion import DistortedCamera, undistorted_pixels
from hyperplanes.geometry.inputs import ArrayLike, as_tensor, check_indices
from hyperplanes.utilities.messages.arguments import checked, checked_fields, kind_of
from hyperplanes.utilities.tensors.precision import without_autocast

__all__ = ["SUBPIXELS", "Rays", "Sphere", "cast", "join_rays", "pixel_grid"]

SUBPIXELS = ((0.0, 0.0), (-0.25, -0.25), (0.25, 0.25))
"""Subpixel offsets of the rays of a training pixel; their mean colour approximates the pixel's area average."""


@checked_fields
@dataclass(frozen=True)
class Sphere:
    """The bounding sphere of a scene; nothing outside it is rendered.

    Attributes:
        centre: in world units.
        radius: in world units, above 0.

    Raises:
        ValueError: numbers that are not finite, or a radius that is not above 0.
    """

    centre: tuple[float, float, float] = (0.0, 0.0, 0.0)
    radius: float = 1.0

    def __post_init__(self) -> None:
        if not isinstance(self.centre, tuple) or len(self.centre) != 3:
            raise ValueError(f"centre: expected a tuple of three numbers, got {kind_of(self.centre)}")
        if not all(map(math.isfinite, self.centre)):
            raise ValueError(f"centre: expected finite numbers, got {self.centre}")
        if not 0 < self.radius < math.inf:
            raise ValueError(f"radius: expected a finite number above 0, got {self.radius}")

    def normalise(self, points: Float[Tensor, "*point 3"]) -> Float[Tensor, "*point 3"]:
        """Points in coordinates in which the sphere is the unit sphere."""
        moved = points - points.new_tensor(self.centre) if any(self.centre) else points  # a copy to a GPU synchronises
        return moved / self.radius


@dataclass(frozen=True)
class Rays:
    """Points origin + t direction with near <= t <= far; a ray with near == far has no samples.

    Attributes:
        origins: in the world.
        directions: unit vectors in the world.
        near: least distance t along the ray.
        far: greatest distance t along the ray.
    """

    origins: Float[Tensor, "ray 3"]
    directions: Float[Tensor, "ray 3"]
    near: Float[Tensor, " ray"]
    far: Float[Tensor, " ray"]

    def __len__(self) -> int:
        return len(self.origins)

    def __getitem__(self, index: slice | Tensor) -> Rays:
        return Rays(self.origins[index], self.directions[index], self.near[index], self.far[index])

    def to(self, dtype: torch.dtype) -> Rays:
        """The rays in another precision."""
        return Rays(*(part.to(dtype) for part in (self.origins, self.directions, self.near, self.far)))

    def at(self, t: Float[Tensor, "ray ..."]) -> Float[Tensor, "ray ... 3"]:
        """The points at distances t."""
        shape = (len(self),) + (1,) * (t.ndim - 1) + (3,)
        return self.origins.reshape(shape) + t[..., None] * self.directions.reshape(shape)


def join_rays(first: Rays, *others: Rays) -> Rays:
    """Several sets of rays as one, in their order."""
    return Rays(*(torch.cat([getattr(part, each.name) for part in (first, *others)]) for each in fields(Rays)))


def pixel_grid(height: int, width: int, device: torch.device | str | None = None) -> Float[Tensor, "pixel 2"]:
    """The centres (column, row) of all pixels, row by row.

    >>> pixel_grid(2, 2).tolist()
    [[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [1.0, 1.0]]
    """
    rows, columns = torch.meshgrid(
        torch.arange(height, device=device), torch.arange(width, device=device), indexing="ij"
    )
    return torch.stack([columns, rows], -1).reshape(-1, 2).float()


@checked
@without_autocast
def cast(
    cameras: PinholeCamera,
    view: ArrayLike,
    pixels: ArrayLike,
    bounds: Sphere | None = None,
    *,
    near_far: str = "sphere",
) -> Rays:
    """Rays from camera centres through pixels.

    Args:
        cameras: a batch (view,).
        view: (ray,), index of the camera of each ray.
        pixels: (ray, 2), (column, row) in the image, integer pixel centres; lens distortion is undone.
        bounds: what near and far are taken from; the unit sphere where absent.
        near_far: "sphere" clips each ray to the sphere (a miss gets near == far); "constant" gives every ray of a
            camera the same near and far, the distance of the sphere's centre minus and plus its radius, as NeRF does.

    Returns:
        Rays with unit directions, differentiable in the cameras.

    Raises:
        ValueError: an unknown `near_far`, or views and pixels of other shapes.
    """
    bounds = bounds or Sphere()
    view, pixels = as_tensor("view", view), as_tensor("pixels", pixels)
    if view.ndim != 1 or pixels.shape != (len(view), 2) or view.is_floating_point():
        raise ValueError(
            "view, pixels: expected whole numbers (ray,) and pixels (ray, 2), got "
            f"{view.dtype} {tuple(view.shape)} and {tuple(pixels.shape)}"
        )
    view = view.to(cameras.extrinsics.device, torch.int64)
    if view.device.type == "cpu":
        check_indices(view, cameras.batch_size, "view", "cameras")
    pixels = pixels.to(cameras.extrinsics)
    rotation, matrix = camera.camera_from_world(cameras)[:, :3, :3], camera.intrinsics(cameras)
    if cameras.batch_size != 1:  # those of a single camera broadcast over its rays
        rotation, matrix = (each.contiguous().index_select(0, view) for each in (rotation, matrix))
    shown = None
    if isinstance(cameras, DistortedCamera):
        pixels, shown = undistorted_pixels(cameras, view, pixels)
    y = (pixels[:, 1] - matrix[:, 1, 2]) / matrix[:, 1, 1]
    x = (pixels[:, 0] - matrix[:, 0, 2] - matrix[:, 0, 1] * y) / matrix[:, 0, 0]
    local = torch.stack([x, y, torch.ones_like(x)], -1)
    along = local @ rotation[0] if len(rotation) == 1 else (rotation.mT @ local[..., None]).squeeze(-1)
    directions = torch.nn.functional.normalize(along, dim=-1)
    origins = camera.centres(cameras).index_select(0, view)
    to_centre = origins.new_tensor(bounds.centre) - origins
    if near_far == "constant":
        distance = to_centre.norm(dim=-1)
        near = (distance - bounds.radius).clamp_min(0)
        far = distance + bounds.radius
        return Rays(origins, directions, near, far if shown is None else torch.where(shown, far, near))
    if near_far != "sphere":
        raise ValueError(f"near_far: expected 'sphere' or 'constant', got {near_far!r}")
    middle = (to_centre * directions).sum(-1)
    # squared distance of the ray from the centre, by the vector between them: the difference of the squares of
    # `to_centre` and `middle` would be mere rounding error for a camera far away
    square = bounds.radius**2 - (to_centre - middle[:, None] * directions).square().sum(-1)
    hit = square > 0 if shown is None else (square > 0) & shown
    half = torch.where(hit, torch.where(hit, square, 1.0).sqrt(), 0.0)  # no sqrt at 0: its gradient is infinite
    return Rays(origins, directions, (middle - half).clamp_min(0), (middle + half).clamp_min(0))
