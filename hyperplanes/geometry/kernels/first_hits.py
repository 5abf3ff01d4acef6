"""The CPU kernel of `geometry.first_hits`: every ray steps through the grid until a voxel is occupied."""

from __future__ import annotations

from typing import no_type_check

import numpy as np

__all__ = ["first_hits"]


@no_type_check
def first_hits(origins, directions, near, far, step, corner, per_unit, occupied, nearest, start, stop):
    """Writes into `nearest` the distance of the first sample of rays start..stop that lies in an occupied voxel.

    Samples lie at near + (i + 1/2) step, before far; `far` stays where none of them does. `corner` is where voxel
    (0, 0, 0) starts, `per_unit` the number of voxels in a unit of length.
    """
    number = near.dtype.type
    side, half = number(occupied.shape[0]), number(0.5)
    for ray in range(start, stop):
        # The ray in voxels: position = offset + t slope.
        x0 = (origins[ray, 0] - corner[0]) * per_unit
        y0 = (origins[ray, 1] - corner[1]) * per_unit
        z0 = (origins[ray, 2] - corner[2]) * per_unit
        x1, y1, z1 = directions[ray, 0] * per_unit, directions[ray, 1] * per_unit, directions[ray, 2] * per_unit
        found, sample = far[ray], 0
        while True:
            t = near[ray] + (number(sample) + half) * step
            if not t < far[ray]:
                break
            x, y, z = x0 + t * x1, y0 + t * y1, z0 + t * z1
            if x >= 0 and y >= 0 and z >= 0 and x < side and y < side and z < side:
                if occupied[np.int64(x), np.int64(y), np.int64(z)]:
                    found = t
                    break
            sample += 1
        nearest[ray] = found
