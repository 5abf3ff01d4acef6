"""Which parts of a scene can matter: a grid of occupied voxels, carved from masks (the visual hull)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from kornia.geometry.camera import PinholeCamera
from torch import Tensor
from torch.nn.functional import max_pool2d, max_pool3d

from hyperplanes.geometry import cameras as camera
from hyperplanes.geometry.image_planes import NEAREST_DEPTH
from hyperplanes.geometry.rays import Sphere

__all__ = ["Occupancy", "carve", "full"]


@dataclass(frozen=True)
class Occupancy:
    """Voxels of the cube around a sphere that may hold something.

    Attributes:
        occupied: indexed [x, y, z]; voxel 0 starts at centre - radius on each axis.
        bounds: the sphere inside the cube.
    """

    occupied: Bool[Tensor, "x y z"]
    bounds: Sphere

    @property
    def voxel(self) -> float:
        """Side of a voxel in world units."""
        return 2 * self.bounds.radius / self.occupied.shape[0]

    def index(self, points: Float[Tensor, "*point 3"]) -> Tensor:
        """Flat voxel index of each point, clamped into the grid."""
        side = self.occupied.shape[0]
        cell = ((self.bounds.normalise(points) + 1) * (side / 2)).long().clamp_(0, side - 1)
        return (cell[..., 0] * side + cell[..., 1]) * side + cell[..., 2]

    def contains(self, points: Float[Tensor, "*point 3"]) -> Bool[Tensor, "*point"]:
        """Whether each point lies in an occupied voxel; false outside the cube."""
        inside = (self.bounds.normalise(points).abs() <= 1).all(-1)
        return self.occupied.flatten()[self.index(points)] & inside

    def centres(self) -> Float[Tensor, "voxel 3"]:
        """World positions of the centres of the occupied voxels, in index order."""
        cell = self.occupied.nonzero().float()
        unit = (cell + 0.5) * (2 / self.occupied.shape[0]) - 1
        return unit * self.bounds.radius + unit.new_tensor(self.bounds.centre)

    def dilated(self, voxels: int = 1) -> Occupancy:
        """The grid grown by some voxels in every direction."""
        grown = max_pool3d(self.occupied[None, None].float(), 2 * voxels + 1, 1, voxels)[0, 0] > 0
        return Occupancy(grown, self.bounds)


def full(bounds: Sphere, side: int = 64, device: torch.device | str | None = None) -> Occupancy:
    """A grid in which everything may matter."""
    return Occupancy(torch.ones(side, side, side, dtype=torch.bool, device=device), bounds)


@torch.no_grad()
def carve(
    masks: Float[Tensor, "view 1 height width"], cameras: PinholeCamera, bounds: Sphere, side: int = 64
) -> Occupancy:
    """The visual hull: voxels that no mask rules out.

    A voxel goes when some camera that sees its centre sees only background around it: the mask's maximum within the
    voxel's circumscribed footprint is zero. So the hull of the true object is never cut, whatever the resolution.

    Args:
        masks: opacity in [0, 1].
        cameras: one a mask.
        bounds: the region to carve from.
        side: voxels an axis.
    """
    grid = full(bounds, side, masks.device)
    height, width = masks.shape[2:]
    kept = torch.arange(side**3, device=masks.device)
    points = grid.centres()
    matrices = camera.projection_matrices(cameras)
    focal = camera.intrinsics(cameras)[:, 0, 0]
    for view in range(len(masks)):
        homogeneous = points @ matrices[view, :, :3].T + matrices[view, :, 3]
        depth = homogeneous[:, 2]
        front = depth > max(NEAREST_DEPTH, grid.voxel)
        pixels = homogeneous[:, :2] / torch.where(front, depth, 1.0)[:, None]
        column, row = pixels.round().long().unbind(-1)
        inside = front & (column >= 0) & (row >= 0) & (column < width) & (row < height)
        nearest = depth[front].min() if front.any() else depth.new_tensor(1.0)
        reach = int(torch.ceil(focal[view] * grid.voxel * 0.87 / nearest + 0.5))
        seen = max_pool2d(masks[view][None], 2 * reach + 1, 1, reach)[0, 0] > 0
        ruled_out = inside & ~seen[row.clamp(0, height - 1), column.clamp(0, width - 1)]
        kept, points = kept[~ruled_out], points[~ruled_out]
    occupied = torch.zeros(side**3, dtype=torch.bool, device=masks.device)
    occupied[kept] = True
    return Occupancy(occupied.reshape(side, side, side), bounds)
