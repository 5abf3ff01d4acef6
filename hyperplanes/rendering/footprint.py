"""Which pixels an occupied region can be seen in."""

from __future__ import annotations

import math

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

    Voxel centres are projected and grown by the most that a voxel of that view reaches across and down, so that no
    pixel that sees one is missed. A voxel beside or behind the camera's plane makes every pixel of that view count.
    """
    height, width = camera.image_size(cameras)
    matrices, calibration = camera.projection_matrices(cameras), camera.intrinsics(cameras)
    points = occupancy.centres().to(matrices)
    result = torch.zeros(len(matrices), height, width, dtype=torch.bool, device=points.device)
    if not len(points):
        return result
    for view, matrix in enumerate(matrices):
        homogeneous = points @ matrix[:, :3].T + matrix[:, 3]
        if float(homogeneous[:, 2].min()) < 2 * occupancy.voxel:
            result[view] = True
            continue
        pixels = homogeneous[:, :2] / homogeneous[:, 2:]
        reach = _reach(pixels, homogeneous[:, 2], calibration[view], occupancy.voxel * math.sqrt(3) / 2)
        touching = ((pixels + reach >= 0) & (pixels - reach <= pixels.new_tensor([width - 1, height - 1]))).all(-1)
        if not touching.any():
            continue
        across, down = (int(value) for value in (reach[touching].amax(0) + 0.51).tolist())
        if across > width or down > height:
            result[view] = True
            continue
        padded = torch.zeros(height + 2 * down, width + 2 * across, device=points.device)
        column, row = pixels[touching].round().long().unbind(-1)
        padded[row + down, column + across] = 1.0
        result[view] = max_pool2d(max_pool2d(padded[None], (2 * down + 1, 1), 1), (1, 2 * across + 1), 1)[0] > 0
    return result


def _reach(pixels: Tensor, depth: Tensor, calibration: Tensor, radius: float) -> Tensor:
    """How many pixels (across, down) a ball about each point reaches.

    A point within r of one at slope u = x / z has a slope within r sqrt(1 + u^2) / (z - r) of u: more towards the
    border of a picture than in its middle.
    """
    down = (pixels[:, 1] - calibration[1, 2]) / calibration[1, 1]
    across = (pixels[:, 0] - calibration[0, 2] - calibration[0, 1] * down) / calibration[0, 0]
    slopes = torch.stack([across, down], -1)
    change = radius * (1 + slopes.square()).sqrt() / (depth - radius)[:, None]
    return change @ calibration[:2, :2].abs().T
