"""The visible surface from the depth of pictures: z coordinates, points and normals."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from kornia.geometry.camera import PinholeCamera
from torch import Tensor
from torch.nn.functional import normalize, pad

from hyperplanes.geometry import cameras as camera
from hyperplanes.geometry.rays import cast, pixel_grid
from hyperplanes.rendering.images import Pictures
from hyperplanes.utilities.messages.arguments import checked

__all__ = ["SeenSurface", "seen_surface"]

MIN_SURFACE_OPACITY = 0.5  # least opacity of a pixel that shows a surface
FIT_RADIUS = 2  # pixels on each side to which the plane through a pixel is fitted
STEEPEST = 6.0  # largest change of z from pixel to pixel on one surface, in widths of a pixel
RIDGE = 1e-3  # regularisation of the normal equations, for pixels without neighbours


@dataclass(frozen=True)
class SeenSurface:
    """The visible surface of pictures; zero in pixels without one.

    Attributes:
        z: coordinate along the optical axis of each camera, in world units, which data sets call depth.
        points: in the world.
        normals: unit vectors in the world, towards the camera.
        covered: 1 where there is a surface.
    """

    z: Float[Tensor, "view height width"]
    points: Float[Tensor, "view height width 3"]
    normals: Float[Tensor, "view height width 3"]
    covered: Float[Tensor, "view height width"]


@checked
@torch.no_grad()
def seen_surface(pictures: Pictures, cameras: PinholeCamera) -> SeenSurface:
    """The visible surface of pictures, from their depth along the rays.

    On a plane, 1 / z is linear in the coordinates (x / z, y / z) of the rays, for any lens. So the normal of a pixel is
    that of the plane fitted by least squares to 1 / z of the 5 x 5 pixels around it, without those on another surface.

    Args:
        pictures: of a field.
        cameras: of the pictures.

    Raises:
        ValueError: cameras of another number or size.
    """
    expected = (cameras.batch_size, *(camera.image_size(cameras) if cameras.batch_size else ()))
    shape = (len(pictures.depth), *pictures.depth.shape[2:])
    if expected != shape:
        raise ValueError(f"cameras: expected {shape[0]} of pictures of {shape[1:]} pixels, got {expected}")
    parts = [_one_view(pictures, cameras, view) for view in range(cameras.batch_size)]
    return SeenSurface(*(torch.stack(values) for values in zip(*parts, strict=True)))


def _one_view(pictures: Pictures, cameras: PinholeCamera, view: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    distance, opacity = pictures.depth[view, 0], pictures.opacity[view, 0]
    height, width = distance.shape
    one = camera.to(camera.select(cameras, [view]), distance.device, distance.dtype)
    pixels = pixel_grid(height, width, distance.device)
    rays = cast(one, torch.zeros(len(pixels), dtype=torch.long, device=distance.device), pixels)
    rotation = camera.camera_from_world(one)[0, :3, :3]
    local = (rays.directions @ rotation.T).reshape(height, width, 3)
    covered = (opacity >= MIN_SURFACE_OPACITY) & (distance > 0) & (local[..., 2] > 0)
    z = torch.where(covered, distance * local[..., 2], 0.0)
    points = rays.at(distance.reshape(-1)).reshape(height, width, 3)
    slopes = local[..., :2] / local[..., 2:].clamp_min(1e-6)
    normals = _plane_normals(z, covered, opacity, slopes, float(camera.intrinsics(one)[0, 0, 0])) @ rotation
    shown = covered[..., None]
    return z, torch.where(shown, points, 0.0), torch.where(shown, normals, 0.0), covered.to(z)


def _plane_normals(z: Tensor, covered: Tensor, opacity: Tensor, slopes: Tensor, focal: float) -> Tensor:
    """Normals in the camera's frame, by weighted least squares over the pixels around each pixel."""
    height, width = z.shape
    weight = covered * opacity
    frame = [FIT_RADIUS] * 4
    around = [pad(part, frame) for part in (z, weight, slopes[..., 0], slopes[..., 1])]
    normal, right = z.new_zeros(height, width, 3, 3), z.new_zeros(height, width, 3)
    for down in range(2 * FIT_RADIUS + 1):
        for across in range(2 * FIT_RADIUS + 1):
            there, share, x, y = (part[down : down + height, across : across + width] for part in around)
            near = (there - z).abs() <= STEEPEST * FIT_RADIUS * z / focal
            # offset from the centre in pixels, and 1 / z relative to that of the centre
            offset = torch.stack([(x - slopes[..., 0]) * focal, (y - slopes[..., 1]) * focal, torch.ones_like(x)], -1)
            offset = offset * (share * near)[..., None].sqrt()
            change = (share * near).sqrt() * (z / there.clamp_min(1e-12) - 1)
            normal += offset[..., :, None] * offset[..., None, :]
            right += offset * change[..., None]
    ridge = RIDGE * torch.eye(3, dtype=z.dtype, device=z.device)
    gradient = torch.linalg.solve(normal + ridge, right)
    last = (1 + gradient[..., 2]) / focal - (gradient[..., :2] * slopes).sum(-1)
    return -normalize(torch.cat([gradient[..., :2], last[..., None]], -1), dim=-1)
