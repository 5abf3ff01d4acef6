"""The CPU kernel of `sampling.marching.march`: every ray steps through the grid and records samples in voxels."""

from __future__ import annotations

from typing import no_type_check

import numpy as np

from hyperplanes.geometry.kernels.voxels.boxes import samples_within

__all__ = ["march"]


@no_type_check
def march(origins, directions, first, far, step, sphere, box, occupied, ray, distances, found, start, stop):
    """Writes the samples of rays start..stop in occupied voxels, ray after ray, and their number into found[0].

    Samples lie at first + i step, before far. `sphere` is the centre and the radius of the scene, `box` the corners
    around its occupied voxels. `ray` gets the index of the ray of each sample, `distances` its distance; samples for
    which they have no room are left out.
    """
    number = first.dtype.type
    side, half, one = occupied.shape[0], number(occupied.shape[0]) / number(2), number(1)
    count = 0
    for index in range(start, stop):
        place, end = samples_within(origins, directions, first, far, index, step, box)
        t = first[index] + number(place) * step
        while t < end and count < len(ray):
            # the sample in the cube around the unit sphere
            x = (origins[index, 0] + t * directions[index, 0] - sphere[0]) / sphere[3]
            y = (origins[index, 1] + t * directions[index, 1] - sphere[1]) / sphere[3]
            z = (origins[index, 2] + t * directions[index, 2] - sphere[2]) / sphere[3]
            if abs(x) <= one and abs(y) <= one and abs(z) <= one:
                i = min(np.int64((x + one) * half), side - 1)
                j = min(np.int64((y + one) * half), side - 1)
                k = min(np.int64((z + one) * half), side - 1)
                if occupied[i, j, k]:
                    ray[count], distances[count] = index, t
                    count += 1
            place += 1
            t = first[index] + number(place) * step
    found[0] = count
