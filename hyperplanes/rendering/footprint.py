"""The pixels whose rays may cross an occupied region."""

from __future__ import annotations

import math
from importlib.util import find_spec

import numpy as np
import torch
from jaxtyping import Bool
from kornia.geometry.camera import PinholeCamera
from torch import Tensor
from torch.nn.functional import max_pool2d

from hyperplanes.geometry import cameras as camera
from hyperplanes.geometry.distortion import DistortedCamera
from hyperplanes.geometry.kernels.compiling import compile_kernel
from hyperplanes.geometry.kernels.threads import parallel_for
from hyperplanes.geometry.occupancy import Occupancy, ball_extent
from hyperplanes.geometry.rays import Sphere
from hyperplanes.utilities.tensors.precision import without_autocast
from hyperplanes.utilities.tensors.transforms import are_plain

__all__ = ["footprint", "pixels_across"]


@torch.no_grad()
def pixels_across(cameras: PinholeCamera, bounds: Sphere) -> float:
    """The diameter of a sphere in pixels, in the view where it is largest; from inside, as seen from its surface."""
    camera.image_size(cameras)  # raises without cameras
    distance = (camera.centres(cameras) - camera.centres(cameras).new_tensor(bounds.centre)).norm(dim=1)
    focal = camera.intrinsics(cameras)[:, 0, 0]
    return float((2 * bounds.radius * focal / distance.clamp_min(bounds.radius)).max())


@without_autocast
@torch.no_grad()
def footprint(occupancy: Occupancy, cameras: PinholeCamera) -> Bool[Tensor, "view height width"]:
    """The pixels whose rays may cross an occupied voxel; every other pixel is background.

    The centres of the surface voxels are projected and dilated by the largest extent of a voxel in that view, so that
    no pixel is missed. If a voxel lies beside or behind the camera, or the camera has lens distortion, all pixels of a
    view are included.
    """
    height, width = camera.image_size(cameras)
    if isinstance(cameras, DistortedCamera) and occupancy.occupied.any():
        return torch.ones(cameras.batch_size, height, width, dtype=torch.bool, device=cameras.intrinsics.device)
    matrices, calibrations = camera.projection_matrices(cameras), camera.intrinsics(cameras)
    points = occupancy.surface_centres.to(matrices)
    seen = torch.zeros(len(matrices), height, width, dtype=torch.bool, device=points.device)
    if not len(points):
        return seen
    kind = points.device.type == "cpu" and points.dtype in (torch.float32, torch.float64)
    mark = _mark_compiled if kind and find_spec("numba") and are_plain(matrices) else _mark_torch
    mark(seen, points, matrices, calibrations, occupancy.voxel)
    return seen


def _mark_compiled(seen: Tensor, points: Tensor, matrices: Tensor, calibrations: Tensor, voxel: float) -> None:
    """Sets the pixels of `seen` around surface voxels with these centres, by the compiled kernel."""
    kernel = compile_kernel("hull.footprints.footprints", points.dtype)
    fixed = [each.contiguous().numpy() for each in (points, matrices, calibrations)]
    numbers = np.asarray([voxel * math.sqrt(3) / 2, 2 * voxel], fixed[0].dtype)
    parallel_for(lambda start, stop: kernel(*fixed, *numbers, seen.numpy(), start, stop), len(seen), 1)


def _mark_torch(seen: Tensor, points: Tensor, matrices: Tensor, calibrations: Tensor, voxel: float) -> None:
    """As `_mark_compiled`, in plain PyTorch."""
    height, width = seen.shape[1:]
    for view, matrix in enumerate(matrices):
        # centres of the surface voxels, in pixels of the view; all pixels if one is too near
        homogeneous = points @ matrix[:, :3].T + matrix[:, 3]
        if float(homogeneous[:, 2].min()) < 2 * voxel:
            seen[view] = True
            continue
        pixels = homogeneous[:, :2] / homogeneous[:, 2:]
        # half sizes of the boxes around the projected balls of voxels; which of them meet the image
        extent = ball_extent(pixels, homogeneous[:, 2], calibrations[view], voxel * math.sqrt(3) / 2)
        touching = ((pixels + extent >= 0) & (pixels - extent <= pixels.new_tensor([width - 1, height - 1]))).all(-1)
        if not touching.any():
            continue
        across, down = (int(value) for value in (extent[touching].amax(0) + 0.51).tolist())
        if across > width or down > height:
            seen[view] = True
            continue
        # the pixel of each centre, dilated by the largest of these boxes
        padded = torch.zeros(height + 2 * down, width + 2 * across, device=points.device)
        column, row = pixels[touching].round().long().unbind(-1)
        padded[row + down, column + across] = 1.0
        seen[view] = max_pool2d(max_pool2d(padded[None], (2 * down + 1, 1), 1), (1, 2 * across + 1), 1)[0] > 0
