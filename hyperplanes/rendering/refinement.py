"""Pruning of an occupancy grid: voxels with negligible density are dropped."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from hyperplanes.geometry.occupancy import Occupancy, dilate, ranges

__all__ = ["RefinedOccupancy", "refine"]

OPACITY_LOSS = 0.05  # of a ray along which all dropped voxels would lie; with 0.3 haze of young fields is lost
MIN_OPTICAL_DEPTH = 0.03
"""Least optical depth of a voxel that the field fills. With less, haze hides what lies behind it; with 0.3, surfaces
that are half transparent, as with few views, are lost (up to 2.9 dB with 5 views)."""

VOXEL_CHUNK = 1 << 14  # voxels in one call of the density
OCCLUDING_OPTICAL_DEPTH = 1.0  # optical depth of a voxel from which on it hides what lies behind it
ALONG = 0.2  # components of a direction below this fraction of the largest one are ignored
COARSE_FIRST = 60_000  # occupied voxels from which on half the resolution is evaluated first


@dataclass(frozen=True)
class RefinedOccupancy(Occupancy):
    """The voxels in which a field is not empty.

    Attributes:
        optical_depth: of each voxel, from the density at its centre; infinite behind opaque voxels, 0 if not evaluated.
    """

    optical_depth: Float[Tensor, "x y z"]

    def solid(self) -> Occupancy:
        """The voxels that the field fills; the first of them along a ray is its surface."""
        return Occupancy(self.optical_depth > MIN_OPTICAL_DEPTH, self.bounds)


@torch.no_grad()
def refine(
    occupancy: Occupancy, density: Callable[[Tensor], Tensor], *, margin_loss: float | None = None
) -> RefinedOccupancy:
    """The voxels of a grid in which a field is not empty.

    The density is evaluated at the centre of every occupied voxel that does not lie behind opaque ones, then, in voxels
    that would be dropped, at the centres of their eight parts, half a voxel apart. Voxels above the threshold are
    dilated by one voxel, the margin, but never beyond the given grid. Of an object with sharp borders, this keeps,
    without `margin_loss`:

    - in a grid of up to 60,000 occupied voxels, such as a visual hull: everything at least half a voxel thick;
    - in a larger one (without masks, so without a hull), which is first evaluated at half its resolution: everything
      two voxels thick, and everything half a voxel thick that is connected to it, by following neighbours.

    Thinner parts may be missed, as samples on a ray may miss them. With `margin_loss`, as in `AdaptedField`, parts less
    than a voxel thick may also lose those of their voxels in which the density is low.

    The threshold is the density at which a ray through the whole sphere would have an opacity of OPACITY_LOSS, so haze
    in many voxels counts as much as in one. On cars of 64 pixels, pictures with and without refinement have a PSNR to
    each other of 68 dB without masks and 92 dB with masks, and differ by less than 0.01 dB against the truth.

    Args:
        occupancy: the voxels to evaluate, such as the visual hull.
        density: world points (point, 3) -> density per world unit (point,).
        margin_loss: opacity that takes the place of OPACITY_LOSS for the margin: its voxels are kept if they reach the
            density of that on the side towards the voxels that were found; by default all are kept.

    Returns:
        A grid with the same side and bounds.
    """
    threshold = _density_of(OPACITY_LOSS, occupancy)
    least = threshold * occupancy.voxel  # optical depth
    side, bounds = occupancy.occupied.shape[0], occupancy.bounds
    asked, large = occupancy.occupied, side >= 64 and int(occupancy.occupied.sum()) > COARSE_FIRST
    # in large grids, only what a grid of half the resolution keeps is evaluated
    if large:
        halved = _halved(occupancy)
        coarse = _dilated(halved, _from_outside(halved, halved.occupied, density) > 2 * least)
        asked = (
            asked & coarse.repeat_interleave(2, 0).repeat_interleave(2, 1).repeat_interleave(2, 2)[:side, :side, :side]
        )
    optical_depth = _from_outside(occupancy, asked, density)
    filled = optical_depth > least
    kept, divided = _dilated(occupancy, filled), torch.zeros_like(filled)
    # between the centres: voxels beside those that are kept are evaluated at eight points
    while True:
        near = _dilated(occupancy, kept) if large else occupancy.occupied
        asked = near & occupancy.occupied & ~kept & ~divided
        divided |= asked
        found = _filled(occupancy, asked, density, threshold)
        if not found.any():
            break
        filled = filled | found
        kept = kept | _dilated(occupancy, found)
    if margin_loss is not None:
        kept = _trimmed(Occupancy(kept, bounds), filled, density, _density_of(margin_loss, occupancy))
    return RefinedOccupancy(kept, bounds, optical_depth)


def _density_of(opacity_loss: float, occupancy: Occupancy) -> float:
    """The density with which a diameter of the scene has this opacity."""
    return -math.log1p(-opacity_loss) / (2 * occupancy.bounds.radius)


def _trimmed(grid: Occupancy, filled: Tensor, density: Callable[[Tensor], Tensor], threshold: float) -> Tensor:
    """The filled voxels of a grid, and those of the others with density on the side towards them.

    Each of the others is evaluated once, at the corner, or the middle of an edge or face, that lies towards the filled
    ones among its 26 neighbours: a flat surface that enters the voxel from there contains that point. If there is no
    such point, as between two surfaces, the voxel is kept.
    """
    margin = Occupancy(grid.occupied & ~filled, grid.bounds)
    places, padded = margin.occupied.nonzero(), torch.nn.functional.pad(filled, (1,) * 6)
    offsets = torch.cartesian_prod(*[torch.arange(-1, 2, device=filled.device)] * 3)
    towards = torch.zeros(len(places), 3, device=filled.device)
    for offset in offsets:
        towards += padded[tuple((places + 1 + offset).T)][:, None] * offset
    towards = torch.where(towards.abs() > ALONG * towards.abs().amax(1, keepdim=True), towards.sign(), 0.0)
    found = _densities(margin.centres() + towards * (grid.voxel / 2), density) > threshold
    kept = grid.occupied.clone()
    kept[margin.occupied] = found | (towards == 0).all(1)
    return kept


def _from_outside(grid: Occupancy, asked: Tensor, density: Callable[[Tensor], Tensor]) -> Tensor:
    """Optical depth of voxels by the density at their centres; infinite behind opaque ones, 0 if not `asked`.

    The density is evaluated from the surface inwards until voxels are opaque: three quarters of the hull of a car lie
    behind, where no ray gets.
    """
    result = torch.where(asked, torch.inf, 0.0)
    box, corner = _box_of(asked)  # an object fills a small part of its grid
    left = torch.nn.functional.pad(asked[box], (1,) * 6)  # beyond the box is outside
    steps = torch.tensor([left.shape[1] * left.shape[2], left.shape[2], 1], device=left.device)
    around = torch.cartesian_prod(*[torch.arange(-1, 2, device=left.device)] * 3) @ steps
    layer = (left & dilate(~left)).flatten().nonzero()[:, 0]
    shape, left = left.shape, left.flatten()
    sides = torch.tensor(shape, device=left.device)
    depth = torch.where(left, torch.inf, 0.0)
    while len(layer):
        places = layer[:, None] // steps % sides - 1 + corner  # torch.unravel_index imports sympy, which takes 0.3 s
        found = _densities(grid.centres_of(places), density) * grid.voxel
        depth[layer], left[layer] = found.to(depth), False
        beside = (layer[found < OCCLUDING_OPTICAL_DEPTH][:, None] + around).flatten()
        layer = beside[left[beside]].unique()
    result[box] = depth.unflatten(0, shape)[1:-1, 1:-1, 1:-1]
    return result


def _box_of(occupied: Tensor) -> tuple[tuple[slice, ...], Tensor]:
    """The smallest box around the occupied voxels, and its first voxel."""
    ends = ranges(occupied)
    return tuple(slice(*each) for each in ends), torch.tensor([each[0] for each in ends], device=occupied.device)


def _densities(points: Tensor, density: Callable[[Tensor], Tensor]) -> Tensor:
    return torch.cat([density(part) for part in points.split(VOXEL_CHUNK)])


def _filled(grid: Occupancy, asked: Tensor, density: Callable[[Tensor], Tensor], threshold: float) -> Tensor:
    """The voxels of `asked` with density above a threshold at the centre of one of their eight parts."""
    points = Occupancy(asked, grid.bounds).centres()
    steps = torch.tensor([-0.25, 0.25], device=points.device) * grid.voxel
    offsets = torch.cartesian_prod(steps, steps, steps).reshape(-1, 3)
    found = torch.zeros(len(points), dtype=torch.bool, device=points.device)
    chunk = VOXEL_CHUNK // len(offsets)
    for first in range(0, len(points), chunk):
        part = points[first : first + chunk, None] + offsets
        found[first : first + chunk] = (density(part.reshape(-1, 3)) > threshold).reshape(part.shape[:2]).any(1)
    filled = torch.zeros_like(asked)
    filled[asked] = found
    return filled


def _dilated(grid: Occupancy, filled: Tensor) -> Tensor:
    """Filled voxels and their neighbours, inside the grid."""
    box, _ = _box_of(filled)
    box = tuple(slice(max(0, each.start - 1), each.stop + 1) for each in box)
    result = torch.zeros_like(filled)
    result[box] = dilate(filled[box]) & grid.occupied[box]
    return result


def _halved(occupancy: Occupancy) -> Occupancy:
    """The grid of half the side, rounded up; a voxel is occupied where any of its eight was."""
    even = occupancy.with_even_side()
    return Occupancy(torch.nn.functional.max_pool3d(even.occupied[None].float(), 2)[0] > 0, even.bounds)
