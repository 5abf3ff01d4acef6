"""The CPU kernel of `visibility.hull_hits.centres_in_hull`: LANES voxels along z at once, as in `carving.carve`."""

from __future__ import annotations

from typing import no_type_check

import numpy as np

from hyperplanes.geometry.kernels.hull.carving import LANES, fill_lanes
from hyperplanes.geometry.kernels.llvm import load, read, store
from hyperplanes.geometry.kernels.lookup.blocks import inlined
from hyperplanes.geometry.lookup_torch import BORDER_TOLERANCE

__all__ = ["centres"]


@inlined
@no_type_check
def _judge(inside, cameras, view, maps, shape, x, y, bottom, voxel, min_z, opacity):
    """Clears the lanes of `inside` whose centre one view shows with too little opacity; returns how many remain."""
    number = inside.dtype.type
    zero, half, one = number(0), number(0.5), number(1)
    height, width, pitch = np.int32(shape[1]), np.int32(shape[2]), shape[3]
    low, right, lowest = (
        number(-BORDER_TOLERANCE),
        number(width - 1 + BORDER_TOLERANCE),
        number(height - 1 + BORDER_TOLERANCE),
    )
    last_column, last_row = number(width - 1), number(height - 1)
    left_most, top_most = number(max(width - 2, 0)), number(max(height - 2, 0))
    next_column, next_row = np.int32(2 * min(width - 1, 1)), np.int32(2 * width * min(height - 1, 1))
    m = 3 * pitch + view
    u0 = cameras[m] * x + cameras[m + pitch] * y + cameras[m + 3 * pitch]
    v0 = cameras[m + 4 * pitch] * x + cameras[m + 5 * pitch] * y + cameras[m + 7 * pitch]
    z0 = cameras[m + 8 * pitch] * x + cameras[m + 9 * pitch] * y + cameras[m + 11 * pitch]
    u1, v1, z1 = cameras[m + 2 * pitch], cameras[m + 6 * pitch], cameras[m + 10 * pitch]
    visible, first, left_over = cameras[15 * pitch + view] > zero, 2 * np.int64(view) * height * width + 1, zero
    for k in range(LANES):
        # projection of the centre
        z = bottom + (number(np.int32(k)) + half) * voxel
        camera_z = z0 + z1 * z
        front = visible & (camera_z > min_z)
        camera_z = camera_z if front else one
        u, v = (u0 + u1 * z) / camera_z, (v0 + v1 * z) / camera_z
        shown = front & (u >= low) & (u <= right) & (v >= low) & (v <= lowest)
        u, v = u if shown else zero, v if shown else zero
        u, v = min(max(u, zero), last_column), min(max(v, zero), last_row)
        # opacity of the mask there, bilinear
        column, row = np.int32(min(u, left_most)), np.int32(min(v, top_most))
        across, down = u - number(column), v - number(row)
        at = np.int32(2 * (row * width + column))
        below = np.int32(at + next_row)
        a, b = read(maps, first, at), read(maps, first, below)
        a = a + across * (read(maps, first, np.int32(at + next_column)) - a)
        b = b + across * (read(maps, first, np.int32(below + next_column)) - b)
        kept = load(inside, k)
        kept = zero if shown & (a + down * (b - a) < opacity) else kept
        store(inside, k, kept)
        left_over += kept
    return left_over


@no_type_check
def centres(cameras, maps, shape, corner, voxel, limits, occupied, start, stop):
    """Clears the voxels in layers start..stop of `occupied` whose centre some view shows with too little opacity.

    `cameras` and `maps` are those of `choosing.choose`, `shape` the number of views, height, width and the pitch of
    `cameras`; `limits` are min_z and the opacity, `corner` is where voxel (0, 0, 0) starts.
    """
    inside, half, last = np.empty(LANES, corner.dtype), corner.dtype.type(0.5), 0
    least_z, opacity = limits[0], limits[1]
    for i in range(start, stop):
        x = corner[0] + (corner.dtype.type(i) + half) * voxel
        for j in range(occupied.shape[1]):
            y = corner[1] + (corner.dtype.type(j) + half) * voxel
            for begin in range(0, occupied.shape[2], LANES):
                count = min(LANES, occupied.shape[2] - begin)
                bottom = corner[2] + corner.dtype.type(begin) * voxel
                if fill_lanes(inside, occupied, i, j, begin, count, 1) == 0:
                    continue
                for turn in range(shape[0]):  # the view that cleared the last voxels often clears the next ones
                    view = last + turn if last + turn < shape[0] else last + turn - shape[0]
                    if _judge(inside, cameras, view, maps, shape, x, y, bottom, voxel, least_z, opacity) == 0:
                        last = view
                        break
                for k in range(count):
                    occupied[i, j, begin + k] = np.uint8(inside[k] > 0)
