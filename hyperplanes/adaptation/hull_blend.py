"""Support colours blended on the visual hull: new views without any learning, what a learned method has to beat."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from jaxtyping import Float
from torch import Tensor

from hyperplanes.adaptation.base import AdaptedField, hull
from hyperplanes.geometry import cameras as camera
from hyperplanes.geometry.image_planes import ImagePlanes
from hyperplanes.geometry.rays import Sphere
from hyperplanes.rendering.renderer import RayMarching
from hyperplanes.utilities.arguments import checked
from hyperplanes.views import Views

__all__ = ["HullBlend"]

OPAQUE = 1e4  # density within the hull, per radius of the scene
WHOLE = 0.98  # opacity of a mask from which on no background is mixed into the colour
STOP = 2e-3  # transmittance; so low that every sample is evaluated: by every second one wings lose 0.05 to 0.5 dB
SOLID = 0.5  # opacity of a mask from which on a pixel shows the object


@dataclass(frozen=True)
class HullBlend:
    """The visual hull of the support masks is the surface, and its colour that of the support views that see it.

    A point lies in the hull where no view that shows it has background there. Its colour is a mean of the `nearest` of
    the support views that see it, by the angle between the direction of view and theirs: one at angle a weighs
    1 / a - 1 / a_max, a_max being the angle of the next one (Buehler et al. 2001, "Unstructured Lumigraph Rendering").
    A view sees a point in front of which no part of the hull lies and where its mask is whole, so that no background is
    mixed into the colour. Where fewer views see the point, the nearest of the others serve.

    Attributes:
        nearest: number of views that a colour is made of.
        side: voxels an axis of the hull in which rays march.
        steps: samples along a diameter of the scene.
    """

    nearest: int = 3
    side: int = 96
    steps: int = 256

    @checked
    @torch.no_grad()
    def adapt(self, support: Views) -> AdaptedField:
        """The hull and its colours; the distance of the hull is rendered once for every support view.

        Raises:
            ValueError: views without masks, or masks that leave nothing.
        """
        if support.masks is None:
            raise ValueError("hull_blend: expected support views with masks, got none; images with alpha have them")
        support, alpha = support.to(dtype=torch.float32), support.masks.float()
        masks = ImagePlanes(alpha.expand(-1, 3, -1, -1), support.cameras, background=1.0)
        region, sampling = hull(support, self.side), RayMarching(self.steps, STOP)
        shape = _Hull(masks, support.bounds)
        solid = AdaptedField(shape, region, sampling, densities=(shape.density,))
        distance = solid.render(support.cameras, antialias=False).depth
        distance = torch.where(distance > 0, distance, torch.inf).expand(-1, 3, -1, -1)
        eyes = camera.centres(support.cameras)
        far = 2 * float((eyes - eyes.new_tensor(support.bounds.centre)).norm(dim=1).max() + support.bounds.radius)
        depths = ImagePlanes(distance.clamp_max(far).contiguous(), support.cameras, background=far, exact=True)
        colours = ImagePlanes(support.images, support.cameras)
        tolerance = 2 * region.voxel
        field = _Blend(masks, support.bounds, colours, depths, min(self.nearest, len(support)), tolerance)
        return AdaptedField(field, region, sampling, densities=(shape.density,))


@dataclass(frozen=True)
class _Hull:
    """The visual hull as an opaque grey field."""

    masks: ImagePlanes
    bounds: Sphere

    thread_safe: ClassVar[bool] = True

    def density(self, points: Float[Tensor, "point 3"]) -> Float[Tensor, " point"]:
        """High where every view that shows a point shows the object there, else 0."""
        found = self.masks.lookup(points)
        background = (found.colours[..., 0] < SOLID) & found.valid
        return torch.where(background.any(1), 0.0, OPAQUE / self.bounds.radius)

    def __call__(
        self, points: Float[Tensor, "point 3"], directions: Float[Tensor, "point 3"]
    ) -> tuple[Float[Tensor, "point 3"], Float[Tensor, " point"]]:
        """Grey, and the density."""
        return torch.full_like(points, 0.5), self.density(points)


@dataclass(frozen=True)
class _Blend(_Hull):
    """The hull in the colours of the support views."""

    colours: ImagePlanes
    depths: ImagePlanes
    nearest: int
    tolerance: float

    def __call__(
        self, points: Float[Tensor, "point 3"], directions: Float[Tensor, "point 3"]
    ) -> tuple[Float[Tensor, "point 3"], Float[Tensor, " point"]]:
        """The blended colours, computed where there is density, and the density."""
        density = self.density(points)
        inside = density > 0
        colour = torch.ones_like(points)
        colour[inside] = self._blended(points[inside], directions[inside])
        return colour, density

    def _blended(self, points: Tensor, directions: Tensor) -> Tensor:
        seen = self.colours.lookup(points, return_directions=True)
        assert seen.directions is not None
        assert seen.distances is not None
        angle = torch.acos((seen.directions * directions[:, None]).sum(-1).clamp(-1, 1)).clamp_min(1e-3)
        depth = self.depths.lookup(points).colours[..., 0]
        covered = self.masks.lookup(points).colours[..., 0]
        hidden = (seen.distances > depth + self.tolerance) | (covered < WHOLE) | ~seen.valid
        penalty = angle + 10 * hidden  # views that see the point go first
        chosen, index = penalty.topk(min(self.nearest + 1, penalty.shape[1]), largest=False)
        limit = chosen[:, -1:] if chosen.shape[1] > self.nearest else chosen[:, -1:] * 2
        chosen, index = chosen[:, : self.nearest], index[:, : self.nearest]
        weights = (1 / chosen - 1 / limit).clamp_min(1e-6)
        weights = weights / weights.sum(1, keepdim=True)
        return (weights[..., None] * seen.colours.gather(1, index[..., None].expand(-1, -1, 3))).sum(1)
