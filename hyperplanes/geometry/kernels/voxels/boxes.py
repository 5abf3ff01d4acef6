"""Which samples of a ray may lie in the box around all occupied voxels, which is often far smaller than the scene."""

from __future__ import annotations

from typing import no_type_check

import numpy as np

from hyperplanes.geometry.kernels.lookup.blocks import inlined

__all__ = ["samples_within"]


@inlined
@no_type_check
def samples_within(origins, directions, first, far, ray, step, box):
    """The index of a sample of a ray before the box, and the distance at which the ray leaves it, at most far.

    Samples lie at first + i step. `box` are the lower and the upper corner, in the world (`Occupancy.box`).
    """
    enters, leaves = first[ray], far[ray]
    for axis in range(3):
        low, high = box[axis] - origins[ray, axis], box[3 + axis] - origins[ray, axis]
        slope = directions[ray, axis]
        if slope != 0:
            enters = max(enters, min(low / slope, high / slope))
            leaves = min(leaves, max(low / slope, high / slope))
        elif low > 0 or high < 0:  # it misses the box
            leaves = first[ray]
    if not enters <= far[ray]:  # beyond the end of the ray, or NaN
        enters = far[ray]
    return np.int64(max(enters - first[ray], first.dtype.type(0)) / step), min(leaves, far[ray])
