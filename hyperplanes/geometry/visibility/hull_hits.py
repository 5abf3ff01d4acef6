"""The visual hull by the masks themselves, which is finer than its voxels: where rays enter it, and what is inside."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from hyperplanes.geometry.kernels.compiling import compile_kernel
from hyperplanes.geometry.kernels.threads import parallel_for
from hyperplanes.geometry.occupancy import Occupancy
from hyperplanes.geometry.rays import Rays
from hyperplanes.geometry.visibility.planes import VisibilityPlanes

__all__ = ["centres_in_hull", "hull_hits"]

RAY_CHUNK, LAYERS = 512, 2  # rays, and layers of voxels, per kernel call
HULL_POINT_CHUNK = 1 << 14  # per call, without compiled kernels


@torch.no_grad()
def hull_hits(
    planes: VisibilityPlanes,
    rays: Rays,
    first: Float[Tensor, " ray"],
    step: float,
    voxels: Occupancy,
    opacity: float,
) -> Float[Tensor, " ray"]:
    """The first sample of each ray in the visual hull, by a compiled kernel (see `planes.has_kernels`).

    Args:
        planes: views whose masks define the hull.
        rays: their origins, directions and far are read.
        first: distance of the first sample of each ray.
        step: distance between samples.
        voxels: a sample lies in the hull only where these are occupied.
        opacity: least mask opacity at a sample in every view that shows it.

    Returns:
        Distances along the rays; infinite where no sample lies in the hull.
    """
    cameras, bounds, shape = planes.shown_cameras(), voxels.bounds, planes.maps.shape
    arrays = [each.contiguous().numpy() for each in (rays.origins, rays.directions, first, rays.far)]
    fixed = (
        *arrays, np.float32(step), np.array([*bounds.centre, bounds.radius], np.float32),
        np.array(voxels.box, np.float32), voxels.occupied.contiguous().numpy().view(np.uint8),
        *(each.contiguous().flatten().numpy() for each in (cameras, planes.maps)),
        (*shape[:3], cameras.shape[1]), np.array([planes.colours.nearest, opacity], np.float32),
    )  # fmt: skip
    nearest = torch.empty(len(rays))
    kernel = compile_kernel("hull.hull_hits.hull_hits", torch.float32)
    parallel_for(lambda a, b: kernel(*fixed, nearest.numpy(), a, b), len(rays), RAY_CHUNK)
    return nearest


@torch.no_grad()
def centres_in_hull(planes: VisibilityPlanes, opacity: float) -> Occupancy:
    """The occupied voxels of the planes whose centres lie in the hull.

    Args:
        planes: views whose masks define the hull, with the voxels to test.
        opacity: least mask opacity at a centre in every view that shows it.
    """
    voxels, occupied = planes.occupancy, planes.occupancy.occupied.clone()
    if not planes.has_kernels(planes.maps):
        points = voxels.centres().to(planes.maps).split(HULL_POINT_CHUNK)
        occupied[voxels.occupied] = torch.cat([planes.choose(each, best=0).coverage >= opacity for each in points])
        return replace(voxels, occupied=occupied)
    cameras, shape, bounds = planes.shown_cameras(), planes.maps.shape, voxels.bounds
    occupied = occupied.contiguous()
    fixed = (
        *(each.contiguous().flatten().numpy() for each in (cameras, planes.maps)), (*shape[:3], cameras.shape[1]),
        np.asarray(bounds.centre, np.float32) - np.float32(bounds.radius), np.float32(voxels.voxel),
        np.array([planes.colours.nearest, opacity], np.float32), occupied.numpy().view(np.uint8),
    )  # fmt: skip
    kernel = compile_kernel("hull.centres.centres", torch.float32)
    parallel_for(lambda a, b: kernel(*fixed, a, b), len(occupied), LAYERS)
    return replace(voxels, occupied=occupied)
