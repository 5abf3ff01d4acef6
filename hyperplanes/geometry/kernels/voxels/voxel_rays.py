"""Loops over rays through a sparse voxel grid (numba only): pixels, and the gradient of their squared error.

Positions are in cells: cell (i, j, k) lies between the centres of voxels i and i + 1, and so on; the whole part of a
position is the index of its cell, the fraction the place between the voxel centres. `index` has the row of each voxel,
-1 where there is none, and none in its outermost voxels; `empty` has the chessboard distance from each cell to the
nearest that is not empty (`rendering.voxels.VoxelGrid`).
"""

from __future__ import annotations

import math
from typing import no_type_check

import numpy as np

from hyperplanes.geometry.kernels.lookup.blocks import inlined

__all__ = ["add_gradients", "render", "shade"]

MAX_SAMPLES = 1024  # samples of positive density on a ray whose gradient is computed
HARMONICS = 9
VALUES_PER_VOXEL = 1 + 3 * HARMONICS  # per voxel; loops of constant length are unrolled and vectorised


@inlined
@no_type_check
def _corner(index, cell_x, cell_y, cell_z, x, y, z, corner):
    """One of the eight voxels around a cell: its row or -1, and its trilinear weight.

    `x`, `y` and `z` are the fractions of a position in the cell.
    """
    one = np.float32(1.0)
    right, up, behind = corner >> 2, corner >> 1 & 1, corner & 1
    weight = (x if right else one - x) * (y if up else one - y) * (z if behind else one - z)
    return index[cell_x + right, cell_y + up, cell_z + behind], weight


@inlined
@no_type_check
def _inside(empty, origin, along, first, last, step):
    """The first sample of a ray in the box of all cells, and the t at which the ray leaves it; none if it misses."""
    enter, zero = first, np.float32(0.0)
    for axis in range(3):
        if along[axis] != zero:
            near, far = -origin[axis] / along[axis], (np.float32(empty.shape[axis]) - origin[axis]) / along[axis]
            enter, last = max(enter, min(near, far)), min(last, max(near, far))
        elif origin[axis] < zero or origin[axis] > np.float32(empty.shape[axis]):
            return 0, first
    if not enter <= last:  # for a ray nearly parallel to an axis, `enter` may not be finite
        return 0, first
    return int(math.ceil((enter - first) / step)), last


@inlined
@no_type_check
def _next_cell(empty, origin, along, first, last, step, per_cell, sample):
    """The first sample from `sample` on in a cell that is not empty.

    Returns:
        The index after it, its t, and its position; t is not below `last` where the ray ends first.
    """
    while True:
        t = first + np.float32(sample) * step
        x, y, z = origin[0] + t * along[0], origin[1] + t * along[1], origin[2] + t * along[2]
        if t >= last:
            return sample, t, x, y, z
        cell_x, cell_y, cell_z = int(math.floor(x)), int(math.floor(y)), int(math.floor(z))
        if min(cell_x, cell_y, cell_z) < 0:  # by rounding, where the ray enters or leaves the box
            sample += 1
            continue
        if cell_x >= empty.shape[0] or cell_y >= empty.shape[1] or cell_z >= empty.shape[2]:
            sample += 1
            continue
        # Empty-space skipping: all samples within the distance to the nearest filled cell.
        distance = empty[cell_x, cell_y, cell_z]
        if distance == 0:
            return sample + 1, t, x, y, z
        sample += 1 + int(np.float32(distance - 1) * per_cell)


@inlined
@no_type_check
def _next_sample(index, values, empty, origin, along, first, last, step, per_cell, sample, mixed):  # noqa: PLR0913
    """The first sample from `sample` on whose density is positive.

    Returns:
        The index after it; its position and density, which is zero where the ray ends first. `mixed` receives the
        interpolated coefficients, weighted by density.
    """
    zero = np.float32(0.0)
    while True:
        sample, t, x, y, z = _next_cell(empty, origin, along, first, last, step, per_cell, sample)
        if t >= last:
            return sample, x, y, z, zero
        # Trilinear interpolation of density, and of coefficients weighted by density.
        cell_x, cell_y, cell_z = int(math.floor(x)), int(math.floor(y)), int(math.floor(z))
        a, b, c = x - np.float32(cell_x), y - np.float32(cell_y), z - np.float32(cell_z)
        density = zero
        mixed[:] = zero
        for corner in range(8):
            row, weight = _corner(index, cell_x, cell_y, cell_z, a, b, c, corner)
            if row < 0:
                continue
            weight *= values[row, 0]
            density += weight
            for number in range(VALUES_PER_VOXEL):
                mixed[number] += weight * values[row, number]
        if density > zero:
            return sample, x, y, z, density


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
def _composite(transmittance, added, r, g, b, red, green, blue, opacity):  # noqa: PLR0913
    """The weight of a sample in its pixel, the transmittance behind it, and the sums including it (NeRF, Eq. 3)."""
    one, zero = np.float32(1.0), np.float32(0.0)
    behind = transmittance * math.exp(-added)
    weight = transmittance - behind
    red += weight * min(max(r, zero), one)
    green += weight * min(max(g, zero), one)
    blue += weight * min(max(b, zero), one)
    return weight, behind, red, green, blue, opacity + weight


@no_type_check
def shade(values, centres, eye, out, start, stop):
    """Density, and the colour times density towards an eye, of voxels start..stop into `out`.

    The spherical harmonics are those of `fields.baked.spherical_harmonics`.
    """
    for row in range(start, stop):
        x, y, z = centres[row, 0] - eye[0], centres[row, 1] - eye[1], centres[row, 2] - eye[2]
        scale = np.float32(1.0) / np.float32(math.sqrt(max(x * x + y * y + z * z, np.float32(1e-30))))
        x, y, z = x * scale, y * scale, z * scale
        basis = (
            np.float32(0.28209479),
            np.float32(-0.48860251) * y,
            np.float32(0.48860251) * z,
            np.float32(-0.48860251) * x,
            np.float32(1.09254843) * x * y,
            np.float32(-1.09254843) * y * z,
            np.float32(0.31539157) * (np.float32(3.0) * z * z - np.float32(1.0)),
            np.float32(-1.09254843) * x * z,
            np.float32(0.54627422) * (x * x - y * y),
        )
        density = values[row, 0]
        out[row, 0] = density
        for channel in range(3):
            colour = np.float32(0.0)
            for number in range(HARMONICS):
                colour += basis[number] * values[row, 1 + channel * HARMONICS + number]
            out[row, 1 + channel] = density * colour


@inlined
@no_type_check
def _interpolated(index, shaded, x, y, z):
    """Density at a position, and red, green and blue times density, trilinearly."""
    cell_x, cell_y, cell_z = int(math.floor(x)), int(math.floor(y)), int(math.floor(z))
    x, y, z = x - np.float32(cell_x), y - np.float32(cell_y), z - np.float32(cell_z)
    density = r = g = b = np.float32(0.0)
    for corner in range(8):
        # No branch for voxels without a row: -1 is the last row, of zeros.
        row, weight = _corner(index, cell_x, cell_y, cell_z, x, y, z, corner)
        density += weight * shaded[row, 0]
        r += weight * shaded[row, 1]
        g += weight * shaded[row, 2]
        b += weight * shaded[row, 3]
    return density, r, g, b


@no_type_check
def render(index, shaded, empty, origins, directions, near, far, step, stopped, background, out, start, stop):  # noqa: PLR0913
    """The pixels of rays start..stop through voxels from `shade`: (colour, opacity, depth) into `out`.

    Returns:
        The number of samples of positive density.
    """
    one, zero, half = np.float32(1.0), np.float32(0.0), np.float32(0.5)
    total = 0
    for ray in range(start, stop):
        origin = origins[ray, 0], origins[ray, 1], origins[ray, 2]
        along = directions[ray, 0], directions[ray, 1], directions[ray, 2]
        first, last = near[ray] + half * step, far[ray]
        per_cell = one / (max(abs(along[0]), abs(along[1]), abs(along[2])) * step)  # least number of samples in a cell
        transmittance, opacity, depth = one, zero, zero
        red, green, blue = zero, zero, zero
        sample, last = _inside(empty, origin, along, first, last, step)
        while transmittance > stopped:  # early ray termination
            sample, t, x, y, z = _next_cell(empty, origin, along, first, last, step, per_cell, sample)
            if t >= last:
                break
            density, r, g, b = _interpolated(index, shaded, x, y, z)
            if density <= zero:
                continue
            total += 1
            scale = one / density
            weight, transmittance, red, green, blue, opacity = _composite(
                transmittance, density * step, r * scale, g * scale, b * scale, red, green, blue, opacity
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
    index, values, empty, origins, directions, near, far, basis, pixels, step, stopped, background, truth, gradient,
    start, stop,
):  # fmt: skip
    """Adds the gradient of the squared errors of pixels start..stop to `gradient`; returns the sum of the errors.

    A pixel is the mean of the rays `pixels[i]` to `pixels[i + 1]`.
    """
    one, zero, half = np.float32(1.0), np.float32(0.0), np.float32(0.5)
    mixed = np.empty(VALUES_PER_VOXEL, np.float32)
    by_number = np.zeros(VALUES_PER_VOXEL, np.float32)  # gradient by a sample's interpolated numbers, but density
    most = 1  # rays of a pixel
    for pixel in range(start, stop):
        most = max(most, pixels[pixel + 1] - pixels[pixel])
    counts, behind = np.empty(most, np.int64), np.empty(most, np.float32)  # samples, and transmittance behind the last
    places = np.empty((most, MAX_SAMPLES, 3), np.float32)
    densities, before = np.empty((most, MAX_SAMPLES), np.float32), np.empty((most, MAX_SAMPLES), np.float32)
    colours = np.empty((most, MAX_SAMPLES, 3), np.float32)  # before they are clamped
    total = 0.0
    for pixel in range(start, stop):
        first_ray, rays = pixels[pixel], pixels[pixel + 1] - pixels[pixel]
        red, green, blue = zero, zero, zero
        # Forward, as `render`; the samples are kept.
        for place in range(rays):
            ray = first_ray + place
            origin = origins[ray, 0], origins[ray, 1], origins[ray, 2]
            along = directions[ray, 0], directions[ray, 1], directions[ray, 2]
            first, last = near[ray] + half * step, far[ray]
            per_cell = one / (max(abs(along[0]), abs(along[1]), abs(along[2])) * step)
            transmittance, opacity = one, zero
            sample, last = _inside(empty, origin, along, first, last, step)
            count = 0
            while transmittance > stopped and count < MAX_SAMPLES:
                sample, x, y, z, density = _next_sample(
                    index, values, empty, origin, along, first, last, step, per_cell, sample, mixed
                )
                if density <= zero:
                    break
                r, g, b = _colour(basis, ray, mixed, density)
                places[place, count, 0], places[place, count, 1], places[place, count, 2] = x, y, z
                colours[place, count, 0], colours[place, count, 1], colours[place, count, 2] = r, g, b
                densities[place, count] = density
                before[place, count] = transmittance
                _, transmittance, red, green, blue, opacity = _composite(
                    transmittance, density * step, r, g, b, red, green, blue, opacity
                )
                count += 1
            counts[place], behind[place] = count, transmittance
            shown = (one - opacity) * background
            red, green, blue = red + shown, green + shown, blue + shown
        # The error of their mean, and the derivative of its square with respect to each ray.
        share = one / np.float32(rays)
        wrong_r, wrong_g, wrong_b = (
            red * share - truth[pixel, 0],
            green * share - truth[pixel, 1],
            blue * share - truth[pixel, 2],
        )
        total += wrong_r * wrong_r + wrong_g * wrong_g + wrong_b * wrong_b
        share *= np.float32(2.0)
        wrong_r, wrong_g, wrong_b = share * wrong_r, share * wrong_g, share * wrong_b
        # Backward, from the last sample to the first; `behind_it` is what the samples behind contribute.
        for place in range(rays):
            ray, transmittance, behind_it = first_ray + place, behind[place], zero
            for kept in range(counts[place] - 1, -1, -1):
                density = densities[place, kept]
                weight = before[place, kept] - transmittance
                r, g, b = colours[place, kept, 0], colours[place, kept, 1], colours[place, kept, 2]
                shown = (
                    wrong_r * (min(max(r, zero), one) - background)
                    + wrong_g * (min(max(g, zero), one) - background)
                    + wrong_b * (min(max(b, zero), one) - background)
                )
                by_density = step * (transmittance * shown - behind_it)
                transmittance = before[place, kept]
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
                # The contribution of each surrounding voxel to density and colour.
                x, y, z = places[place, kept, 0], places[place, kept, 1], places[place, kept, 2]
                cell_x, cell_y, cell_z = int(math.floor(x)), int(math.floor(y)), int(math.floor(z))
                x, y, z = x - np.float32(cell_x), y - np.float32(cell_y), z - np.float32(cell_z)
                for corner in range(8):
                    row, at_corner = _corner(index, cell_x, cell_y, cell_z, x, y, z, corner)
                    if row < 0:
                        continue
                    own_share, own = at_corner * values[row, 0] / density, zero
                    for number in range(VALUES_PER_VOXEL):
                        own += by_number[number] * values[row, number]
                        gradient[row, number] += own_share * by_number[number]
                    gradient[row, 0] += at_corner * (by_density + (own - mean) / density)
    return total
