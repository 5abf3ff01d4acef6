"""A tighter occupancy: the adapted field itself is asked which voxels it fills."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from hyperplanes.geometry.occupancy import Occupancy
from hyperplanes.geometry.rays import Sphere

__all__ = ["refine"]

CHUNK = 1 << 14
MANY = 60_000


@torch.no_grad()
def refine(
    occupancy: Occupancy, density: Callable[[Tensor], Tensor], *, lost: float = 0.05, margin: int = 1
) -> Occupancy:
    """The voxels of a grid in which a field is not empty.

    The field is asked at the centre of every occupied voxel; what it fills is grown by `margin` voxels, since a surface
    may pass between centres, and never beyond the grid that was given. So a voxel goes only where it and all its
    neighbours are empty at their centres: what is thinner than a voxel may be missed, as samples a voxel apart may miss
    it. A grid with very many occupied voxels (no masks, so no hull) is asked at half its resolution first.

    Empty is a density that a ray could cross the whole sphere in and be at most `lost` opaque: haze in many voxels
    counts as much as in one. On cars of 64 pixels a picture then differs from one without refinement by 68 dB where
    there are no masks and 92 dB where there are, and by less than 0.01 dB against the truth.

    Args:
        occupancy: where to ask, such as the visual hull.
        density: world points (point, 3) -> density per world unit (point,).
        lost: opacity that a ray may lose at the most, if all that was dropped lay along it.
        margin: voxels to grow by.

    Returns:
        A grid of the same side and bounds.
    """
    if occupancy.occupied.shape[0] >= 64 and int(occupancy.occupied.sum()) > MANY:
        side = occupancy.occupied.shape[0]
        coarse = refine(_halved(occupancy), density, lost=lost, margin=margin).occupied
        fine = coarse.repeat_interleave(2, 0).repeat_interleave(2, 1).repeat_interleave(2, 2)[:side, :side, :side]
        occupancy = Occupancy(occupancy.occupied & fine, occupancy.bounds)
    faint = -math.log1p(-lost) / (2 * occupancy.bounds.radius)
    points = occupancy.centres()
    filled = torch.zeros(len(points), dtype=torch.bool, device=points.device)
    for first in range(0, len(points), CHUNK):
        filled[first : first + CHUNK] = density(points[first : first + CHUNK]) > faint
    grid = torch.zeros_like(occupancy.occupied)
    grid[occupancy.occupied] = filled
    grown = Occupancy(grid, occupancy.bounds).dilated(margin)
    return Occupancy(grown.occupied & occupancy.occupied, occupancy.bounds)


def _halved(occupancy: Occupancy) -> Occupancy:
    """The grid of half the side, rounded up; a voxel is occupied where any of its eight was.

    An odd side leaves the last of its voxels with a half outside: the cube grows by one fine voxel there.
    """
    pooled = torch.nn.functional.max_pool3d(occupancy.occupied[None, None].float(), 2, ceil_mode=True)[0, 0] > 0
    radius = len(pooled) * occupancy.voxel
    x, y, z = (value - occupancy.bounds.radius + radius for value in occupancy.bounds.centre)
    return Occupancy(pooled, Sphere((x, y, z), radius))
