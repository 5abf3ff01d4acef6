"""A tighter occupancy: the adapted field itself is asked which voxels it fills."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from hyperplanes.geometry.occupancy import Occupancy

__all__ = ["refine"]

CHUNK = 1 << 14
MANY = 60_000


@torch.no_grad()
def refine(
    occupancy: Occupancy, density: Callable[[Tensor], Tensor], *, alpha: float = 0.01, margin: int = 1
) -> Occupancy:
    """The voxels of a grid in which a field is not empty.

    The field is asked at the centre of every occupied voxel; what it fills is grown by `margin` voxels, since a surface
    may pass between centres, and never beyond the grid that was given. A grid with very many occupied voxels (no masks,
    so no hull) is asked at half its resolution first.

    Args:
        occupancy: where to ask, such as the visual hull.
        density: world points (point, 3) -> density per world unit (point,).
        alpha: opacity across one voxel from which on it counts as filled.
        margin: voxels to grow by.

    Returns:
        A grid of the same side and bounds.
    """
    if occupancy.occupied.shape[0] >= 64 and int(occupancy.occupied.sum()) > MANY:
        coarse = refine(_halved(occupancy), density, alpha=alpha, margin=margin).occupied
        fine = coarse.repeat_interleave(2, 0).repeat_interleave(2, 1).repeat_interleave(2, 2)
        occupancy = Occupancy(occupancy.occupied & fine, occupancy.bounds)
    points = occupancy.centres()
    filled = torch.zeros(len(points), dtype=torch.bool, device=points.device)
    for first in range(0, len(points), CHUNK):
        part = density(points[first : first + CHUNK])
        filled[first : first + CHUNK] = 1 - torch.exp(-part * occupancy.voxel) > alpha
    grid = torch.zeros_like(occupancy.occupied)
    grid[occupancy.occupied] = filled
    grown = Occupancy(grid, occupancy.bounds).dilated(margin)
    return Occupancy(grown.occupied & occupancy.occupied, occupancy.bounds)


def _halved(occupancy: Occupancy) -> Occupancy:
    """The grid of half the side; a voxel is occupied where any of its eight was."""
    pooled = torch.nn.functional.max_pool3d(occupancy.occupied[None, None].float(), 2)[0, 0] > 0
    return Occupancy(pooled, occupancy.bounds)
