"""Gradients of a squared error with respect to the numbers of a sparse voxel grid, compiled for the CPU by numba."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import no_type_check

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from hyperplanes.geometry.kernels.compiling import compile_function
from hyperplanes.geometry.kernels.threads import parallel_for
from hyperplanes.geometry.rays import Rays, Sphere

__all__ = ["compiled_gradients", "voxel_gradients"]

LONGEST = 1024  # samples of positive density on a ray


def compiled_gradients() -> Callable[..., float] | None:
    """The compiled loop over rays, or None where numba is missing."""
    return compile_function(_gradients)


def voxel_gradients(
    index: Int[Tensor, "x y z"],
    values: Float[Tensor, "row 28"],
    bounds: Sphere,
    rays: Rays,
    basis: Float[Tensor, "ray 9"],
    truth: Float[Tensor, "ray 3"],
    *,
    step: float,
    empty: UInt8[Tensor, "cell_x cell_y cell_z"],
    stop: float = 1e-3,
    background: float = 1.0,
) -> tuple[float, Float[Tensor, "row 28"]]:
    """The mean squared error of the pixels of `render_voxels`, and its gradient with respect to `values`.

    Args:
        index: row of every voxel or -1.
        values: density and 3 x 9 coefficients of every row.
        bounds: the sphere inside the cube of voxels.
        rays: with near and far.
        basis: spherical harmonics of every ray's direction.
        truth: what the pixels should be.
        step: distance between samples in world units.
        empty: the result of `distance_to_filled`.
        stop: transmittance below which a ray is finished.
        background: grey value behind everything.

    Returns:
        The error, and its gradient.

    Raises:
        RuntimeError: numba is missing; `compiled_gradients` says so beforehand.
    """
    kernel = compiled_gradients()
    if kernel is None:
        raise RuntimeError("voxel_gradients: expected numba, found none; pip install numba")
    scale = index.shape[0] / (2 * bounds.radius)
    corner = torch.tensor(bounds.centre) - bounds.radius
    chunk = max(1, -(-len(rays) // torch.get_num_threads()))  # one a thread, each with a gradient of its own
    found = torch.zeros(-(-len(rays) // chunk), *values.shape)
    arrays = (
        index.numpy(),
        values.numpy(),
        empty.numpy(),
        ((rays.origins.float() - corner) * scale + 0.5).contiguous().numpy(),
        (rays.directions.float() * scale).contiguous().numpy(),
        rays.near.float().numpy(),
        rays.far.float().numpy(),
        basis.contiguous().numpy(),
        truth.float().contiguous().numpy(),
    )
    numbers = (np.float32(step), np.float32(-math.log(stop)), np.float32(background))

    def work(first: int, last: int) -> float:
        return kernel(*arrays, *numbers, found[first // chunk].numpy(), first, last)

    error = sum(parallel_for(work, len(rays), chunk))
    return error / (3 * len(rays)), found.sum(0) / (3 * len(rays)) if len(found) > 1 else found[0] / (3 * len(rays))


@no_type_check
def _gradients(  # noqa: PLR0913
    index, values, empty, origins, directions, near, far, basis, truth, step, limit, background, gradient, start, stop
):
    """Adds the gradient of the squared errors of rays start..stop to `gradient`; returns the sum of the errors."""
    side, harmonics = empty.shape[0], basis.shape[1]
    one, zero, half = np.float32(1.0), np.float32(0.0), np.float32(0.5)
    mixed = np.empty(values.shape[1], np.float32)
    places = np.empty((LONGEST, 3), np.float32)
    densities = np.empty(LONGEST, np.float32)
    colours = np.empty((LONGEST, 3), np.float32)  # before they are clamped
    total = 0.0
    for ray in range(start, stop):
        origin_x, origin_y, origin_z = origins[ray, 0], origins[ray, 1], origins[ray, 2]
        along_x, along_y, along_z = directions[ray, 0], directions[ray, 1], directions[ray, 2]
        first, last = near[ray] + half * step, far[ray]
        per_cell = one / (max(abs(along_x), abs(along_y), abs(along_z)) * step)
        optical_depth, opacity = zero, zero
        red, green, blue = zero, zero, zero
        sample, count = 0, 0
        # Forward, as `render_voxels`; the samples of positive density are kept.
        while optical_depth < limit and count < LONGEST:
            t = first + np.float32(sample) * step
            if t >= last:
                break
            x, y, z = origin_x + t * along_x, origin_y + t * along_y, origin_z + t * along_z
            low_x, low_y, low_z = int(math.floor(x)), int(math.floor(y)), int(math.floor(z))
            if min(low_x, low_y, low_z) < 0 or max(low_x, low_y, low_z) >= side:
                sample += 1
                continue
            distance = empty[low_x, low_y, low_z]
            if distance > 0:
                sample += 1 + int(np.float32(distance - 1) * per_cell)
                continue
            sample += 1
            places[count, 0], places[count, 1], places[count, 2] = x, y, z
            x, y, z = x - np.float32(low_x), y - np.float32(low_y), z - np.float32(low_z)
            density = zero
            mixed[:] = zero
            for corner in range(8):
                right, up, behind = corner >> 2, corner >> 1 & 1, corner & 1
                at_x, at_y, at_z = low_x + right - 1, low_y + up - 1, low_z + behind - 1
                if min(at_x, at_y, at_z) < 0 or max(at_x, at_y, at_z) >= side - 1:
                    continue
                row = index[at_x, at_y, at_z]
                if row < 0:
                    continue
                at_corner = (x if right else one - x) * (y if up else one - y) * (z if behind else one - z)
                at_corner *= values[row, 0]
                density += at_corner
                for number in range(mixed.shape[0]):
                    mixed[number] += at_corner * values[row, number]
            if density <= zero:
                continue
            r, g, b = zero, zero, zero
            for number in range(harmonics):
                r += basis[ray, number] * mixed[1 + number]
                g += basis[ray, number] * mixed[1 + harmonics + number]
                b += basis[ray, number] * mixed[1 + 2 * harmonics + number]
            colours[count, 0], colours[count, 1], colours[count, 2] = r / density, g / density, b / density
            densities[count] = density
            added = density * step
            weight = math.exp(-optical_depth) * (one - math.exp(-added))
            optical_depth += added
            red += weight * min(max(r / density, zero), one)
            green += weight * min(max(g / density, zero), one)
            blue += weight * min(max(b / density, zero), one)
            opacity += weight
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
            x, y, z = places[kept, 0], places[kept, 1], places[kept, 2]
            low_x, low_y, low_z = int(math.floor(x)), int(math.floor(y)), int(math.floor(z))
            x, y, z = x - np.float32(low_x), y - np.float32(low_y), z - np.float32(low_z)
            for corner in range(8):
                right, up, behind = corner >> 2, corner >> 1 & 1, corner & 1
                at_x, at_y, at_z = low_x + right - 1, low_y + up - 1, low_z + behind - 1
                if min(at_x, at_y, at_z) < 0 or max(at_x, at_y, at_z) >= side - 1:
                    continue
                row = index[at_x, at_y, at_z]
                if row < 0:
                    continue
                at_corner = (x if right else one - x) * (y if up else one - y) * (z if behind else one - z)
                share = at_corner * values[row, 0] / density
                own_r, own_g, own_b = zero, zero, zero
                for number in range(harmonics):
                    of_basis = basis[ray, number]
                    own_r += of_basis * values[row, 1 + number]
                    own_g += of_basis * values[row, 1 + harmonics + number]
                    own_b += of_basis * values[row, 1 + 2 * harmonics + number]
                    gradient[row, 1 + number] += share * of_basis * by_red
                    gradient[row, 1 + harmonics + number] += share * of_basis * by_green
                    gradient[row, 1 + 2 * harmonics + number] += share * of_basis * by_blue
                mixing = by_red * (own_r - r) + by_green * (own_g - g) + by_blue * (own_b - b)
                gradient[row, 0] += at_corner * (by_density + mixing / density)
    return total
