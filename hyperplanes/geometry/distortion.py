"""Lens distortion, radial and tangential (k1, k2, p1, p2, k3), as OpenCV writes it and Kornia computes it."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float, Int
from kornia.geometry.calibration import distort_points, undistort_points
from kornia.geometry.camera import PinholeCamera
from torch import Tensor

__all__ = ["DistortedCamera", "distorted", "distorted_pixels", "undistorted_pixels"]

_STEPS = 20  # of Kornia's fixed-point iteration; its default of 5 leaves 0.1 pixels at strong distortion


class DistortedCamera(PinholeCamera):
    """Pinhole cameras behind lenses; `distortion` is (view, 5): k1, k2, p1, p2, k3, without unit.

    `ImagePlanes` and `cast` honour it, and `cameras.select`, `to`, `resized` and `concatenate` keep it. Kornia's own
    `project` does not.
    """

    def __init__(self, cameras: PinholeCamera, distortion: Float[Tensor, "view 5"]) -> None:
        super().__init__(cameras.intrinsics, cameras.extrinsics, cameras.height, cameras.width)
        self.distortion = distortion


def distorted(cameras: PinholeCamera, distortion: Float[Tensor, "*view 5"]) -> DistortedCamera:
    """The cameras with a lens in front.

    Args:
        cameras: without skew.
        distortion: k1, k2, p1, p2, k3; one row, or one a camera.

    Returns:
        Cameras in the dtype of `cameras`.

    Raises:
        ValueError: another shape, a value that is not finite, or a camera with skew.
    """
    views = cameras.batch_size
    if distortion.shape not in ((5,), (1, 5), (views, 5)):
        raise ValueError(f"distortion: expected shape (5,) or ({views}, 5), got {tuple(distortion.shape)}")
    if not torch.isfinite(distortion).all():
        raise ValueError("distortion: expected finite numbers, got NaN or infinity")
    if (cameras.intrinsics[:, 0, 1] != 0).any():
        raise ValueError("intrinsics: expected no skew beside lens distortion, got a camera with skew")
    return DistortedCamera(cameras, distortion.to(cameras.intrinsics).expand(views, 5))


def distorted_pixels(
    cameras: DistortedCamera, pixels: Float[Tensor, "point view 2"], views: Int[Tensor, "point view"] | None = None
) -> tuple[Float[Tensor, "point view 2"], Tensor]:
    """Where the lens puts ideal pixels, and whether it can (OpenCV's distortion model).

    Beyond the radius at which the radial polynomial turns back, the model would show points that no lens shows.

    Args:
        cameras: all of them.
        pixels: ideal ones, of the pinhole without its lens.
        views: which camera each column is of; in order where absent.

    Returns:
        Pixels in the picture, and (point, view) false beyond the turning radius.
    """
    index = torch.arange(cameras.batch_size, device=pixels.device)[None] if views is None else views
    matrix = cameras.intrinsics[:, :3, :3].to(pixels)[index]
    limit = _turning_radius(cameras.distortion).to(pixels)[index]
    focal = torch.stack([matrix[..., 0, 0], matrix[..., 1, 1]], -1)
    square = ((pixels - matrix[..., :2, 2]) / focal).square().sum(-1)
    seen = square < limit.square()
    inside = torch.where(seen[..., None], pixels, matrix[..., :2, 2])
    moved = distort_points(inside[:, :, None], matrix, cameras.distortion.to(pixels)[index])[:, :, 0]
    return moved, seen


def undistorted_pixels(
    cameras: DistortedCamera, view: Int[Tensor, " ray"], pixels: Float[Tensor, "ray 2"]
) -> Float[Tensor, "ray 2"]:
    """The ideal pixels of pixels in pictures: the inverse of `distorted_pixels`, by fixed-point iteration."""
    matrix = cameras.intrinsics[view, :3, :3].to(pixels)
    coefficients = cameras.distortion[view].to(pixels)
    return undistort_points(pixels[:, None], matrix, coefficients, num_iters=_STEPS)[:, 0]


def _turning_radius(distortion: Tensor) -> Tensor:
    """Smallest r > 0 with d/dr (r + k1 r^3 + k2 r^5 + k3 r^7) = 0; infinite where there is none."""
    radii = []
    for k1, k2, _, _, k3 in distortion.detach().double().cpu().tolist():
        roots = np.roots([7 * k3, 5 * k2, 3 * k1, 1.0])
        positive = roots.real[(np.abs(roots.imag) < 1e-9) & (roots.real > 0)]
        radii.append(float(np.sqrt(positive.min())) if len(positive) else float("inf"))
    return torch.tensor(radii, dtype=torch.float64, device=distortion.device)
