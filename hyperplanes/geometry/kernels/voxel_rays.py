"""Loops over rays through a sparse voxel grid (numba only): their pixels, and the gradient of a squared error of these.

Positions are in cells: cell (i, j, k) lies between the centres of voxels i - 1 and i, and so on; the whole part of a
position is the index of its cell, the fraction the place between the voxel centres.
"""

from __future__ import annotations

import math
from typing import no_type_check

import numpy as np

from hyperplanes.geometry.kernels.blocks import inlined

__all__ = ["add_gradients", "render"]

MAX_SAMPLES = 1024  # of positive density on a ray whose gradient is computed
HARMONICS = 9
NUMBERS = 1 + 3 * HARMONICS  # of a voxel: loops of a constant length are unrolled and vectorised


@inlined
@no_type_check
def _corner(index, cell_x, cell_y, cell_z, x, y, z, corner):
    """One of the eight voxels around a cell: its row or -1, and its trilinear weight.

    `x`, `y` and `z` are the fractions of a position in the cell.
    """
    one = np.float32(1.0)
    right, up, behind = corner >> 2, corner >> 1 & 1, corner & 1
    at_x, at_y, at_z = cell_x + right - 1, cell_y + up - 1, cell_z + behind - 1
    if min(at_x, at_y, at_z) < 0 or max(at_x, at_y, at_z) >= index.shape[0]:
        return -1, np.float32(0.0)
    weight = (x if right else one - x) * (y if up else one - y) * (z if behind else one - z)
    return index[at_x, at_y, at_z], weight


@inlined
@no_type_check
def _next_sample(index, values, empty, origin, along, first, last, step, per_cell, sample, mixed):  # noqa: PLR0913
    """The first sample from `sample` on whose density is positive.

    Returns:
        The sample after it; its t, position and density, which is zero where the ray ends first. `mixed` receives the
        interpolated coefficients, weighted by density.
    """
    side, zero = empty.shape[0], np.float32(0.0)
    while True:
        t = first + np.float32(sample) * step
        if t >= last:
            return sample, t, zero, zero, zero, zero
        x, y, z = origin[0] + t * along[0], origin[1] + t * along[1], origin[2] + t * along[2]
        # The cell that the sample lies in.
        cell_x, cell_y, cell_z = int(math.floor(x)), int(math.floor(y)), int(math.floor(z))
        if min(cell_x, cell_y, cell_z) < 0 or max(cell_x, cell_y, cell_z) >= side:
            sample += 1
            continue
        # Empty-space skipping: all samples within the distance to the nearest filled cell.
        distance = empty[cell_x, cell_y, cell_z]
        if distance > 0:
            sample += 1 + int(np.float32(distance - 1) * per_cell)
            continue
        sample += 1
        # Trilinear interpolation of density, and of coefficients weighted by density.
        a, b, c = x - np.float32(cell_x), y - np.float32(cell_y), z - np.float32(cell_z)
        density = zero
        mixed[:] = zero
        for corner in range(8):
            row, weight = _corner(index, cell_x, cell_y, cell_z, a, b, c, corner)
            if row < 0:
                continue
            weight *= values[row, 0]
            density += weight
            for number in range(NUMBERS):
                mixed[number] += weight * values[row, number]
        if density > zero:
            return sample, t, x, y, z, density


@inlined
@no_type_check
def _colour(basis, ray, mixed, density):
    """Red, green and blue of a sample, before they are clamped: the spherical harmonics of the ray's direction."""
    r = g = b = np.float32(0.0)
    for number in range(HARMONICS):
        r += basis[ray, number] * mixed[1 + number]
        g += basis[ray, number] * mixed[1 + HARMONICS + number]
        b += basis[ray, number] * mixed[1 + 2 * HARMONICS + number]
    return r / density, g / density, b / density


@inlined
@no_type_check
def _composite(optical_depth, added, r, g, b, red, green, blue, opacity):  # noqa: PLR0913
    """The weight of a sample in its pixel, and the sums up to it (NeRF, Eq. 3)."""
    one, zero = np.float32(1.0), np.float32(0.0)
    weight = math.exp(-optical_depth) * (one - math.exp(-added))
    red += weight * min(max(r, zero), one)
    green += weight * min(max(g, zero), one)
    blue += weight * min(max(b, zero), one)
    return weight, optical_depth + added, red, green, blue, opacity + weight


@no_type_check
def render(index, values, empty, origins, directions, near, far, basis, step, limit, background, out, start, stop):  # noqa: PLR0913
    """The pixels of rays start..stop: (colour, opacity, depth) into `out`.

    Returns:
        The samples of positive density.
    """
    one, zero, half = np.float32(1.0), np.float32(0.0), np.float32(0.5)
    mixed = np.empty(NUMBERS, np.float32)
    total = 0
    for ray in range(start, stop):
        origin = origins[ray, 0], origins[ray, 1], origins[ray, 2]
        along = directions[ray, 0], directions[ray, 1], directions[ray, 2]
        first, last = near[ray] + half * step, far[ray]
        per_cell = one / (max(abs(along[0]), abs(along[1]), abs(along[2])) * step)  # least number of samples in a cell
        optical_depth, opacity, depth = zero, zero, zero
        red, green, blue = zero, zero, zero
        sample = 0
        while optical_depth < limit:  # early ray termination
            sample, t, _, _, _, density = _next_sample(
                index, values, empty, origin, along, first, last, step, per_cell, sample, mixed
            )
            if density <= zero:
                break
            total += 1
            r, g, b = _colour(basis, ray, mixed, density)
            weight, optical_depth, red, green, blue, opacity = _composite(
                optical_depth, density * step, r, g, b, red, green, blue, opacity
            )
            depth += weight * t
        out[ray, 0] = red + (one - opacity) * background
        out[ray, 1] = green + (one - opacity) * background
        out[ray, 2] = blue + (one - opacity) * background
        out[ray, 3] = opacity
        out[ray, 4] = depth / max(opacity, np.float32(1e-10))
    return total


@no_type_check
def add_gradients(  # noqa: PLR0913
    index, values, empty, origins, directions, near, far, basis, step, limit, background, truth, gradient, start, stop
):
    """Adds the gradient of the squared errors of rays start..stop to `gradient`; returns the sum of the errors."""
    one, zero, half = np.float32(1.0), np.float32(0.0), np.float32(0.5)
    mixed = np.empty(NUMBERS, np.float32)
    by_number = np.zeros(NUMBERS, np.float32)  # of a sample, by its interpolated numbers; density has its own way
    places = np.empty((MAX_SAMPLES, 3), np.float32)
    densities = np.empty(MAX_SAMPLES, np.float32)
    colours = np.empty((MAX_SAMPLES, 3), np.float32)  # before they are clamped
    total = 0.0
    for ray in range(start, stop):
        origin = origins[ray, 0], origins[ray, 1], origins[ray, 2]
        along = directions[ray, 0], directions[ray, 1], directions[ray, 2]
        first, last = near[ray] + half * step, far[ray]
        per_cell = one / (max(abs(along[0]), abs(along[1]), abs(along[2])) * step)
        optical_depth, opacity = zero, zero
        red, green, blue = zero, zero, zero
        sample, count = 0, 0
        # Forward, as `render`; the samples are kept.
        while optical_depth < limit and count < MAX_SAMPLES:
            sample, _, x, y, z, density = _next_sample(
                index, values, empty, origin, along, first, last, step, per_cell, sample, mixed
            )
            if density <= zero:
                break
            r, g, b = _colour(basis, ray, mixed, density)
            places[count, 0], places[count, 1], places[count, 2] = x, y, z
            colours[count, 0], colours[count, 1], colours[count, 2] = r, g, b
            densities[count] = density
            _, optical_depth, red, green, blue, opacity = _composite(
                optical_depth, density * step, r, g, b, red, green, blue, opacity
            )
            count += 1
        # Twice the difference from the truth.
        wrong_r = np.float32(2.0) * (red + (one - opacity) * background - truth[ray, 0])
        wrong_g = np.float32(2.0) * (green + (one - opacity) * background - truth[ray, 1])
        wrong_b = np.float32(2.0) * (blue + (one - opacity) * background - truth[ray, 2])
        total += 0.25 * (wrong_r * wrong_r + wrong_g * wrong_g + wrong_b * wrong_b)
        # Backward, from the last sample to the first; `behind_it` is what the samples behind contribute.
        behind_it = zero
        for kept in range(count - 1, -1, -1):
            density = densities[kept]
            added = density * step
            optical_depth -= added
            before = math.exp(-optical_depth)
            after = before * math.exp(-added)
            weight = before - after
            r, g, b = colours[kept, 0], colours[kept, 1], colours[kept, 2]
            shown = (
                wrong_r * (min(max(r, zero), one) - background)
                + wrong_g * (min(max(g, zero), one) - background)
                + wrong_b * (min(max(b, zero), one) - background)
            )
            by_density = step * (after * shown - behind_it)
            behind_it += weight * shown
            by_red = weight * wrong_r if zero < r < one else zero
            by_green = weight * wrong_g if zero < g < one else zero
            by_blue = weight * wrong_b if zero < b < one else zero
            for number in range(HARMONICS):
                of_basis = basis[ray, number]
                by_number[1 + number] = of_basis * by_red
                by_number[1 + HARMONICS + number] = of_basis * by_green
                by_number[1 + 2 * HARMONICS + number] = of_basis * by_blue
            mean = by_red * r + by_green * g + by_blue * b
            # The share of each voxel around the sample in its density and its colour.
            x, y, z = places[kept, 0], places[kept, 1], places[kept, 2]
            cell_x, cell_y, cell_z = int(math.floor(x)), int(math.floor(y)), int(math.floor(z))
            x, y, z = x - np.float32(cell_x), y - np.float32(cell_y), z - np.float32(cell_z)
            for corner in range(8):
                row, at_corner = _corner(index, cell_x, cell_y, cell_z, x, y, z, corner)
                if row < 0:
                    continue
                share, own = at_corner * values[row, 0] / density, zero
                for number in range(NUMBERS):
                    own += by_number[number] * values[row, number]
                    gradient[row, number] += share * by_number[number]
                gradient[row, 0] += at_corner * (by_density + (own - mean) / density)
    return total
