"""The CPU kernel of `visibility.first_hits`: each pixel's ray steps through the grid until a voxel is occupied."""

from __future__ import annotations

from typing import no_type_check

import numpy as np

from hyperplanes.geometry.kernels.lookup.blocks import inlined
from hyperplanes.geometry.kernels.voxels.boxes import samples_within

__all__ = ["first_hits"]


@inlined
@no_type_check
def _direction(lens, rotation, u, v):
    """The unit vector along the ray of a pixel, in the world."""
    down = (v - lens[3]) / lens[1]
    across = (u - lens[2] - lens[4] * down) / lens[0]
    x = across * rotation[0] + down * rotation[3] + rotation[6]
    y = across * rotation[1] + down * rotation[4] + rotation[7]
    z = across * rotation[2] + down * rotation[5] + rotation[8]
    length = np.sqrt(x * x + y * y + z * z)
    return x / length, y / length, z / length


@no_type_check
def first_hits(cameras, pixels, opacity, sphere, step, box, occupied, distances, start, stop):
    """Writes the distances of the first samples in an occupied voxel into `distances` (view, row, column).

    That is done in rows start..stop, counted through all views, for pixels of `opacity` above 0. Samples lie at
    near + (i + 1/2) step, before far, which is written where none is in a voxel; near and far are those of `rays.cast`.
    `cameras` are the centre, the rotation from the world row by row, and focal lengths, principal point and skew of
    each; `pixels` (view, row, column, 2) the undistorted pixels, empty without distortion; `sphere` the centre and the
    radius of the scene, `box` the corners around its occupied voxels.
    """
    number = cameras.dtype.type
    zero, half, side, radius = number(0), number(0.5), number(occupied.shape[0]), sphere[3]
    per_unit, height = side / (radius + radius), distances.shape[1]
    origins, directions = np.empty((1, 3), cameras.dtype), np.empty((1, 3), cameras.dtype)
    first, ends = np.empty(1, cameras.dtype), np.empty(1, cameras.dtype)
    for line in range(start, stop):
        view, row = line // height, line % height
        centre, rotation, lens = cameras[view, :3], cameras[view, 3:12], cameras[view, 12:]
        a, b, c = sphere[0] - centre[0], sphere[1] - centre[1], sphere[2] - centre[2]
        origins[0] = centre
        for column in range(distances.shape[2]):
            if not opacity[view, row, column] > zero:
                continue
            u, v = number(column), number(row)
            if len(pixels):
                u, v = pixels[view, row, column, 0], pixels[view, row, column, 1]
            x, y, z = _direction(lens, rotation, u, v)
            # where the ray enters the sphere and leaves it
            middle = a * x + b * y + c * z
            e, f, g = a - middle * x, b - middle * y, c - middle * z
            chord = np.sqrt(max(radius * radius - (e * e + f * f + g * g), zero))
            far = max(middle + chord, zero)
            first[0], ends[0] = max(middle - chord, zero) + half * step, far
            directions[0, 0], directions[0, 1], directions[0, 2] = x, y, z
            sample, end = samples_within(origins, directions, first, ends, 0, step, box)
            t, found = first[0] + number(sample) * step, far
            while t < end:
                # the sample in voxels
                i, j, k = (
                    (radius + t * x - a) * per_unit,
                    (radius + t * y - b) * per_unit,
                    (radius + t * z - c) * per_unit,
                )
                if i >= zero and j >= zero and k >= zero and i < side and j < side and k < side:
                    if occupied[np.int64(i), np.int64(j), np.int64(k)]:
                        found = t
                        break
                sample += 1
                t = first[0] + number(sample) * step
            distances[view, row, column] = found
