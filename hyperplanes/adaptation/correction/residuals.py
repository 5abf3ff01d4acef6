"""Residual correction: residuals of the support views of a field are blended and added to new pictures.

A field cannot reproduce all of its support views: its surfaces are soft, and thin parts half transparent. The residual
of each support view, its image minus the picture that the field renders from its camera, is known. Residuals are
images, so new views blend them as image-based rendering blends colours (Buehler et al. 2001, "Unstructured Lumigraph
Rendering"): from support views that see the same surface, with more weight the closer their rays are.

A field that reads images reproduces a support view better than any new view, because it reads that view itself. So its
residual is computed with a penalty on it, as if it were as far away as support views are from a new one.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from threading import RLock

import torch
from jaxtyping import Bool, Float
from kornia.geometry.camera import PinholeCamera
from torch import Tensor

from hyperplanes.adaptation.base import AdaptedField, Pictures, Renderable, attributes_of
from hyperplanes.adaptation.network import HyperPlanesNetwork
from hyperplanes.geometry import cameras as camera
from hyperplanes.geometry.chosen_views import PENALTY_RADIANS
from hyperplanes.geometry.image_planes import ImagePlanes
from hyperplanes.geometry.rays import Rays, cast, pixel_grid
from hyperplanes.rendering.compositing import Rendered
from hyperplanes.rendering.refinement import RefinedOccupancy
from hyperplanes.rendering.renderer import Sampler
from hyperplanes.utilities.machine.memory import require_memory
from hyperplanes.utilities.messages.arguments import checked
from hyperplanes.utilities.tensors.precision import without_autocast
from hyperplanes.views import Views

__all__ = ["CorrectedField", "ResidualField", "are_corrected", "corrected_field"]

ANGULAR_FALLOFF = 10.0  # of weights as a function of 1 - the cosine of the angle between rays: a third at 27 degrees
MAX_COSINE_DISTANCE = 0.5  # value of 1 - cosine from which on the weight is 0: 60 degrees
DISTANCE_SCALE = 0.25  # distance from the surface that a support view sees, in radii, at which the weight is 1 / e
DOUBT = 0.1  # weight of a residual of zero
OWN_VIEW_ANGLE = 0.4  # radians that a support view counts as farther away when its own residual is computed
MIN_CORRECTED_VIEWS = 3  # two gain 0.04 dB, one 0.01 (docs/image-based-measurements.md)
MIN_CORRECTED_OPACITY = 0.01  # from which on a pixel is corrected in part
FULL_CORRECTION_OPACITY = 1 / 3  # and in full
PAIR_CHUNK = 1 << 18  # of a pixel and a support view, processed at once
MAX_SUPPORT_PIXELS = 1 << 21  # of support views, such as 52 of 200x200, which take 20 s of two cores

_rendering = RLock()  # so that two threads that need the same support views render them once


class ResidualField:
    """A field with residual correction of its pictures; opacity and depth stay those of the field.

    Support views near a new view are rendered on first use and kept, at 20 bytes a pixel.
    """

    def __init__(self, uncorrected: Renderable, views: Views) -> None:
        """A field and its support views.

        Args:
            uncorrected: the field.
            views: its support views, over the background that the field renders.
        """
        count, (height, width) = len(views), views.size
        needed = 20 * count * height * width
        require_memory("views", f"{count} of {width}x{height}", needed, "show fewer or smaller ones")
        self.uncorrected = uncorrected
        self.views = views
        self._planes = ImagePlanes(views.images.new_zeros(count, 5, height, width), views.cameras, 0.0, exact=True)
        self._known: set[int] = set()  # views with residual, depth times opacity, and opacity in the planes

    def __repr__(self) -> str:
        return f"ResidualField({self.uncorrected!r}, {self.views!r})"

    @checked
    @without_autocast
    @torch.no_grad()
    def render(self, cameras: PinholeCamera) -> Pictures:
        """The corrected pictures of cameras.

        Args:
            cameras: any number, one image size, on any device and in any precision.

        Returns:
            One picture a camera, with colours in [0, 1].
        """
        return self.correct(self.uncorrected.render(cameras), cameras)

    @torch.no_grad()
    def correct(self, pictures: Pictures, cameras: PinholeCamera) -> Pictures:
        """Corrected pictures.

        Args:
            pictures: of the field, one a camera.
            cameras: as in `render`.
        """
        images, cameras = pictures.images.clone(), camera.to(cameras, pictures.images.device)
        pixels = pixel_grid(*camera.image_size(cameras), images.device)
        for view in range(len(images)):
            opacity, depth = (each[view].flatten() for each in (pictures.opacity, pictures.depth))
            seen = ((opacity > MIN_CORRECTED_OPACITY) & (depth > 0)).nonzero()[:, 0]
            rays = cast(cameras, torch.full_like(seen, view), pixels[seen], self.views.bounds)
            added = self._blended(rays.at(depth[seen].to(rays.directions)), rays.directions).to(images)
            images[view].view(3, -1)[:, seen] += added.T * (opacity[seen] / FULL_CORRECTION_OPACITY).clamp(max=1)
        return replace(pictures, images=images.clamp(0, 1))

    @torch.no_grad()
    def prepare(self, on_view: Callable[[int], None] | None = None) -> None:
        """Render all support views now, instead of on first use.

        Args:
            on_view: called with the number of views done.
        """
        for view in range(len(self.views)):
            self._compute([view])
            if on_view is not None:
                on_view(view + 1)

    def _blended(self, points: Float[Tensor, "point 3"], directions: Float[Tensor, "point 3"]) -> Tensor:
        """The weighted mean of the residuals of support views at points seen along these directions."""
        points, directions = points.to(self._planes.images), directions.to(self._planes.images)
        size = max(1, PAIR_CHUNK // len(self.views))
        parts = list(zip(points.split(size), directions.split(size), strict=True))
        near = torch.zeros(len(self.views), dtype=torch.bool, device=points.device)
        for part in parts:
            near |= self._near(*part)
        chosen = near.nonzero()[:, 0]
        if not len(chosen):
            return torch.zeros_like(points)
        self._compute(chosen.tolist())
        blended = []
        for places, along in parts:
            found = self._planes.lookup(places, chosen.expand(len(places), -1), return_directions=True)
            assert found.directions is not None
            assert found.distances is not None
            residual, moment, opacity = found.colours.split([3, 1, 1], -1)
            apart = found.distances - (moment / opacity.clamp_min(1e-3)).squeeze(-1)
            aside = 1 - (found.directions * along[:, None]).sum(-1)
            weights = (
                torch.exp(-ANGULAR_FALLOFF * aside) - math.exp(-ANGULAR_FALLOFF * MAX_COSINE_DISTANCE)
            ).clamp_min(0)
            # outside of an image opacity is 0, so the surface seems to be at the camera, and the weight is 0
            weights = weights * torch.exp(-(apart / (DISTANCE_SCALE * self.views.bounds.radius)).square())
            blended.append((weights[..., None] * residual).sum(1) / (weights.sum(1, keepdim=True) + DOUBT))
        return torch.cat(blended)

    def _near(self, points: Float[Tensor, "point 3"], directions: Float[Tensor, "point 3"]) -> Bool[Tensor, " view"]:
        """The support views with a weight above 0 for any of the points."""
        offsets = points[:, None] - camera.centres(self._planes.cameras).to(points)
        cosines = (torch.nn.functional.normalize(offsets, dim=-1) * directions[:, None]).sum(-1)
        return (1 - cosines < MAX_COSINE_DISTANCE).any(0)

    def _beside(self, view: int) -> Renderable:
        """The field, which reads a support view as if it stood OWN_VIEW_ANGLE farther away."""
        if not isinstance(self.uncorrected, AdaptedField):
            return self.uncorrected
        centre = camera.centres(self._planes.cameras)[view]
        return self.uncorrected.with_penalty_at(centre, OWN_VIEW_ANGLE / PENALTY_RADIANS)

    def _compute(self, chosen: list[int]) -> None:
        """Computes residual, depth times opacity, and opacity of the chosen support views, unless done already.

        One at a time: a picture depends a little on the others of its call (`AdaptedField.render`), and which views are
        missing depends on the pictures before.
        """
        with _rendering:
            for view in chosen:
                if view in self._known:
                    continue
                own = self._beside(view).render(camera.select(self._planes.cameras, [view]))
                lacking = self.views.images[[view]].to(own.images) - own.images
                maps = torch.cat([lacking, own.depth * own.opacity, own.opacity], 1)
                self._planes.images[view] = maps[0].to(self._planes.images)
                self._known.add(view)


@dataclass(frozen=True, repr=False)
class CorrectedField(AdaptedField):
    """A field whose pictures are corrected by residuals of its support views.

    Densities, colours, rays and meshes are those of the field, and so are pictures with a given sampler, or without
    the default of `antialias`: residuals are computed for pictures with the defaults.

    Attributes:
        uncorrected: the field.
        residuals: the correction.
    """

    uncorrected: AdaptedField = field(kw_only=True)
    residuals: ResidualField = field(kw_only=True)

    def __repr__(self) -> str:
        return f"CorrectedField({self.uncorrected!r}, {len(self.residuals.views)} views)"

    def without_residuals(self) -> AdaptedField:
        """As `AdaptedField.without_residuals`."""
        return self.uncorrected

    def with_penalty_at(self, centre: Float[Tensor, 3], penalty: float) -> CorrectedField:
        """This field: residuals that are corrected again are those of its pictures."""
        return self

    def with_sampling(self, sampling: Sampler) -> AdaptedField:
        """As `AdaptedField.with_sampling`; without correction if the sampler is another one."""
        return self if sampling == self.sampling else self.uncorrected.with_sampling(sampling)

    @property
    def refined_occupancy(self) -> RefinedOccupancy:
        """As `AdaptedField.refined_occupancy`."""
        return self.uncorrected.refined_occupancy

    def density(self, points: Float[Tensor, "point 3"]) -> Float[Tensor, " point"]:
        """As `AdaptedField.density`."""
        return self.uncorrected.density(points)

    def trace(self, rays: Rays, generator: torch.Generator | None = None, *, differentiable: bool = True) -> Rendered:
        """As `AdaptedField.trace`, without correction."""
        return self.uncorrected.trace(rays, generator, differentiable=differentiable)

    def _pictures(
        self, cameras: PinholeCamera, sampling: Sampler | None, antialias: bool | None, mixed_precision: bool
    ) -> Pictures:
        pictures = self.uncorrected.render(cameras, sampling, antialias, mixed_precision=mixed_precision)
        if sampling is not None or antialias not in (None, self.sampling.needs_occupancy):
            return pictures
        return self.residuals.correct(pictures, cameras)


def are_corrected(network: HyperPlanesNetwork, support: Views) -> bool:
    """Whether pictures of the field that a model makes are corrected.

    The model must be configured so, and there must be MIN_CORRECTED_VIEWS or more, with masks and at most
    MAX_SUPPORT_PIXELS.

    Args:
        network: the model.
        support: the views of the object.
    """
    height, width = support.size
    enough = len(support) >= MIN_CORRECTED_VIEWS and support.masks is not None
    return network.config.residuals and enough and len(support) * height * width <= MAX_SUPPORT_PIXELS


def corrected_field(network: HyperPlanesNetwork, adapted: AdaptedField, support: Views) -> AdaptedField:
    """A field with residual correction if `are_corrected`.

    Args:
        network: the model.
        adapted: its field.
        support: the views of the object.

    Returns:
        A `CorrectedField`, or the field itself.
    """
    if not are_corrected(network, support):
        return adapted
    residuals = ResidualField(adapted, network.to_own(support))
    return CorrectedField(**attributes_of(adapted), uncorrected=adapted, residuals=residuals)
