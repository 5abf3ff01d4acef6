"""A ray caster for sparse voxel grids, compiled for the CPU where numba is there."""

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
from hyperplanes.rendering.compositing import Rendered

__all__ = ["compiled_caster", "distance_to_filled", "render_voxels"]

MAX_DISTANCE = 255  # of the distance transform, which is stored in a byte
RAYS = 1 << 10  # in one call of the kernel


def compiled_caster() -> Callable[..., int] | None:
    """The compiled loop over rays, or None where numba is missing."""
    return compile_function(_render)


def distance_to_filled(index: Int[Tensor, "x y z"]) -> UInt8[Tensor, "cell_x cell_y cell_z"]:
    """Chessboard distance from every cell to the nearest one that is not empty, for empty-space skipping.

    Cell (i, j, k) lies between the centres of voxels i - 1 and i, and so on; there is one more of them an axis than
    voxels. It is empty where none of its eight voxels has a row.

    Args:
        index: row of every voxel or -1.

    >>> distance_to_filled(torch.tensor([-1, -1, 0, -1, -1]).reshape(1, 1, 5))[0, 0].tolist()
    [2, 1, 0, 0, 1, 2]
    """
    from scipy.ndimage import distance_transform_cdt

    filled = np.pad(index.numpy() >= 0, 1)
    for axis in range(3):
        low, high = (np.take(filled, range(n, filled.shape[axis] - 1 + n), axis) for n in (0, 1))
        filled = low | high
    if not filled.any():
        return torch.full(filled.shape, MAX_DISTANCE, dtype=torch.uint8)
    away = np.asarray(distance_transform_cdt(~filled, metric="chessboard"))
    return torch.from_numpy(away.clip(max=MAX_DISTANCE).astype(np.uint8))


def render_voxels(
    index: Int[Tensor, "x y z"],
    values: Float[Tensor, "row 28"],
    bounds: Sphere,
    rays: Rays,
    basis: Float[Tensor, "ray 9"],
    *,
    step: float,
    empty: UInt8[Tensor, "cell_x cell_y cell_z"] | None = None,
    stop: float = 1e-3,
    background: float = 1.0,
) -> Rendered:
    """The pixels of rays through a baked field: the same sums as `Marched` computes, in one compiled loop a ray.

    Args:
        index: row of every voxel or -1.
        values: density and 3 x 9 coefficients of every row.
        bounds: the sphere inside the cube of voxels.
        rays: with near and far.
        basis: spherical harmonics of every ray's direction.
        step: distance between samples in world units.
        empty: the result of `distance_to_filled`, by which empty space is skipped; computed here where absent.
        stop: transmittance below which a ray is finished.
        background: grey value behind everything.

    Returns:
        Pixels; `samples` counts the samples of positive density.

    Raises:
        RuntimeError: numba is missing; `compiled_caster` says so beforehand.
    """
    caster = compiled_caster()
    if caster is None:
        raise RuntimeError("render_voxels: expected numba, found none; pip install numba")
    scale = index.shape[0] / (2 * bounds.radius)
    corner = torch.tensor(bounds.centre) - bounds.radius
    out = np.empty((len(rays), 5), np.float32)
    arguments = (
        index.numpy(),
        values.numpy(),
        (distance_to_filled(index) if empty is None else empty).numpy(),
        ((rays.origins.float() - corner) * scale + 0.5).contiguous().numpy(),
        (rays.directions.float() * scale).contiguous().numpy(),
        rays.near.float().numpy(),
        rays.far.float().numpy(),
        basis.contiguous().numpy(),
        np.float32(step),
        np.float32(-math.log(stop) if stop > 0 else math.inf),
        np.float32(background),
        out,
    )
    samples = sum(parallel_for(lambda start, stop: caster(*arguments, start, stop), len(rays), RAYS))
    found = torch.from_numpy(out)
    return Rendered(found[:, :3], found[:, 3], found[:, 4], samples)


@no_type_check
def _render(index, values, empty, origins, directions, near, far, basis, step, limit, background, out, start, stop):  # noqa: PLR0913
    """The loop over rays start..stop: (colour, opacity, depth) into `out`; returns the samples of positive density.

    Positions are in cells: the whole part is the index of the cell, the fraction the place between its voxel centres.
    """
    side, harmonics = empty.shape[0], basis.shape[1]
    one, zero = np.float32(1.0), np.float32(0.0)
    mixed = np.empty(values.shape[1], np.float32)
    total = 0
    for ray in range(start, stop):
        origin_x, origin_y, origin_z = origins[ray, 0], origins[ray, 1], origins[ray, 2]
        along_x, along_y, along_z = directions[ray, 0], directions[ray, 1], directions[ray, 2]
        first, last = near[ray] + np.float32(0.5) * step, far[ray]
        per_cell = one / (max(abs(along_x), abs(along_y), abs(along_z)) * step)  # least number of samples in a cell
        optical_depth, opacity, depth = zero, zero, zero
        red, green, blue = zero, zero, zero
        sample = 0
        while optical_depth < limit:  # early ray termination
            t = first + np.float32(sample) * step
            if t >= last:
                break
            # The cell that the sample lies in.
            x, y, z = origin_x + t * along_x, origin_y + t * along_y, origin_z + t * along_z
            low_x, low_y, low_z = int(math.floor(x)), int(math.floor(y)), int(math.floor(z))
            if min(low_x, low_y, low_z) < 0 or max(low_x, low_y, low_z) >= side:
                sample += 1
                continue
            # Empty-space skipping: all samples within the distance to the nearest filled cell.
            distance = empty[low_x, low_y, low_z]
            if distance > 0:
                sample += 1 + int(np.float32(distance - 1) * per_cell)
                continue
            sample += 1
            # Trilinear interpolation of density, and of coefficients weighted by density.
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
            total += 1
            # Colour: the spherical harmonics of the ray's direction.
            r, g, b = zero, zero, zero
            for number in range(harmonics):
                r += basis[ray, number] * mixed[1 + number]
                g += basis[ray, number] * mixed[1 + harmonics + number]
                b += basis[ray, number] * mixed[1 + 2 * harmonics + number]
            # Compositing (NeRF, Eq. 3).
            added = density * step
            weight = math.exp(-optical_depth) * (one - math.exp(-added))
            optical_depth += added
            red += weight * min(max(r / density, zero), one)
            green += weight * min(max(g / density, zero), one)
            blue += weight * min(max(b / density, zero), one)
            opacity += weight
            depth += weight * t
        out[ray, 0] = red + (one - opacity) * background
        out[ray, 1] = green + (one - opacity) * background
        out[ray, 2] = blue + (one - opacity) * background
        out[ray, 3] = opacity
        out[ray, 4] = depth / max(opacity, np.float32(1e-10))
    return total
