"""Lens distortion, radial and tangential (k1, k2, p1, p2, k3), as OpenCV writes it and Kornia computes it."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float, Int
from kornia.geometry.calibration import distort_points, undistort_points
from kornia.geometry.camera import PinholeCamera
from torch import Tensor

__all__ = ["DistortedCamera", "distorted", "distorted_pixels", "undistorted_pixels"]

_ITERATIONS = 20  # of Kornia's fixed-point iteration; its default of 5 leaves 0.1 pixels at strong distortion


class DistortedCamera(PinholeCamera):
    """Pinhole cameras with lens distortion; `distortion` is (view, 5): k1, k2, p1, p2, k3, without unit.

    `project`, `unproject`, `ImagePlanes`, `cast` and `footprint` apply it, `cameras.select`, `to`, `resized`,
    `concatenate` and `with_poses` keep it, and `carve` refuses it. The matrices, such as `intrinsics`, are those of the
    pinhole behind the lens.
    """

    def __init__(self, cameras: PinholeCamera, distortion: Float[Tensor, "view 5"]) -> None:
        super().__init__(cameras.intrinsics, cameras.extrinsics, cameras.height, cameras.width)
        self.distortion = distortion

    def project(self, point_3d: Tensor) -> Float[Tensor, "view point 2"]:
        """Pixels of world points (view, point, 3), as `PinholeCamera.project` returns them, through the lens.

        NaN where the lens cannot show the point; as in Kornia, points behind the camera are not flagged.
        """
        self._check("point_3d", point_3d, 3)
        pixels, shown = distorted_pixels(self, super().project(point_3d).transpose(0, 1))
        return torch.where(shown[..., None], pixels, torch.nan).transpose(0, 1)

    def unproject(self, point_2d: Tensor, depth: Tensor) -> Float[Tensor, "view point 3"]:
        """World points of pixels (view, point, 2) at z coordinates (view, point, 1): the inverse of `project`."""
        self._check("point_2d", point_2d, 2)
        view = torch.arange(self.batch_size, device=point_2d.device).repeat_interleave(point_2d.shape[1])
        ideal = undistorted_pixels(self, view, point_2d.reshape(-1, 2)).reshape(point_2d.shape)
        return super().unproject(ideal, depth)

    def clone(self) -> DistortedCamera:
        """A copy."""
        return DistortedCamera(self, self.distortion.clone())

    def scale(self, scale_factor: Tensor) -> PinholeCamera:
        """Refused: Kornia's rule moves the principal point away from the centre of distortion.

        Raises:
            ValueError: always.
        """
        raise ValueError("scale: expected cameras without lens distortion, got a DistortedCamera; use cameras.resized")

    def scale_(self, scale_factor: float | Tensor) -> PinholeCamera:
        """Refused, as `scale`."""
        return self.scale(torch.as_tensor(scale_factor))

    def _check(self, name: str, value: Tensor, size: int) -> None:
        if value.ndim != 3 or (value.shape[0], value.shape[2]) != (self.batch_size, size):
            raise ValueError(f"{name}: expected shape ({self.batch_size}, point, {size}), got {tuple(value.shape)}")


def distorted(cameras: PinholeCamera, distortion: Float[Tensor, "*view 5"]) -> DistortedCamera:
    """The cameras with lens distortion.

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
    """Distorted pixels of ideal ones, and whether the distortion is defined there (OpenCV's model).

    Beyond the radius at which the radial polynomial turns back, the model would map points into the image that no lens
    shows there.

    Args:
        cameras: all of them.
        pixels: of the pinhole without its lens.
        views: index of the camera of each entry; the columns in order where absent.

    Returns:
        Pixels in the image, and (point, view) false beyond the turning radius.
    """
    index = torch.arange(cameras.batch_size, device=pixels.device)[None] if views is None else views
    matrix = cameras.intrinsics[:, :3, :3].to(pixels)[index]
    limit = _turning_radius(cameras.distortion).to(pixels)[index]
    focal = torch.stack([matrix[..., 0, 0], matrix[..., 1, 1]], -1)
    square = ((pixels - matrix[..., :2, 2]) / focal).square().sum(-1)
    shown = square < limit.square()
    inside = torch.where(shown[..., None], pixels, matrix[..., :2, 2])
    moved = distort_points(inside[:, :, None], matrix, cameras.distortion.to(pixels)[index])[:, :, 0]
    return moved, shown


def undistorted_pixels(
    cameras: DistortedCamera, view: Int[Tensor, " ray"], pixels: Float[Tensor, "ray 2"]
) -> Float[Tensor, "ray 2"]:
    """Pixels of the pinhole without its lens, the inverse of `distorted_pixels`, by fixed-point iteration."""
    matrix = cameras.intrinsics[view, :3, :3].to(pixels)
    coefficients = cameras.distortion[view].to(pixels)
    return undistort_points(pixels[:, None], matrix, coefficients, num_iters=_ITERATIONS)[:, 0]


def _turning_radius(distortion: Tensor) -> Tensor:
    """Smallest r > 0 with d/dr (r + k1 r^3 + k2 r^5 + k3 r^7) = 0; infinite where there is none."""
    radii = []
    for k1, k2, _, _, k3 in distortion.detach().double().cpu().tolist():
        roots = np.roots([7 * k3, 5 * k2, 3 * k1, 1.0])
        positive = roots.real[(np.abs(roots.imag) < 1e-9) & (roots.real > 0)]
        radii.append(float(np.sqrt(positive.min())) if len(positive) else float("inf"))
    return torch.tensor(radii, dtype=torch.float64, device=distortion.device)
