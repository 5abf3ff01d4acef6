"""The support view seen from nearest, copied: what every method has to beat."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from kornia.geometry.camera import PinholeCamera

from hyperplanes.adaptation.base import Pictures
from hyperplanes.geometry import cameras as camera
from hyperplanes.utilities.arguments import checked
from hyperplanes.views import Views

__all__ = ["NearestView"]


@dataclass(frozen=True)
class _Copies:
    support: Views

    def render(self, cameras: PinholeCamera) -> Pictures:
        """The support image whose camera stands in the most similar direction from the scene's centre.

        Its mask is the opacity; without masks all that is in a picture counts as there. Depth is not known: 0.
        """
        known, asked = (
            camera.camera_directions(each, self.support.bounds.centre).to(self.support.images)
            for each in (self.support.cameras, cameras)
        )
        nearest = (asked @ known.T).argmax(1)
        masks = self.support.masks
        opacity = torch.ones_like(self.support.images[nearest, :1]) if masks is None else masks[nearest]
        copied = torch.cat([self.support.images[nearest], opacity], 1)
        size = camera.image_size(cameras)
        if size != self.support.size:
            copied = torch.nn.functional.interpolate(copied, size, mode="bilinear", antialias=True)
        return Pictures(copied[:, :3], copied[:, 3:], torch.zeros_like(copied[:, 3:]), 0)


class NearestView:
    """No learning at all."""

    @checked
    def adapt(self, support: Views) -> _Copies:
        """Remember the support views; none is a ValueError."""
        if not len(support):
            raise ValueError("support: expected at least one view, got none")
        return _Copies(support)
