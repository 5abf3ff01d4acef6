"""A copy of the support view with the nearest viewing direction: a baseline."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from kornia.geometry.camera import PinholeCamera
from torch import Tensor
from torch.nn.functional import grid_sample, interpolate

from hyperplanes.adaptation.base import Pictures
from hyperplanes.geometry import cameras as camera
from hyperplanes.geometry.distortion import DistortedCamera
from hyperplanes.geometry.rays import pixel_grid
from hyperplanes.utilities.messages.arguments import checked
from hyperplanes.utilities.tensors.precision import without_autocast
from hyperplanes.views import Views

__all__ = ["NearestView"]


@dataclass(frozen=True)
class _Copies:
    support: Views

    @without_autocast
    def render(self, cameras: PinholeCamera) -> Pictures:
        """The support images whose cameras lie in the most similar directions from the scene's centre.

        Their masks are the opacity, which is 1 without masks. For cameras with other intrinsics, pixels outside the
        copied image are white, with opacity 0. Depth is not known and is 0.
        """
        known, asked = (
            camera.camera_directions(each, self.support.bounds.centre).to(self.support.images)
            for each in (self.support.cameras, cameras)
        )
        nearest = (asked @ known.T).argmax(1)
        masks = self.support.masks
        opacity = torch.ones_like(self.support.images[nearest, :1]) if masks is None else masks[nearest]
        copied = torch.cat([self.support.images[nearest], opacity], 1)
        parts = [
            _through(copied[[view]], camera.select(self.support.cameras, [source]), camera.select(cameras, [view]))
            for view, source in enumerate(nearest.tolist())
        ]
        copied = torch.cat(parts) if parts else copied
        return Pictures(copied[:, :3], copied[:, 3:], torch.zeros_like(copied[:, 3:]), 0)


def _through(
    copied: Float[Tensor, "1 4 height width"], lens: PinholeCamera, asked: PinholeCamera
) -> Float[Tensor, "1 4 asked_height asked_width"]:
    """Colours and opacity seen by another camera from the same pose, by bilinear interpolation."""
    (height, width), size = camera.image_size(asked), camera.image_size(lens)
    if (height, width) == size and torch.equal(_calibration(asked).to(copied), _calibration(lens).to(copied)):
        return copied
    # the place in the image that each pixel looks at
    still = torch.eye(4).to(asked.extrinsics)[None]
    pixels = pixel_grid(height, width).to(asked.extrinsics)[None]
    points = camera.with_poses(asked, still).unproject(pixels, torch.ones_like(pixels[..., :1]))
    found = camera.with_poses(lens, still.to(lens.extrinsics)).project(points.to(lens.extrinsics)).to(copied)
    # an image of higher resolution is scaled down first, with antialiasing
    scale = float((camera.intrinsics(asked).to(copied) / camera.intrinsics(lens).to(copied))[0, [0, 1], [0, 1]].mean())
    if scale < 1:
        copied = interpolate(copied, [max(1, round(scale * side)) for side in size], mode="bilinear", antialias=True)
    # from -1 to 1 between the borders of the first and the last pixel
    grid = (2 * found + 1) / found.new_tensor([size[1], size[0]]) - 1
    inside = (grid.abs() <= 1).all(-1).reshape(1, 1, height, width)
    shown = grid_sample(copied, grid.reshape(1, height, width, 2), padding_mode="border", align_corners=False)
    return torch.where(inside, shown, shown.new_tensor([1, 1, 1, 0]).reshape(4, 1, 1))


def _calibration(cameras: PinholeCamera) -> Tensor:
    matrix = camera.intrinsics(cameras).flatten(1)
    return torch.cat([matrix, cameras.distortion], 1) if isinstance(cameras, DistortedCamera) else matrix


class NearestView:
    """A method that copies support views."""

    @checked
    def adapt(self, support: Views) -> _Copies:
        """Keeps the support views; ValueError if there are none."""
        if not len(support):
            raise ValueError("support: expected at least one view, got none")
        return _Copies(support)
