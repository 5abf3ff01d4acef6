"""Which pixels an occupied region can be seen in."""

from __future__ import annotations

import torch
from jaxtyping import Bool
from kornia.geometry.camera import PinholeCamera
from torch import Tensor
from torch.nn.functional import max_pool2d

from hyperplanes.geometry import cameras as camera
from hyperplanes.geometry.occupancy import Occupancy

__all__ = ["footprint"]


@torch.no_grad()
def footprint(occupancy: Occupancy, cameras: PinholeCamera) -> Bool[Tensor, "view height width"]:
    """The pixels whose rays may meet an occupied voxel; every other pixel is background.

    Voxel centres are projected and grown by the largest radius that a voxel has in that view, so that no pixel that
    sees one is missed. A voxel beside or behind the camera's plane makes every pixel of that view count.
    """
    height, width = camera.image_size(cameras)
    points = occupancy.centres()
    matrices, focal = camera.projection_matrices(cameras), camera.intrinsics(cameras)[:, 0, 0]
    result = torch.zeros(len(matrices), height, width, dtype=torch.bool, device=points.device)
    if not len(points):
        return result
    for view, matrix in enumerate(matrices):
        homogeneous = points @ matrix[:, :3].T + matrix[:, 3]
        depth = homogeneous[:, 2]
        nearest = float(depth.min())
        if nearest < 2 * occupancy.voxel:
            result[view] = True
            continue
        column, row = (homogeneous[:, :2] / depth[:, None]).round().long().unbind(-1)
        reach = int(float(focal[view]) * occupancy.voxel * 0.87 / nearest + 1.5)
        padded = torch.zeros(height + 2 * reach, width + 2 * reach, device=points.device)
        row, column = row + reach, column + reach
        near = (row >= 0) & (column >= 0) & (row < len(padded)) & (column < padded.shape[1])
        padded[row[near], column[near]] = 1.0
        result[view] = max_pool2d(padded[None], 2 * reach + 1, 1)[0] > 0
    return result
