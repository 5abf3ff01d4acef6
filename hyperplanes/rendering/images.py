"""Images of a field: the loop over cameras and pixels."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float
from kornia.geometry.camera import PinholeCamera
from torch import Tensor

from hyperplanes.geometry import cameras as camera
from hyperplanes.geometry.occupancy import Occupancy
from hyperplanes.geometry.rays import Rays, Sphere, cast, pixel_grid
from hyperplanes.rendering.compositing import Rendered
from hyperplanes.rendering.footprint import footprint
from hyperplanes.utilities.memory import require_memory

__all__ = ["Pictures", "render_images"]

BYTES_OF_VIEW, BYTES_KEPT = 200, 32
"""That a pixel takes: of rays, while its view is rendered, and of the pictures of all views."""


@dataclass(frozen=True)
class Pictures:
    """Rendered views.

    Attributes:
        images: RGB over the background, white unless told otherwise.
        opacity: how much of each pixel is covered, in [0, 1].
        depth: expected distance along the ray in world units, not the z coordinate in the camera; 0 where the ray hits
            nothing.
        samples: number of field evaluations, over all pixels.
    """

    images: Float[Tensor, "view 3 height width"]
    opacity: Float[Tensor, "view 1 height width"]
    depth: Float[Tensor, "view 1 height width"]
    samples: int


def render_images(
    cameras: PinholeCamera,
    bounds: Sphere,
    render_rays: Callable[[Rays], Rendered],
    *,
    occupancy: Occupancy | None = None,
    near_far: str = "sphere",
    background: float = 1.0,
) -> Pictures:
    """The images of cameras, by a function that renders rays.

    Rays are cast in the precision of the cameras and rendered in single precision.

    Args:
        cameras: any number, one image size.
        bounds: what near and far of the rays are taken from.
        render_rays: the pixels of rays.
        occupancy: pixels whose rays miss every occupied voxel are background, and no ray is rendered for them.
        near_far: as in `geometry.cast`.
        background: grey value of those pixels.

    Returns:
        One picture a camera.
    """
    height, width = camera.image_size(cameras)
    needed = height * width * (BYTES_OF_VIEW + BYTES_KEPT * cameras.batch_size)
    require_memory("cameras", f"{cameras.batch_size} of {width}x{height}", needed, "render fewer or smaller pictures")
    pixels = pixel_grid(height, width, cameras.intrinsics.device)
    # pixels whose rays may meet something; the others are background
    live = None if occupancy is None else footprint(occupancy, cameras).flatten(1)
    values = pixels.new_zeros(cameras.batch_size, height * width, 5)
    values[..., :3] = background
    samples = 0
    for view in range(cameras.batch_size):
        chosen = torch.arange(len(pixels), device=pixels.device) if live is None else live[view].nonzero()[:, 0]
        if not len(chosen):
            continue
        rays = cast(cameras, torch.full_like(chosen, view), pixels[chosen], bounds, near_far=near_far)
        part = render_rays(Rays(rays.origins.float(), rays.directions.float(), rays.near.float(), rays.far.float()))
        values[view, chosen] = torch.cat([part.colour, part.opacity[:, None], part.depth[:, None]], 1).to(values)
        samples += part.samples
    maps = values.reshape(cameras.batch_size, height, width, 5).permute(0, 3, 1, 2)
    return Pictures(maps[:, :3], maps[:, 3:4], maps[:, 4:], samples)
