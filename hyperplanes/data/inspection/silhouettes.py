"""Coarse visual hulls and their silhouettes: what masks say about poses."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from kornia.geometry.camera import PinholeCamera
from torch import Tensor
from torch.nn.functional import interpolate, max_pool2d

from hyperplanes.data.pictures.bounds import OFTEN_CUT, SEARCH_RADII, are_shown, cut_off, empty_masks, estimate_bounds
from hyperplanes.geometry import cameras as camera
from hyperplanes.geometry.occupancy import Occupancy, carve
from hyperplanes.geometry.rays import Sphere
from hyperplanes.views import Views

__all__ = ["CoarseHull", "coarse_hull", "masks_tell", "silhouettes", "small_masks", "with_object"]

HULL_SIDE = 32
MASK = 64
MOST_VIEWS = 16


@dataclass(frozen=True)
class CoarseHull:
    """The visual hull of some masks.

    Attributes:
        points: centres of its voxels; none where the masks leave nothing.
        grid: the voxels.
    """

    points: Float[Tensor, "voxel 3"]
    grid: Occupancy | None

    def overlap(self, masks: Float[Tensor, "view 1 height width"], cameras: PinholeCamera) -> Float[Tensor, " view"]:
        """Intersection over union of each mask with the silhouette of the hull."""
        if self.grid is None:
            return torch.zeros(len(masks))
        seen, wanted = silhouettes(self.points, self.grid, cameras), masks[:, 0] > 0
        union = (seen | wanted).flatten(1).sum(1)
        return (seen & wanted).flatten(1).sum(1) / union.clamp_min(1)

    def coverage(self, masks: Float[Tensor, "view 1 height width"], cameras: PinholeCamera) -> float:
        """How much of each mask the hull's silhouette covers, on average: nearly all with right poses."""
        if self.grid is None:
            return 0.0
        seen, wanted = silhouettes(self.points, self.grid, cameras), masks[:, 0] > 0
        filled = wanted.flatten(1).any(1)
        covered = (seen & wanted).flatten(1).sum(1) / wanted.flatten(1).sum(1).clamp_min(1)
        return float(covered[filled].mean()) if filled.any() else 0.0


def coarse_hull(masks: Float[Tensor, "view 1 height width"], cameras: PinholeCamera) -> CoarseHull:
    """The hull of masks in the sphere that the cameras look at, and once more in the sphere around that.

    Where borders cut many masks off, as in `estimate_bounds`, it is searched in a larger one.

    Args:
        masks: opacity, as `small_masks` gives them.
        cameras: one a mask.

    Returns:
        The hull, empty where most cameras look away from where all would meet.
    """
    sphere = estimate_bounds(cameras)
    nothing = CoarseHull(masks.new_zeros(0, 3), None)
    # cameras that look away from the sphere have no hull in it
    pose = camera.camera_from_world(cameras)
    ahead = pose[:, 2] @ pose.new_tensor([*sphere.centre, 1.0])
    if (ahead > 0).float().mean() < 0.5:
        return nothing
    hull = nothing
    ends = cut_off(masks)
    cut = float(ends.float().mean()) > OFTEN_CUT
    sphere = Sphere(sphere.centre, SEARCH_RADII * sphere.radius) if cut else sphere
    # each time in the sphere around what the last hull was
    for _ in range(3 if cut else 2):
        grid = carve(masks, cameras, sphere, HULL_SIDE)
        points = grid.centres()
        points = points[sphere.normalise(points).norm(dim=-1) <= 1]
        points = points[are_shown(points, cameras, ends)] if cut else points
        if not len(points):
            return nothing
        hull = CoarseHull(points, grid)
        middle = (points.amin(0) + points.amax(0)) / 2
        radius = float((points - middle).norm(dim=-1).max()) + grid.voxel
        sphere = Sphere(tuple(middle.tolist()), min(radius, sphere.radius))
    return hull


def masks_tell(views: Views) -> bool:
    """Whether there are masks, and they say where the object is."""
    return views.masks is not None and 0 < float((views.masks > 0).float().mean()) < 0.95


def with_object(views: Views) -> Views:
    """The views whose masks are not empty; all where there are no masks."""
    if views.masks is None:
        return views
    empty = empty_masks(views.masks)
    return views[~empty] if empty.any() else views


def small_masks(
    views: Views, pixels: int = MASK, most: int = MOST_VIEWS
) -> tuple[Float[Tensor, "view 1 height width"], PinholeCamera]:
    """Masks of at most `most` views, spread over all, at most `pixels` a side, with their cameras."""
    assert views.masks is not None
    masks, cameras = views.masks, views.cameras
    if len(views) > most:
        chosen = torch.linspace(0, len(views) - 1, most).round().long()
        masks, cameras = masks[chosen], camera.select(cameras, chosen)
    height, width = masks.shape[2:]
    factor = pixels / max(height, width)
    if factor >= 1:
        return masks, cameras
    size = max(1, round(height * factor)), max(1, round(width * factor))
    return (interpolate(masks, size, mode="area") > 0.2).float(), camera.resized(cameras, *size)


def silhouettes(
    points: Float[Tensor, "voxel 3"], hull: Occupancy, cameras: PinholeCamera
) -> Bool[Tensor, "view height width"]:
    """Which pixels show a voxel: its centre's, those within half a voxel of it, and gaps of two pixels between."""
    height, width = camera.image_size(cameras)
    matrices = camera.projection_matrices(cameras)
    seen = torch.zeros(len(matrices), height, width, dtype=torch.bool)
    for view, matrix in enumerate(matrices):
        homogeneous = points @ matrix[:, :3].T + matrix[:, 3]
        front = homogeneous[homogeneous[:, 2] > hull.voxel]
        column, row = (front[:, :2] / front[:, 2:]).round().long().unbind(-1)
        inside = (column >= 0) & (row >= 0) & (column < width) & (row < height)
        if not inside.any():
            continue
        picture = torch.zeros(1, height, width)
        picture[0, row[inside], column[inside]] = 1.0
        focal = float(camera.intrinsics(cameras)[view, [0, 1], [0, 1]].max())
        reach = int(focal * hull.voxel / 2 / float(front[:, 2].median()))
        grown = max_pool2d(picture, 2 * reach + 3, 1, reach + 1)  # a pixel more, which closes the gaps between centres
        seen[view] = -max_pool2d(-grown, 3, 1, 1)[0] > 0
    return seen
