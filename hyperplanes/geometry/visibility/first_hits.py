"""Where the rays of pixels first meet an occupied voxel: the depth of the visual hull in every view."""

from __future__ import annotations

from importlib.util import find_spec

import numpy as np
import torch
from jaxtyping import Float
from kornia.geometry.camera import PinholeCamera
from torch import Tensor

from hyperplanes.geometry import cameras as camera
from hyperplanes.geometry.distortion import DistortedCamera, undistorted_pixels
from hyperplanes.geometry.inputs import ArrayLike
from hyperplanes.geometry.kernels.compiling import compile_kernel
from hyperplanes.geometry.kernels.threads import parallel_for
from hyperplanes.geometry.occupancy import Occupancy
from hyperplanes.geometry.rays import Rays, cast, pixel_grid
from hyperplanes.utilities.tensors.transforms import are_plain

__all__ = ["first_hits"]

STEPS_PER_DIAMETER = 128  # samples along a diameter of the scene
SAMPLES_AT_ONCE = 8  # samples tested at once, without compiled kernels
ROWS_PER_CALL = 16  # rows of pixels per kernel call
RAYS_AT_ONCE = 1 << 17  # cast together, without compiled kernels: those of many photographs would take gigabytes


@torch.no_grad()
def first_hits(
    occupancy: Occupancy, cameras: PinholeCamera, masks: ArrayLike | None = None
) -> Float[Tensor, "view height width"]:
    """The distance from each camera to the first occupied voxel along the ray of each pixel.

    Args:
        occupancy: the grid.
        cameras: of one image size.
        masks: (view, 1, height, width); pixels where they are 0 are skipped.

    Returns:
        Distances along unit rays, exact to a STEPS_PER_DIAMETER-th of the scene's diameter; parts thinner than that can
        be missed. A ray that hits nothing has the distance at which it leaves the scene's sphere, a skipped pixel that
        of the sphere's centre plus its radius.
    """
    height, width = camera.image_size(cameras)
    centres, bounds = camera.centres(cameras), occupancy.bounds
    far = (centres - centres.new_tensor(bounds.centre)).norm(dim=1) + bounds.radius
    result = far[:, None, None].repeat(1, height, width)
    masks = torch.ones_like(result) if masks is None else torch.as_tensor(masks, device=result.device)[:, 0]
    kind = result.device.type == "cpu" and result.dtype == torch.float32
    if kind and find_spec("numba") and are_plain(result, masks):
        _find_compiled(occupancy, cameras, masks.detach().to(result), result)
        return result
    together = max(1, RAYS_AT_ONCE // (height * width))
    for first in range(0, len(masks), together):
        found = (masks[first : first + together] > 0).nonzero()  # view, row, column
        for pixels in (found + found.new_tensor([first, 0, 0])).split(RAYS_AT_ONCE):
            rays = cast(cameras, pixels[:, 0], pixels[:, 1:].flip(1).to(result), bounds)
            result[pixels.unbind(1)] = _hits_torch(occupancy, rays)
    return result


def _find_compiled(occupancy: Occupancy, cameras: PinholeCamera, masks: Tensor, result: Tensor) -> None:
    """Write the distances of the pixels whose masks are above 0 into `result`, by the compiled kernel."""
    bounds, matrix = occupancy.bounds, camera.intrinsics(cameras).flatten(1)
    rotation = camera.camera_from_world(cameras)[:, :3, :3].flatten(1)
    numbers = torch.cat([camera.centres(cameras), rotation, matrix[:, [0, 4, 2, 5, 1]]], 1)
    pixels = result.new_empty(0, 0, 0, 2)
    if isinstance(cameras, DistortedCamera):
        pixels, shown = _without_lenses(cameras, *result.shape[1:])
        masks = masks * shown
    fixed = (
        *(each.to(result).contiguous().numpy() for each in (numbers, pixels)), masks.numpy(),
        np.array([*bounds.centre, bounds.radius], np.float32), np.float32(2 * bounds.radius / STEPS_PER_DIAMETER),
        np.array(occupancy.box, np.float32), occupancy.occupied.contiguous().numpy().view(np.uint8), result.numpy(),
    )  # fmt: skip
    kernel = compile_kernel("hull.first_hits.first_hits", torch.float32)
    parallel_for(lambda a, b: kernel(*fixed, a, b), result.shape[0] * result.shape[1], ROWS_PER_CALL)


def _without_lenses(cameras: DistortedCamera, height: int, width: int) -> tuple[Tensor, Tensor]:
    """The undistorted position of each pixel of each view, and whether it has one."""
    grid = pixel_grid(height, width)
    found = [undistorted_pixels(cameras, view.expand(len(grid)), grid) for view in torch.arange(cameras.batch_size)]
    pixels, shown = (torch.stack(part).unflatten(1, (height, width)) for part in zip(*found, strict=True))
    return pixels, shown


def _hits_torch(occupancy: Occupancy, rays: Rays) -> Float[Tensor, " ray"]:
    """The distances, in plain PyTorch: SAMPLES_AT_ONCE samples at a time of all rays that have hit nothing yet."""
    step, device = 2 * occupancy.bounds.radius / STEPS_PER_DIAMETER, rays.near.device
    nearest, left = rays.far.clone(), torch.arange(len(rays), device=device)
    for first in range(0, STEPS_PER_DIAMETER + 1, SAMPLES_AT_ONCE):
        part = rays[left]
        t = part.near[:, None] + (torch.arange(first, first + SAMPLES_AT_ONCE, device=device) + 0.5) * step
        inside = occupancy.contains(part.at(t)) & (t < part.far[:, None])
        hit = inside.any(1)
        nearest[left[hit]] = t[hit].gather(1, inside[hit].byte().argmax(1, keepdim=True))[:, 0]
        left = left[~hit & (t[:, -1] < part.far)]
        if not len(left):
            break
    return nearest
