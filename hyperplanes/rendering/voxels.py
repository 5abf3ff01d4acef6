"""A differentiable ray caster for sparse voxel grids, compiled for the CPU."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor
from torch.nn.functional import pad

from hyperplanes.geometry.kernels.compiling import compile_function
from hyperplanes.geometry.kernels.threads import parallel_for
from hyperplanes.geometry.kernels.voxels import voxel_rays
from hyperplanes.geometry.occupancy import ranges
from hyperplanes.geometry.rays import Rays, Sphere
from hyperplanes.rendering.compositing import Rendered

__all__ = ["STOP_TRANSMITTANCE", "VoxelGrid", "distance_to_filled", "render_voxels", "shade_voxels", "voxel_gradients"]

MAX_DISTANCE = 255  # of the distance transform, which is stored in a byte
STOP_TRANSMITTANCE = 1e-3  # transmittance below which a ray ends
RAY_CHUNK, ROW_CHUNK = 1 << 10, 1 << 14  # in one call of the kernels


@dataclass(frozen=True)
class VoxelGrid:
    """The bounding box of the voxels of a sparse grid, for ray casting.

    Cell (i, j, k) lies between the centres of voxels (i, j, k) and (i + 1, j + 1, k + 1).

    Attributes:
        rows: row of each voxel, or -1; the outermost voxels have none.
        distances: chessboard distance from each cell to the nearest non-empty one.
        first: world position of the centre of voxel (0, 0, 0).
        voxel: side of a voxel in world units.
    """

    rows: Int[Tensor, "x y z"]
    distances: UInt8[Tensor, "cell_x cell_y cell_z"]
    first: Float[Tensor, " 3"]
    voxel: float

    @classmethod
    def of(cls, index: Int[Tensor, "x y z"], bounds: Sphere) -> VoxelGrid:
        """The bounding box of these voxels.

        Args:
            index: row of each voxel of a cube, or -1.
            bounds: the sphere inside the cube.
        """
        low, high = zip(*((first, last or 1) for first, last in ranges(index >= 0)), strict=True)
        box = index[low[0] : high[0], low[1] : high[1], low[2] : high[2]]
        voxel = 2 * bounds.radius / len(index)
        first = torch.tensor(bounds.centre) - bounds.radius + voxel * (torch.tensor(low) - 0.5)
        return cls(pad(box, (1,) * 6, value=-1), distance_to_filled(box), first, voxel)


def distance_to_filled(index: Int[Tensor, "x y z"]) -> UInt8[Tensor, "cell_x cell_y cell_z"]:
    """Chessboard distance from each cell to the nearest non-empty one, for empty-space skipping.

    Cell (i, j, k) lies between the centres of voxels i - 1 and i, and so on; there is one more cell than voxels along
    each axis. It is empty if none of its eight voxels has a row.

    Args:
        index: row of each voxel, or -1.

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


def shade_voxels(
    values: Float[Tensor, "row 28"], centres: Float[Tensor, "row 3"], eye: Float[Tensor, " 3"]
) -> Float[Tensor, "padded_row 4"]:
    """Voxels as one camera sees them: density, and red, green and blue times density, followed by a row of zeros.

    A picture then interpolates four numbers per voxel instead of 28. The direction is that of the ray through the
    centre of the voxel.

    Args:
        values: density and 3 x 9 coefficients of each row.
        centres: of the voxels, in world units.
        eye: the centre of the camera.
    """
    kernel, out = compile_function(voxel_rays.shade), torch.empty(len(values) + 1, 4)
    out[-1] = 0
    arrays = values.numpy(), centres.float().numpy(), eye.float().numpy(), out.numpy()
    parallel_for(lambda first, last: kernel(*arrays, first, last), len(values), ROW_CHUNK)
    return out


def render_voxels(grid: VoxelGrid, shaded: Float[Tensor, "padded_row 4"], rays: Rays, *, step: float) -> Rendered:
    """The pixels of rays through a baked field: the same sums as for `RayMarching`, in a compiled loop per ray.

    Args:
        grid: of the voxels.
        shaded: the result of `shade_voxels` for the camera that the rays come from.
        rays: with near and far.
        step: distance between samples in world units.

    Returns:
        Pixels; `samples` counts those with positive density.
    """
    kernel = compile_function(voxel_rays.render)
    out = np.empty((len(rays), 5), np.float32)
    arrays, numbers = _arrays(grid, shaded, rays), _numbers(step, STOP_TRANSMITTANCE)
    samples = sum(parallel_for(lambda first, last: kernel(*arrays, *numbers, out, first, last), len(rays), RAY_CHUNK))
    found = torch.from_numpy(out)
    return Rendered(found[:, :3], found[:, 3], found[:, 4], samples)


def voxel_gradients(
    grid: VoxelGrid,
    values: Float[Tensor, "row 28"],
    rays: Rays,
    basis: Float[Tensor, "ray 9"],
    truth: Float[Tensor, "pixel 3"],
    *,
    step: float,
    counts: Int[Tensor, " pixel"] | None = None,
    out: Float[Tensor, "thread row 28"] | None = None,
    stop: float = STOP_TRANSMITTANCE,
) -> tuple[float, Float[Tensor, "row 28"]]:
    """The mean squared error of pixels, and its gradient with respect to `values`.

    Args:
        grid: of the voxels.
        values: density and 3 x 9 coefficients of each row.
        rays: with near and far, pixel after pixel.
        basis: spherical harmonics of the direction of each ray.
        truth: true colours of the pixels.
        step: distance between samples in world units.
        counts: number of rays, at least one, that are averaged for each pixel; by default one.
        out: buffer with a gradient for each thread of PyTorch; the first becomes the result.
        stop: transmittance below which a ray ends.

    Returns:
        The error, and its gradient.
    """
    kernel, threads = compile_function(voxel_rays.add_gradients), torch.get_num_threads()
    chunk = max(1, -(-len(truth) // threads))  # one chunk per thread, each with its own gradient
    found = torch.empty(threads, *values.shape) if out is None else out
    found.zero_()
    pixels = torch.arange(len(rays) + 1) if counts is None else pad(counts.cumsum(0), (1, 0))
    arrays = (*_arrays(grid, values, rays), basis.contiguous().numpy(), pixels.numpy())
    numbers, colours = _numbers(step, stop), truth.float().contiguous().numpy()

    def work(first: int, last: int) -> float:
        return kernel(*arrays, *numbers, colours, found[first // chunk].numpy(), first, last)

    error = sum(parallel_for(work, len(truth), chunk))
    for other in found[1:]:
        found[0] += other
    return error / (3 * len(truth)), found[0].div_(3 * len(truth))


def _arrays(grid: VoxelGrid, values: Tensor, rays: Rays) -> tuple[npt.NDArray[Any], ...]:
    """The inputs of both kernels, with rays in units of cells."""
    return (
        grid.rows.numpy(),
        values.numpy(),
        grid.distances.numpy(),
        ((rays.origins.float() - grid.first) / grid.voxel).contiguous().numpy(),
        (rays.directions.float() / grid.voxel).contiguous().numpy(),
        rays.near.float().numpy(),
        rays.far.float().numpy(),
    )


def _numbers(step: float, stop: float) -> tuple[np.float32, ...]:
    """The step, the transmittance at which a ray ends, and a white background."""
    return np.float32(step), np.float32(stop), np.float32(1.0)
