"""Residual correction: what pictures of a field lack where its support views show the same places is added to new ones.

A field cannot show everything that its support views do: its surfaces are soft, and thin parts half transparent. How
far each support view lies above what the field shows from its camera is known. These residuals are images, so a new
view takes them over as image-based rendering takes over colours (Buehler et al. 2001, "Unstructured Lumigraph
Rendering"): from where the support views see the same surface, the more the closer their rays are to its own.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from threading import Lock
from typing import Any

import torch
from jaxtyping import Bool, Float
from kornia.geometry.camera import PinholeCamera
from torch import Tensor

from hyperplanes.adaptation.base import Adapter, Pictures, Renderable
from hyperplanes.geometry import cameras as camera
from hyperplanes.geometry.image_planes import ImagePlanes
from hyperplanes.geometry.rays import Rays, cast, pixel_grid
from hyperplanes.utilities.arguments import checked
from hyperplanes.views import Views

__all__ = ["ResidualField", "WithResiduals"]

SHARPNESS = 10.0  # of weights over the angle between rays: a third at 27 degrees
WIDEST = 0.5  # cosine of the angle between viewing directions from which on a support view counts: 60 degrees
TOLERANCE = 0.06  # of the radius, by which a support view may see a surface in front or behind, at a weight of 1 / e
DOUBT = 0.03  # weight of no residual at all
FAINT, SOLID = 0.01, 1 / 3  # opacity of a pixel from which on it is corrected, and from which on wholly
PIXELS = 1 << 14  # corrected at once


@dataclass(frozen=True)
class ResidualField:
    """A field whose pictures are corrected by its support views; opacity and depth stay those of the field.

    The support views near a new one are rendered when they are first needed, and kept.

    Attributes:
        uncorrected: the field, on the device of the views.
        views: its support views, with their colours over what the field renders behind the object.
    """

    uncorrected: Renderable
    views: Views
    _residuals: dict[int, Tensor] = field(default_factory=dict, init=False, repr=False, compare=False)
    _lock: Any = field(default_factory=Lock, init=False, repr=False, compare=False)

    @checked
    @torch.no_grad()
    def render(self, cameras: PinholeCamera) -> Pictures:
        """The pictures of cameras, with what the field lacks in the support views.

        Args:
            cameras: any number, one image size.

        Returns:
            One picture a camera, with colours in [0, 1].
        """
        pictures, near = self.uncorrected.render(cameras), self._near(cameras)
        self._compute(near.any(0).nonzero()[:, 0].tolist())
        images = pictures.images.clone()
        pixels = pixel_grid(*camera.image_size(cameras), images.device)
        for view, chosen in enumerate(each.nonzero()[:, 0].tolist() for each in near):
            if not chosen:
                continue
            maps = torch.stack([self._residuals[each] for each in chosen])
            planes = ImagePlanes(maps, camera.select(self.views.cameras, chosen), 0.0, exact=True)
            opacity, depth = (each[view].flatten() for each in (pictures.opacity, pictures.depth))
            for part in ((opacity > FAINT) & (depth > 0)).nonzero()[:, 0].split(PIXELS):
                rays = cast(cameras, torch.full_like(part, view), pixels[part], self.views.bounds)
                whole = (opacity[part] / SOLID).clamp(max=1)
                images[view].view(3, -1)[:, part] += (whole[:, None] * self._blended(planes, rays, depth[part])).T
        return replace(pictures, images=images.clamp(0, 1))

    def _near(self, cameras: PinholeCamera) -> Bool[Tensor, "camera view"]:
        """The support views that look at the scene from the side of each camera."""
        towards = camera.camera_directions(cameras, self.views.bounds.centre).to(self._directions)
        return towards @ self._directions.T > WIDEST

    @cached_property
    def _directions(self) -> Float[Tensor, "view 3"]:
        """Unit vectors from the centre of the scene to the cameras of the support views."""
        return self.views.camera_directions

    def _compute(self, chosen: Sequence[int]) -> None:
        """Of support views whose residuals are not known yet: these, depth times opacity, and opacity."""
        with self._lock:
            missing = [view for view in chosen if view not in self._residuals]
            if missing:
                views = self.views[missing]
                own = self.uncorrected.render(views.cameras)
                lacking = views.images.to(own.images) - own.images
                maps = torch.cat([lacking, own.depth * own.opacity, own.opacity], 1)
                self._residuals.update(zip(missing, maps, strict=True))

    def _blended(self, planes: ImagePlanes, rays: Rays, depth: Float[Tensor, " ray"]) -> Float[Tensor, "ray 3"]:
        """The weighted mean of the residuals of support views where rays end."""
        points = rays.at(depth.to(rays.directions)).float()
        found = planes.lookup(points, return_directions=True)
        assert found.directions is not None
        assert found.distances is not None
        residual, moment, opacity = found.colours.split([3, 1, 1], -1)
        apart = found.distances - (moment / opacity.clamp_min(1e-3)).squeeze(-1)
        aside = 1 - (found.directions * rays.directions.to(points)[:, None]).sum(-1)
        weights = torch.exp(-(apart / (TOLERANCE * self.views.bounds.radius)).square() - SHARPNESS * aside)
        weights = (weights * found.valid)[..., None]
        return (weights * residual).sum(1) / (weights.sum(1) + DOUBT)


@dataclass(frozen=True)
class WithResiduals:
    """A method whose fields are corrected by their support views.

    Attributes:
        method: what makes the fields.
    """

    method: Adapter

    def adapt(self, support: Views) -> ResidualField:
        """The field of one object, corrected.

        Args:
            support: its views.
        """
        return ResidualField(self.method.adapt(support), support)
