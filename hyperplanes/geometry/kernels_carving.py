"""The CPU kernel of the visual hull: one voxel after the other, until a mask rules it out."""

from __future__ import annotations

from typing import no_type_check

__all__ = ["carve"]


@no_type_check
def carve(matrices, calibrations, tables, corner, voxel, radius, nearest, occupied, start, stop):
    """Clears the voxels in layers start..stop of `occupied` that `occupancy.carve` describes as ruled out.

    `tables` (view, row + 1, column + 1) count the set pixels above and left; `corner` is where voxel (0, 0, 0) starts.
    """
    planes, height, width = tables.shape[0], tables.shape[1] - 1, tables.shape[2] - 1
    for i in range(start, stop):
        x = corner[0] + (i + 0.5) * voxel
        for j in range(occupied.shape[1]):
            y = corner[1] + (j + 0.5) * voxel
            for k in range(occupied.shape[2]):
                z = corner[2] + (k + 0.5) * voxel
                for view in range(planes):
                    m, c = matrices[view], calibrations[view]
                    depth = m[2, 0] * x + m[2, 1] * y + m[2, 2] * z + m[2, 3]
                    if depth <= nearest:
                        continue
                    u = (m[0, 0] * x + m[0, 1] * y + m[0, 2] * z + m[0, 3]) / depth
                    v = (m[1, 0] * x + m[1, 1] * y + m[1, 2] * z + m[1, 3]) / depth
                    down = (v - c[1, 2]) / c[1, 1]
                    across = (u - c[0, 2] - c[0, 1] * down) / c[0, 0]
                    share = radius / (depth - radius)
                    reach_down = share * (1 + down * down) ** 0.5
                    reach_across = share * (1 + across * across) ** 0.5
                    reach_u = c[0, 0] * reach_across + abs(c[0, 1]) * reach_down + 0.5
                    reach_v = c[1, 1] * reach_down + 0.5
                    left, right = u - reach_u, u + reach_u
                    top, bottom = v - reach_v, v + reach_v
                    if not (left >= -0.5 and top >= -0.5 and right <= width - 0.5 and bottom <= height - 0.5):
                        continue
                    first, last = int(left + 0.5), min(int(right + 0.5), width - 1) + 1
                    upper, lower = int(top + 0.5), min(int(bottom + 0.5), height - 1) + 1
                    table = tables[view]
                    if table[lower, last] - table[lower, first] - table[upper, last] + table[upper, first] == 0:
                        occupied[i, j, k] = 0
                        break
