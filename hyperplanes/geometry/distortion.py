"""Lens distortion, radial and tangential (k1, k2, p1, p2, k3), as OpenCV writes it and Kornia computes it."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from kornia.geometry.calibration import distort_points
from kornia.geometry.camera import PinholeCamera
from torch import Tensor

from hyperplanes.utilities.tensors.cached_on import cached_on

__all__ = [
    "DistortedCamera",
    "distorted",
    "distorted_pixels",
    "inverse_distortion",
    "turning_radius",
    "undistorted_pixels",
]

_DOUBLINGS, _BISECTIONS, _NEWTON_STEPS = 12, 12, 10  # of the inverse; Newton squares the error once it is near
_LARGEST_ERROR = 0.01  # pixels by which a ray may miss its pixel and still count as found


class DistortedCamera(PinholeCamera):
    """Pinhole cameras with lens distortion; `distortion` is (view, 5): k1, k2, p1, p2, k3, without unit.

    A pixel that the lens maps no direction to has no ray: `unproject` gives NaN and `cast` a ray without samples.
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
        """World points of pixels (view, point, 2) at z coordinates (view, point, 1): the inverse of `project`.

        NaN where the lens maps no direction to the pixel.
        """
        self._check("point_2d", point_2d, 2)
        view = torch.arange(self.batch_size, device=point_2d.device).repeat_interleave(point_2d.shape[1])
        ideal, found = undistorted_pixels(self, view, point_2d.reshape(-1, 2))
        points = super().unproject(ideal.reshape(point_2d.shape), depth)
        return torch.where(found.reshape(*point_2d.shape[:2], 1), points, torch.nan)

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

    Beyond the radius at which the radial polynomial turns back, the model maps points into the image that the lens
    does not show there.

    Args:
        cameras: the batch.
        pixels: of the pinhole without its lens.
        views: index of the camera of each entry; the columns in order where absent.

    Returns:
        Pixels in the image, and (point, view) false beyond the turning radius.
    """
    index = torch.arange(cameras.batch_size, device=pixels.device)[None] if views is None else views
    matrix = cameras.intrinsics[:, :3, :3].to(pixels)[index]
    limit = _limits(cameras).to(pixels)[index]
    focal = torch.stack([matrix[..., 0, 0], matrix[..., 1, 1]], -1)
    square = ((pixels - matrix[..., :2, 2]) / focal).square().sum(-1)
    shown = square < limit.square()
    inside = torch.where(shown[..., None], pixels, matrix[..., :2, 2])
    moved = distort_points(inside[:, :, None], matrix, cameras.distortion.to(pixels)[index])[:, :, 0]
    return moved, shown


def undistorted_pixels(
    cameras: DistortedCamera, view: Int[Tensor, " ray"], pixels: Float[Tensor, "ray 2"]
) -> tuple[Float[Tensor, "ray 2"], Bool[Tensor, " ray"]]:
    """Pixels of the pinhole without its lens: the inverse of `distorted_pixels`, differentiable in all of them.

    Args:
        cameras: the batch.
        view: index of the camera of each pixel.
        pixels: in the image.

    Returns:
        Ideal pixels, and whether there is one within a hundredth of a pixel; finite numbers where there is none.
    """
    matrix = cameras.intrinsics[view, :3, :3].to(pixels)
    focal, centre = matrix[:, [0, 1], [0, 1]], matrix[:, :2, 2]
    limit = _limits(cameras).to(pixels)[view]
    tolerance = _LARGEST_ERROR / focal.detach().amax(1)
    points, found = inverse_distortion((pixels - centre) / focal, cameras.distortion.to(pixels)[view], limit, tolerance)
    return points * focal + centre, found


def _limits(cameras: DistortedCamera) -> Float[Tensor, " view"]:
    """The turning radius of each camera, computed once."""
    return cached_on(cameras, "turning_radius", [cameras.distortion], lambda: turning_radius(cameras.distortion))


def inverse_distortion(
    points: Float[Tensor, "point 2"],
    coefficients: Float[Tensor, "point coefficient"],
    limit: Float[Tensor, " point"],
    tolerance: float | Float[Tensor, " point"] = 1e-6,
) -> tuple[Float[Tensor, "point 2"], Bool[Tensor, " point"]]:
    """The points of the plane z = 1 that a lens maps to the given ones.

    The radius is bracketed by bisection within the turning radius, without the tangential part; then Newton's method
    refines both coordinates.

    Args:
        points: distorted points, in units of the focal length.
        coefficients: k1, k2, p1, p2, k3, or with k4, k5, k6 of OpenCV's rational model.
        limit: turning radius of each point's lens; beyond it the model folds back.
        tolerance: largest distance between the distorted result and the given point.

    Returns:
        The points, with the gradient of the inverse, and whether they are within the tolerance and before the fold.
    """
    lens = torch.nn.functional.pad(coefficients, (0, 8 - coefficients.shape[1]))
    with torch.no_grad():
        ideal = _radial_inverse(points, lens, limit)
        for _ in range(_NEWTON_STEPS):
            ideal = _newton_step(ideal, points, lens)
            radius = ideal.norm(dim=-1, keepdim=True)
            ideal = torch.where(radius > limit[:, None], ideal * (limit[:, None] / radius), ideal)
        moved, jacobian = _lens(ideal, lens)
        near = (moved - points).norm(dim=-1) <= tolerance
        found = near & (ideal.norm(dim=-1) < limit) & (torch.linalg.det(jacobian) > 0)
    refined = _newton_step(ideal, points, lens)  # once more, with gradients: those of the implicit function
    return torch.where(found[:, None], refined, ideal), found


def _radial_inverse(points: Tensor, lens: Tensor, limit: Tensor) -> Tensor:
    """Points that the radial part alone maps to the radius of the given ones, or as near to it as possible."""
    wanted = points.norm(dim=-1)

    def shown(radius: Tensor) -> Tensor:
        return radius * _radial(radius.square(), lens)[0]

    low, high = torch.zeros_like(wanted), torch.minimum(wanted + 0.1, limit)
    for _ in range(_DOUBLINGS):
        high = torch.where(shown(high) < wanted, torch.minimum(2 * high, limit), high)
    for _ in range(_BISECTIONS):
        middle = (low + high) / 2
        below = shown(middle) < wanted
        low, high = torch.where(below, middle, low), torch.where(below, high, middle)
    return points * ((low + high) / 2 / wanted.clamp_min(1e-12))[:, None]


def _newton_step(ideal: Tensor, points: Tensor, lens: Tensor) -> Tensor:
    """One step towards the points that the lens maps to the given ones; none where its Jacobian is singular."""
    moved, jacobian = _lens(ideal, lens)
    a, b, c, d = jacobian.detach().flatten(1).unbind(1)
    determinant = a * d - b * c
    usable = determinant.abs() > 1e-6
    safe = torch.where(usable, determinant, 1.0)
    x, y = (points - moved).unbind(1)
    step = torch.stack([d * x - b * y, a * y - c * x], 1) / safe[:, None]
    return ideal + torch.where(usable[:, None], step, 0.0)


def _radial(square: Tensor, lens: Tensor) -> tuple[Tensor, Tensor]:
    """The factor of the radius at a squared radius, and its derivative with respect to that square."""
    k1, k2, _, _, k3, k4, k5, k6 = lens.unbind(-1)
    above, below = 1 + square * (k1 + square * (k2 + square * k3)), 1 + square * (k4 + square * (k5 + square * k6))
    slope = (k1 + square * (2 * k2 + 3 * square * k3)) * below - above * (k4 + square * (2 * k5 + 3 * square * k6))
    return above / below, slope / below.square()


def _lens(points: Tensor, lens: Tensor) -> tuple[Tensor, Tensor]:
    """OpenCV's model at points (point, 2): the distorted points, and the Jacobian (point, 2, 2)."""
    x, y = points.unbind(-1)
    p1, p2 = lens[..., 2], lens[..., 3]
    square = x * x + y * y
    factor, slope = _radial(square, lens)
    moved = torch.stack(
        [
            x * factor + 2 * p1 * x * y + p2 * (square + 2 * x * x),
            y * factor + p1 * (square + 2 * y * y) + 2 * p2 * x * y,
        ],
        -1,
    )
    mixed = 2 * x * y * slope + 2 * p1 * x + 2 * p2 * y
    across = factor + 2 * x * x * slope + 2 * p1 * y + 6 * p2 * x
    down = factor + 2 * y * y * slope + 6 * p1 * y + 2 * p2 * x
    return moved, torch.stack([torch.stack([across, mixed], -1), torch.stack([mixed, down], -1)], -2)


def turning_radius(distortion: Float[Tensor, "view coefficient"]) -> Float[Tensor, " view"]:
    """The smallest r > 0 at which r (1 + k1 r^2 + k2 r^4 + k3 r^6) / (1 + k4 r^2 + k5 r^4 + k6 r^6) stops growing.

    Args:
        distortion: k1, k2, p1, p2, k3, or with k4, k5, k6.

    Returns:
        In units of the focal length, float64; infinite where there is none.

    >>> turning_radius(torch.tensor([[-1 / 3, 0.0, 0.0, 0.0, 0.0]])).round(decimals=6).tolist()
    [1.0]
    """
    radii = []
    for row in distortion.detach().double().cpu().tolist():
        k1, k2, _, _, k3, k4, k5, k6 = [*row, 0.0, 0.0, 0.0][:8]
        above, below = np.poly1d([k3, k2, k1, 1.0]), np.poly1d([k6, k5, k4, 1.0])
        square = np.poly1d([1.0, 0.0])
        slope = above * below + 2 * square * (above.deriv() * below - above * below.deriv())
        roots = np.concatenate([np.roots(slope), np.roots(below)])
        positive = np.real(roots)[(np.abs(np.imag(roots)) < 1e-9) & (np.real(roots) > 0)]
        radii.append(float(np.sqrt(positive.min())) if len(positive) else float("inf"))
    return torch.tensor(radii, dtype=torch.float64, device=distortion.device)
