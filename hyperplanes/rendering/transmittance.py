"""Transmittance inside a grid of voxels: ray marching on the CPU, compiled with numba."""

from __future__ import annotations

import math
from typing import no_type_check

import torch
from jaxtyping import Float, Int
from torch import Tensor

from hyperplanes.geometry.kernels.compiling import compile_function
from hyperplanes.geometry.kernels.threads import parallel_for

__all__ = ["transmittance"]

CELL_CHUNK = 1 << 12  # processed together
OPAQUE_OPTICAL_DEPTH = 12.0  # beyond it the transmittance is below 1e-5 and counts as zero


def transmittance(
    optical_depth: Float[Tensor, "x y z"], cells: Int[Tensor, "cell 3"], directions: Float[Tensor, "direction 3"]
) -> Float[Tensor, "cell direction"]:
    """Transmittance from outside the grid to the centres of voxels, along each direction.

    Each ray is marched backwards from the centre of its voxel in steps of one voxel; every step adds the optical depth
    of the voxel that it ends in, so the voxel itself is not counted.

    Args:
        optical_depth: density of each voxel times its side.
        cells: indices (x, y, z) of voxels.
        directions: unit vectors from outside towards the voxels.

    Returns:
        Transmittances in [0, 1], on the device of the grid.
    """
    found, kernel = torch.empty(len(cells), len(directions)), compile_function(_transmittance)
    arrays = [each.cpu().contiguous().numpy() for each in (optical_depth, cells, directions)]
    parallel_for(lambda start, stop: kernel(*arrays, found.numpy(), start, stop), len(cells), CELL_CHUNK)
    return found.to(optical_depth.device)


@no_type_check
def _transmittance(optical_depth, cells, directions, found, start, stop):
    """Transmittances of cells start..stop, into `found`."""
    side = optical_depth.shape[0]
    for cell in range(start, stop):
        for direction in range(directions.shape[0]):
            x, y, z = directions[direction, 0], directions[direction, 1], directions[direction, 2]
            total, step = 0.0, 1.0
            while total < OPAQUE_OPTICAL_DEPTH:
                # the voxel of the next point on the ray; outside the grid the ray ends
                at_x = int(math.floor(cells[cell, 0] + 0.5 - step * x))
                at_y = int(math.floor(cells[cell, 1] + 0.5 - step * y))
                at_z = int(math.floor(cells[cell, 2] + 0.5 - step * z))
                if min(at_x, at_y, at_z) < 0 or max(at_x, at_y, at_z) >= side:
                    break
                total += optical_depth[at_x, at_y, at_z]
                step += 1.0
            found[cell, direction] = math.exp(-total)
