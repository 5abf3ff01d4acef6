"""The CPU kernel of `geometry.visibility.hull_hits`: every ray steps on until no mask rules its sample out."""

from __future__ import annotations

from typing import no_type_check

import numpy as np

from hyperplanes.geometry.kernels.lookup.blocks import inlined
from hyperplanes.geometry.kernels.voxels.boxes import samples_within
from hyperplanes.geometry.lookup_torch import BORDER_TOLERANCE

__all__ = ["hull_hits"]


@inlined
@no_type_check
def _opacity(cameras, pitch, view, x, y, z, maps, shape, min_z):
    """Bilinear opacity of a view's mask at a point's projection, as in `choosing.judge`; 1 where it is not shown."""
    number = maps.dtype.type
    zero, one = number(0), number(1)
    height, width = shape[1], shape[2]
    m = 3 * pitch + view
    u = cameras[m] * x + cameras[m + pitch] * y + cameras[m + 2 * pitch] * z + cameras[m + 3 * pitch]
    m += 4 * pitch
    v = cameras[m] * x + cameras[m + pitch] * y + cameras[m + 2 * pitch] * z + cameras[m + 3 * pitch]
    m += 4 * pitch
    camera_z = cameras[m] * x + cameras[m + pitch] * y + cameras[m + 2 * pitch] * z + cameras[m + 3 * pitch]
    if not (camera_z > min_z and cameras[15 * pitch + view] > zero):
        return one
    u, v = u / camera_z, v / camera_z
    low, right, bottom = (
        number(-BORDER_TOLERANCE),
        number(width - 1 + BORDER_TOLERANCE),
        number(height - 1 + BORDER_TOLERANCE),
    )
    if not (u >= low and u <= right and v >= low and v <= bottom):
        return one
    u, v = min(max(u, zero), number(width - 1)), min(max(v, zero), number(height - 1))
    column, row = np.int64(min(u, number(max(width - 2, 0)))), np.int64(min(v, number(max(height - 2, 0))))
    across, down = u - number(column), v - number(row)
    at = 2 * ((view * height + row) * width + column) + 1
    next_column, next_row = 2 * min(width - 1, 1), 2 * width * min(height - 1, 1)
    a, b = maps[at], maps[at + next_row]
    a, b = a + across * (maps[at + next_column] - a), b + across * (maps[at + next_row + next_column] - b)
    return a + down * (b - a)


@no_type_check
def hull_hits(
    origins, directions, first, far, step, sphere, box, occupied, cameras, maps, shape, limits, nearest, start, stop
):
    """Writes into `nearest` the distance of the first sample of rays start..stop in the hull, infinity where none is.

    Samples lie at first + i step, before far, in occupied voxels, as in `marching.march`. One lies in the hull where
    every view that shows it has the least opacity there; the view that ruled out the last sample is tested first.
    `cameras` and `maps` are those of `choosing.choose`, `shape` the number of views, height, width and the pitch of
    `cameras`; `limits` are min_z and the opacity, `sphere` the centre and the radius of the scene, `box` the corners
    around its occupied voxels.
    """
    number = first.dtype.type
    side, half, one = occupied.shape[0], number(occupied.shape[0]) / number(2), number(1)
    total, pitch = shape[0], shape[3]
    cutting = 0
    for ray in range(start, stop):
        nearest[ray] = np.inf
        place, end = samples_within(origins, directions, first, far, ray, step, box)
        t = first[ray] + number(place) * step
        while t < end:
            px, py, pz = (
                origins[ray, 0] + t * directions[ray, 0],
                origins[ray, 1] + t * directions[ray, 1],
                origins[ray, 2] + t * directions[ray, 2],
            )
            x, y, z = (px - sphere[0]) / sphere[3], (py - sphere[1]) / sphere[3], (pz - sphere[2]) / sphere[3]
            if abs(x) <= one and abs(y) <= one and abs(z) <= one:
                i = min(np.int64((x + one) * half), side - 1)
                j = min(np.int64((y + one) * half), side - 1)
                k = min(np.int64((z + one) * half), side - 1)
                if occupied[i, j, k]:
                    inside = _opacity(cameras, pitch, cutting, px, py, pz, maps, shape, limits[0]) >= limits[1]
                    view = 0
                    while inside and view < total:
                        if _opacity(cameras, pitch, view, px, py, pz, maps, shape, limits[0]) < limits[1]:
                            inside, cutting = False, view
                        view += 1
                    if inside:
                        nearest[ray] = t
                        break
            place += 1
            t = first[ray] + number(place) * step
