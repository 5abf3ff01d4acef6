"""The CPU kernel of `rendering.footprint`: the pixels of a view around the projections of points."""

from __future__ import annotations

from typing import no_type_check

import numpy as np

__all__ = ["footprints"]


@no_type_check
def footprints(points, matrices, calibrations, radius, nearest, seen, start, stop):
    """Sets the pixels of views start..stop of `seen` (view, row, column) whose rays may cross a ball around a point.

    Each centre's pixel is spread by the largest box around a ball that meets the picture (`occupancy.ball_extent`). All
    pixels are set where a point has z below `nearest`, or where that box is larger than the picture.
    """
    number = points.dtype.type
    zero, one = number(0), number(1)
    height, width = seen.shape[1], seen.shape[2]
    places = np.empty((len(points), 2), np.int64)
    for view in range(start, stop):
        m, k = matrices[view], calibrations[view]
        right, bottom = number(width - 1), number(height - 1)
        near, widest, highest, count = False, -one, -one, 0
        for i in range(len(points)):
            # where the centre projects to, and half the sides of the box around the ball
            x, y, depth = points[i, 0], points[i, 1], points[i, 2]
            z = m[2, 0] * x + m[2, 1] * y + m[2, 2] * depth + m[2, 3]
            if z < nearest:
                near = True
                break
            u = (m[0, 0] * x + m[0, 1] * y + m[0, 2] * depth + m[0, 3]) / z
            v = (m[1, 0] * x + m[1, 1] * y + m[1, 2] * depth + m[1, 3]) / z
            down = (v - k[1, 2]) / k[1, 1]
            across = (u - k[0, 2] - k[0, 1] * down) / k[0, 0]
            slope = radius / (z - radius)
            down, across = slope * np.sqrt(one + down * down), slope * np.sqrt(one + across * across)
            extent_u = abs(k[0, 0]) * across + abs(k[0, 1]) * down
            extent_v = abs(k[1, 0]) * across + abs(k[1, 1]) * down
            if not (u + extent_u >= zero and v + extent_v >= zero and u - extent_u <= right and v - extent_v <= bottom):
                continue
            widest, highest = max(widest, extent_u), max(highest, extent_v)
            places[count, 0], places[count, 1] = np.int64(np.rint(u)), np.int64(np.rint(v))
            count += 1
        across, down = np.int64(widest + number(0.51)), np.int64(highest + number(0.51))
        if near or (count and (across > width or down > height)):
            seen[view] = True
            continue
        # number of centres in each pixel of a picture padded by these, as a summed-area table
        sums = np.zeros((height + 2 * down + 1, width + 2 * across + 1), np.int32)
        for i in range(count):
            sums[places[i, 1] + down + 1, places[i, 0] + across + 1] += 1
        for row in range(1, sums.shape[0]):
            for column in range(1, sums.shape[1]):
                sums[row, column] += sums[row, column - 1]
            for column in range(1, sums.shape[1]):
                sums[row, column] += sums[row - 1, column]
        for row in range(height):
            upper, lower = sums[row], sums[row + 2 * down + 1]
            for column in range(width):
                last = column + 2 * across + 1
                seen[view, row, column] = lower[last] - lower[column] - upper[last] + upper[column] > 0
