"""A ray caster for sparse voxel grids, compiled for the CPU where numba is there."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import no_type_check

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from hyperplanes.geometry.rays import Rays, Sphere
from hyperplanes.rendering.compositing import Rendered

__all__ = ["cast_through_voxels", "compiled_caster"]


@functools.cache
def compiled_caster() -> Callable[..., int] | None:
    """The compiled ray caster, or None where numba is missing."""
    try:
        import numba
    except ImportError:
        return None
    return numba.njit(fastmath=True, nogil=True, cache=True)(_cast)


def cast_through_voxels(
    index: Int[Tensor, "x y z"],
    values: Float[Tensor, "row 28"],
    bounds: Sphere,
    rays: Rays,
    basis: Float[Tensor, "ray 9"],
    *,
    step: float,
    stop: float = 1e-3,
    background: float = 1.0,
) -> Rendered:
    """What rays see of a baked field: the same sums as marching it, one compiled loop a ray.

    Args:
        index: row of every voxel or -1.
        values: density and 3 x 9 coefficients of every row.
        bounds: the sphere inside the cube of voxels.
        rays: with near and far.
        basis: spherical harmonics of every ray's direction.
        step: distance between samples in world units.
        stop: transmittance below which a ray is finished.
        background: grey value behind everything.

    Returns:
        Pixels; `samples` counts the samples that were not empty.

    Raises:
        RuntimeError: numba is missing; `compiled_caster` says so beforehand.
    """
    caster = compiled_caster()
    if caster is None:
        raise RuntimeError("cast_through_voxels: expected numba, found none; pip install numba")
    side = index.shape[0]
    scale = side / (2 * bounds.radius)
    corner = torch.tensor(bounds.centre) - bounds.radius
    origins = (rays.origins.float() - corner) * scale
    out = np.empty((len(rays), 5), np.float32)
    arguments = (
        index.numpy(),
        values.numpy(),
        origins.numpy(),
        (rays.directions.float() * scale).contiguous().numpy(),
        rays.near.float().numpy(),
        rays.far.float().numpy(),
        basis.contiguous().numpy(),
        np.float32(step),
        np.float32(-math.log(stop) if stop > 0 else math.inf),
        np.float32(background),
        out,
    )
    threads = torch.get_num_threads()
    cuts = [len(rays) * part // threads for part in range(threads + 1)]
    with ThreadPoolExecutor(threads) as pool:
        samples = sum(pool.map(lambda start, stop: caster(*arguments, start, stop), cuts, cuts[1:]))
    found = torch.from_numpy(out)
    return Rendered(found[:, :3], found[:, 3], found[:, 4], int(samples))


@no_type_check
def _cast(index, values, origins, directions, near, far, basis, step, limit, background, out, start, stop):  # noqa: PLR0913
    """The loop over rays start..stop: (colour, opacity, depth) into `out`; returns the samples that were not empty."""
    side = index.shape[0]
    total = 0
    for ray in range(start, stop):
        t = near[ray] + np.float32(0.5) * step
        passed = np.float32(0.0)
        red, green, blue = np.float32(0.0), np.float32(0.0), np.float32(0.0)
        depth, opacity = np.float32(0.0), np.float32(0.0)
        asked = 0
        while t < far[ray] and passed < limit:
            # voxel coordinates, counted from the centre of voxel 0
            x = origins[ray, 0] + t * directions[ray, 0] - np.float32(0.5)
            y = origins[ray, 1] + t * directions[ray, 1] - np.float32(0.5)
            z = origins[ray, 2] + t * directions[ray, 2] - np.float32(0.5)
            lowest_x, lowest_y, lowest_z = int(math.floor(x)), int(math.floor(y)), int(math.floor(z))
            density = np.float32(0.0)
            r, g, b = np.float32(0.0), np.float32(0.0), np.float32(0.0)
            for corner in range(8):
                at_x, at_y, at_z = lowest_x + (corner >> 2), lowest_y + (corner >> 1 & 1), lowest_z + (corner & 1)
                if min(at_x, at_y, at_z) < 0 or max(at_x, at_y, at_z) >= side:
                    continue
                row = index[at_x, at_y, at_z]
                if row < 0:
                    continue
                share = (
                    (np.float32(1.0) - abs(x - at_x))
                    * (np.float32(1.0) - abs(y - at_y))
                    * (np.float32(1.0) - abs(z - at_z))
                    * values[row, 0]
                )
                density += share
                for harmonic in range(9):
                    weight = share * basis[ray, harmonic]
                    r += weight * values[row, 1 + harmonic]
                    g += weight * values[row, 10 + harmonic]
                    b += weight * values[row, 19 + harmonic]
            if density > np.float32(1e-8):
                asked += 1
                thickness = density * step
                weight = math.exp(-passed) * (np.float32(1.0) - math.exp(-thickness))
                passed += thickness
                red += weight * min(max(r / density, np.float32(0.0)), np.float32(1.0))
                green += weight * min(max(g / density, np.float32(0.0)), np.float32(1.0))
                blue += weight * min(max(b / density, np.float32(0.0)), np.float32(1.0))
                opacity += weight
                depth += weight * t
            t += step
        out[ray, 0] = red + (1 - opacity) * background
        out[ray, 1] = green + (1 - opacity) * background
        out[ray, 2] = blue + (1 - opacity) * background
        out[ray, 3] = opacity
        out[ray, 4] = depth / max(opacity, np.float32(1e-10))
        total += asked
    return total
