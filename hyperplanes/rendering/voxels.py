"""A ray caster for sparse voxel grids, compiled for the CPU, and the gradient of what it renders."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from hyperplanes.geometry.kernels import voxel_rays
from hyperplanes.geometry.kernels.compiling import compile_function
from hyperplanes.geometry.kernels.threads import parallel_for
from hyperplanes.geometry.rays import Rays, Sphere
from hyperplanes.rendering.compositing import Rendered

__all__ = ["distance_to_filled", "render_voxels", "voxel_gradients"]

MAX_DISTANCE = 255  # of the distance transform, which is stored in a byte
STOP = 1e-3  # transmittance below which a ray is finished
RAYS = 1 << 10  # in one call of the kernel


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
    stop: float = STOP,
) -> Rendered:
    """The pixels of rays through a baked field: the same sums as `RayMarching` computes, in one compiled loop a ray.

    Args:
        index: row of every voxel or -1.
        values: density and 3 x 9 coefficients of every row.
        bounds: the sphere inside the cube of voxels.
        rays: with near and far.
        basis: spherical harmonics of every ray's direction.
        step: distance between samples in world units.
        empty: the result of `distance_to_filled`, by which empty space is skipped; computed here where absent.
        stop: transmittance below which a ray is finished.

    Returns:
        Pixels; `samples` counts the samples of positive density.
    """
    kernel = compile_function(voxel_rays.render)
    out = np.empty((len(rays), 5), np.float32)
    arrays = _arrays(index, values, bounds, rays, basis, distance_to_filled(index) if empty is None else empty)
    numbers = _numbers(step, stop)
    samples = sum(parallel_for(lambda first, last: kernel(*arrays, *numbers, out, first, last), len(rays), RAYS))
    found = torch.from_numpy(out)
    return Rendered(found[:, :3], found[:, 3], found[:, 4], samples)


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
    out: Float[Tensor, "thread row 28"] | None = None,
    stop: float = STOP,
) -> tuple[float, Float[Tensor, "row 28"]]:
    """The mean squared error of the pixels of `render_voxels`, and its gradient with respect to `values`.

    Args:
        index: as there.
        values: as there.
        bounds: as there.
        rays: as there.
        basis: as there.
        truth: what the pixels should be.
        step: as there.
        empty: the result of `distance_to_filled`.
        out: a gradient for each thread of PyTorch, to be written over; the first becomes the result.
        stop: as there.

    Returns:
        The error, and its gradient.
    """
    kernel, threads = compile_function(voxel_rays.add_gradients), torch.get_num_threads()
    chunk = max(1, -(-len(rays) // threads))  # one a thread, each with a gradient of its own
    found = torch.empty(threads, *values.shape) if out is None else out
    found.zero_()
    arrays = _arrays(index, values, bounds, rays, basis, empty)
    numbers, colours = _numbers(step, stop), truth.float().contiguous().numpy()

    def work(first: int, last: int) -> float:
        return kernel(*arrays, *numbers, colours, found[first // chunk].numpy(), first, last)

    error = sum(parallel_for(work, len(rays), chunk))
    for other in found[1:]:
        found[0] += other
    return error / (3 * len(rays)), found[0].div_(3 * len(rays))


def _arrays(
    index: Tensor, values: Tensor, bounds: Sphere, rays: Rays, basis: Tensor, empty: Tensor
) -> tuple[npt.NDArray[Any], ...]:
    """What both kernels read, rays in units of cells."""
    scale = index.shape[0] / (2 * bounds.radius)
    corner = torch.tensor(bounds.centre) - bounds.radius
    return (
        index.numpy(),
        values.numpy(),
        empty.numpy(),
        ((rays.origins.float() - corner) * scale + 0.5).contiguous().numpy(),
        (rays.directions.float() * scale).contiguous().numpy(),
        rays.near.float().numpy(),
        rays.far.float().numpy(),
        basis.contiguous().numpy(),
    )


def _numbers(step: float, stop: float) -> tuple[np.float32, ...]:
    """The step, the optical depth at which a ray is finished, and a white background."""
    return np.float32(step), np.float32(-math.log(stop) if stop > 0 else math.inf), np.float32(1.0)
