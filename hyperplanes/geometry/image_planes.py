"""ImagePlanes: posed images as a lookup from points in the world to colours (MultiPlaneNeRF; HyperPlanes, Eq. 3)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from kornia.geometry.camera import PinholeCamera
from torch import Tensor

from hyperplanes.geometry import cameras as camera

__all__ = ["ImagePlanes", "Lookup"]

NEAREST_DEPTH = 1e-4


@dataclass(frozen=True)
class Lookup:
    """What all planes say about each point.

    Attributes:
        colours: bilinear colours; the background where `valid` is false.
        coordinates: where the point falls on the plane, (column, row) in [-1, 1] from the first pixel's centre to the
            last one's. Clamped to that range where the point falls outside the image, zero where it is behind.
        valid: the point is in front of the camera and inside its image.
    """

    colours: Float[Tensor, "point view channel"]
    coordinates: Float[Tensor, "point view 2"]
    valid: Bool[Tensor, "point view"]


class ImagePlanes:
    """Images with their cameras, seen as one function of points in the world."""

    def __init__(
        self, images: Float[Tensor, "view channel height width"], cameras: PinholeCamera, background: float = 1.0
    ) -> None:
        if images.ndim != 4:
            raise ValueError(f"images: expected shape (view, channel, height, width), got {tuple(images.shape)}")
        if len(images) != cameras.batch_size:
            raise ValueError(f"images: expected one a camera, {cameras.batch_size}, got {len(images)}")
        if len(images) and camera.image_size(cameras) != tuple(images.shape[2:]):
            raise ValueError(
                f"images: expected the cameras' size {camera.image_size(cameras)}, got {tuple(images.shape[2:])}"
            )
        self.images = images
        self.cameras = cameras
        self.background = background

    def __len__(self) -> int:
        return len(self.images)

    def lookup(self, points: Float[Tensor, "point 3"], views: Int[Tensor, "point chosen"] | None = None) -> Lookup:
        """Project every point onto every plane and interpolate the colours there."""
        height, width = self.images.shape[2:]
        projection = camera.projection_matrices(self.cameras).to(points)
        homogeneous = torch.einsum("vij,pj->vpi", projection[..., :3], points) + projection[:, None, :, 3]
        depth = homogeneous[..., 2]
        front = depth > NEAREST_DEPTH
        pixels = homogeneous[..., :2] / torch.where(front, depth, 1.0)[..., None]
        scale = pixels.new_tensor([2 / max(width - 1, 1), 2 / max(height - 1, 1)])
        coordinates = pixels * scale - 1
        valid = front & (coordinates.abs() <= 1).all(-1)
        coordinates = torch.where(front[..., None], coordinates, 0.0).clamp(-1, 1)
        sampled = torch.nn.functional.grid_sample(
            self.images.to(points.dtype), coordinates[:, :, None], align_corners=True, padding_mode="border"
        )[..., 0]
        colours = torch.where(valid[:, None], sampled, self.background)
        result = Lookup(colours.permute(2, 0, 1), coordinates.transpose(0, 1), valid.T)
        return result if views is None else _pick(result, views)


def _pick(result: Lookup, views: Tensor) -> Lookup:
    return Lookup(
        torch.take_along_dim(result.colours, views[..., None], 1),
        torch.take_along_dim(result.coordinates, views[..., None], 1),
        torch.take_along_dim(result.valid, views, 1),
    )
