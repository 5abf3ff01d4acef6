"""Where the rays of pixels first meet an occupied voxel: the depth of the visual hull in every view."""

from __future__ import annotations

from importlib.util import find_spec

import numpy as np
import torch
from jaxtyping import Float
from kornia.geometry.camera import PinholeCamera
from torch import Tensor

from hyperplanes.geometry import cameras as camera
from hyperplanes.geometry.inputs import ArrayLike
from hyperplanes.geometry.kernels.compiling import compile_kernel
from hyperplanes.geometry.kernels.threads import parallel_for
from hyperplanes.geometry.occupancy import Occupancy
from hyperplanes.geometry.rays import Rays, cast
from hyperplanes.utilities.transforms import are_plain

__all__ = ["first_hits"]

STEPS = 128  # along a diameter of the scene, where rays look for their first occupied voxel
ROUND = 8  # of them at once, without a compiler
RAYS = 2048  # that one call of the kernel works on
RAYS_AT_ONCE = 1 << 17  # that are cast together: those of many photographs would take gigabytes


@torch.no_grad()
def first_hits(
    occupancy: Occupancy, cameras: PinholeCamera, masks: ArrayLike | None = None
) -> Float[Tensor, "view height width"]:
    """The distance from each camera to the first occupied voxel along the ray of each pixel.

    Args:
        occupancy: the grid.
        cameras: of one image size.
        masks: (view, 1, height, width); where they are 0 nothing is looked for.

    Returns:
        Distances along unit rays, to half a STEPS-th of the scene's diameter; where there is nothing, that of the far
        end of the ray in the scene's sphere, or of the sphere's centre plus its radius.
    """
    height, width = camera.image_size(cameras)
    device = cameras.extrinsics.device
    centre = torch.tensor(occupancy.bounds.centre, device=device)
    far = (camera.centres(cameras) - centre).norm(dim=1) + occupancy.bounds.radius
    result = far[:, None, None].repeat(1, height, width)
    masks = torch.ones_like(result) if masks is None else torch.as_tensor(masks, device=device)[:, 0]
    kind = result.device.type == "cpu" and result.dtype == torch.float32
    compiled = kind and find_spec("numba") and are_plain(result)
    together = max(1, RAYS_AT_ONCE // (height * width))
    for first in range(0, len(masks), together):
        found = (masks[first : first + together] > 0).nonzero()  # view, row, column
        for pixels in (found + found.new_tensor([first, 0, 0])).split(RAYS_AT_ONCE):
            rays = cast(cameras, pixels[:, 0], pixels[:, 1:].flip(1).to(result), occupancy.bounds)
            result[pixels.unbind(1)] = (_hits_compiled if compiled else _hits_torch)(occupancy, rays)
    return result


def _hits_compiled(occupancy: Occupancy, rays: Rays) -> Float[Tensor, " ray"]:
    """The distances, by the compiled kernel."""
    bounds, side = occupancy.bounds, occupancy.occupied.shape[0]
    corner = np.asarray(bounds.centre, np.float32) - np.float32(bounds.radius)
    step, per_unit = np.float32(2 * bounds.radius / STEPS), np.float32(side / (2 * bounds.radius))
    parts = [part.contiguous().numpy() for part in (rays.origins, rays.directions, rays.near, rays.far)]
    occupied, nearest = occupancy.occupied.contiguous().numpy().view(np.uint8), np.empty(len(rays), np.float32)
    kernel = compile_kernel("first_hits.first_hits", torch.float32)
    parallel_for(lambda a, b: kernel(*parts, step, corner, per_unit, occupied, nearest, a, b), len(rays), RAYS)
    return torch.from_numpy(nearest)


def _hits_torch(occupancy: Occupancy, rays: Rays) -> Float[Tensor, " ray"]:
    """The distances, in plain PyTorch: ROUND steps of all rays that are left at once."""
    step, device = 2 * occupancy.bounds.radius / STEPS, rays.near.device
    nearest, left = rays.far.clone(), torch.arange(len(rays), device=device)
    for first in range(0, STEPS + 1, ROUND):
        part = rays[left]
        t = part.near[:, None] + (torch.arange(first, first + ROUND, device=device) + 0.5) * step
        inside = occupancy.contains(part.at(t)) & (t < part.far[:, None])
        hit = inside.any(1)
        nearest[left[hit]] = t[hit].gather(1, inside[hit].byte().argmax(1, keepdim=True))[:, 0]
        left = left[~hit & (t[:, -1] < part.far)]
        if not len(left):
            break
    return nearest
