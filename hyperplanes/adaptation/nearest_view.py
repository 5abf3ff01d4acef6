"""The support view seen from nearest, copied: what every method has to beat."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from kornia.geometry.camera import PinholeCamera

from hyperplanes.adaptation.base import Pictures
from hyperplanes.geometry import cameras as camera
from hyperplanes.views import Views

__all__ = ["NearestView"]


@dataclass(frozen=True)
class _Copies:
    support: Views

    def render(self, cameras: PinholeCamera) -> Pictures:
        """The support image whose camera stands in the most similar direction from the scene's centre."""
        centre = self.support.images.new_tensor(self.support.bounds.centre)
        known = torch.nn.functional.normalize(camera.centres(self.support.cameras) - centre, dim=-1)
        asked = torch.nn.functional.normalize(camera.centres(cameras) - centre, dim=-1)
        nearest = (asked @ known.T).argmax(1)
        images = self.support.images[nearest]
        size = camera.image_size(cameras)
        if size != self.support.size:
            images = torch.nn.functional.interpolate(images, size, mode="bilinear", antialias=True)
        empty = images.new_zeros(len(images), 1, *size)
        return Pictures(images, empty, empty, 0)


class NearestView:
    """No learning at all."""

    def adapt(self, support: Views) -> _Copies:
        """Remember the support views."""
        return _Copies(support)
