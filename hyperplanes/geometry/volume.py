"""A coarse feature grid of all views over the scene, whose shape does not depend on their number or order."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import adaptive_avg_pool3d, grid_sample, interpolate

from hyperplanes.geometry.chosen_views import Reading
from hyperplanes.geometry.occupancy import Occupancy
from hyperplanes.geometry.rays import Sphere
from hyperplanes.geometry.visibility.planes import VisibilityPlanes

__all__ = ["VALUES_PER_CELL", "VOLUME_SIDE", "interpolate_grid", "resampled_grid", "volume_of"]

VOLUME_SIDE = 32  # cells an axis
VALUES_PER_CELL = 5  # occupied share, mean colour, number of views
VIEWS_PER_CELL = 8  # views averaged per cell
_READING = Reading(VIEWS_PER_CELL, nearest=0, point_frequencies=0, direction_frequencies=0, falloff=0.0)


@torch.no_grad()
def volume_of(planes: VisibilityPlanes) -> Float[Tensor, "channel x y z"]:
    """Features of each cell of a grid over the scene, from all views; zero in cells outside the visual hull.

    Args:
        planes: of one object.

    Returns:
        Five channels: the share of the cell inside the hull; the mean colour, in [-1, 1], at its centre in the views
        that see it best; and the logarithm of the number of views that show it. Adding the variance of these colours or
        the penalty of the best view did not help (docs/image-based.md).
    """
    occupancy = planes.occupancy
    # the share of each cell inside the hull (x, y, z), and the centres of cells where it is not zero
    share = adaptive_avg_pool3d(occupancy.occupied[None, None].to(planes.maps), VOLUME_SIDE)[0, 0]
    cells = (share > 0).nonzero()
    points = Occupancy(share > 0, occupancy.bounds).centres_of(cells).to(share)
    # mean colour of the views that see a cell best (cell, 3), and how many show it, as a logarithm
    if planes.can_describe(points):
        rows = planes.describe(points, None, _READING, occupancy.bounds).rows
        mean, number = rows[:, -11:-8], rows[:, -1]
    else:
        visibility = planes.choose(points, best=VIEWS_PER_CELL)
        seen = visibility.best
        shown = planes.colours.lookup(points).colours
        colours = 2 * shown.gather(1, seen.views[..., None].expand(-1, -1, 3)) - 1
        mean = (seen.weights[..., None] * colours).sum(1)
        number = visibility.number.clamp_min(1).log()
    # back into the grid
    x, y, z = cells.unbind(1)
    values = torch.cat([share[x, y, z][:, None], mean, number[:, None]], 1)
    volume = share.new_zeros(VALUES_PER_CELL, VOLUME_SIDE, VOLUME_SIDE, VOLUME_SIDE)
    volume[:, x, y, z] = values.T
    return volume


def interpolate_grid(
    grid: Float[Tensor, "channel x y z"], points: Float[Tensor, "point 3"], bounds: Sphere
) -> Float[Tensor, "point channel"]:
    """Trilinear interpolation of values at the centres of the cells of a grid over the cube around a sphere.

    Args:
        grid: values; beyond the outermost centres they are constant.
        points: in the world.
        bounds: the sphere.
    """
    where = bounds.normalise(points).flip(-1)[None, None, None]
    return grid_sample(grid[None], where, padding_mode="border", align_corners=False)[0, :, 0, 0].T


def resampled_grid(grid: Float[Tensor, "channel x y z"], side: int) -> Float[Tensor, "channel side side side"]:
    """A grid resampled to another number of cells over the same cube, by trilinear interpolation.

    Args:
        grid: as in `interpolate_grid`.
        side: new number of cells an axis.
    """
    return interpolate(grid[None], (side,) * 3, mode="trilinear", align_corners=False)[0]
