"""Residual correction: residuals of the support views of a field are blended and added to new pictures.

A field cannot reproduce all of its support views: its surfaces are soft, and thin parts half transparent. The residual
of each support view, its image minus the picture that the field renders from its camera, is known. Residuals are
images, so new views blend them as image-based rendering blends colours (Buehler et al. 2001, "Unstructured Lumigraph
Rendering"): from support views that see the same surface, with more weight the closer their rays are.

A field that reads images reproduces a support view better than any new view, because it reads that view itself. So its
residual is computed with a penalty on it, as if it were as far away as support views are from a new one.

After gradient steps, a mean of what a correction network finds and of the mean residual is often better than either,
above all if the poses or the exposures of the views are not exact. The share of the network in it is found by
leave-one-out cross-validation on the support views.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Bool, Float
from kornia.geometry.camera import PinholeCamera
from torch import Tensor

from hyperplanes.adaptation.base import AdaptedField, Pictures, Renderable, attributes_of
from hyperplanes.adaptation.correction_network import (
    DEPTH_OFFSETS,
    MEAN_RESIDUAL,
    MIN_CORRECTED_OPACITY,
    CorrectionNetwork,
    covered,
    readings,
)
from hyperplanes.adaptation.network import HyperPlanesNetwork
from hyperplanes.adaptation.reprojection import CHANNELS, Reprojected, nearest_views, reproject
from hyperplanes.geometry import cameras as camera
from hyperplanes.geometry.chosen_views import PENALTY_RADIANS
from hyperplanes.geometry.image_planes import ImagePlanes
from hyperplanes.geometry.rays import Rays, cast, pixel_grid
from hyperplanes.rendering.compositing import Rendered
from hyperplanes.rendering.refinement import RefinedOccupancy
from hyperplanes.rendering.renderer import Sampler
from hyperplanes.utilities.machine.locks import ForkSafeLock
from hyperplanes.utilities.machine.memory import require_memory
from hyperplanes.utilities.messages.arguments import checked
from hyperplanes.utilities.tensors.precision import without_autocast
from hyperplanes.views import Views

__all__ = ["CorrectedField", "ResidualField", "are_corrected", "corrected_field"]

OWN_VIEW_ANGLE = 0.4  # radians that a support view counts as farther away when its own residual is computed
MIN_CORRECTED_VIEWS = 3  # two gain 0.04 dB, one 0.01 (docs/image-based-measurements.md)
MIN_CROSS_VALIDATED_VIEWS = 5  # not measured with four; of three that are far apart none shows what another one does
LEFT_OUT_VIEWS = 8  # at most, one at a time
# Gradient steps fit the support views, so their residuals are smaller than the errors of new views, and the best share
# of the network for support views is below that for new ones (docs/image-based-measurements.md).
SHARE_FACTOR, MIN_SHARE = 1.4, 0.5
MAX_SUPPORT_PIXELS = 1 << 21  # of support views, such as 52 of 200x200, which take 20 s of two cores

_rendering = ForkSafeLock()  # so that two threads that need the same support views render them once


class ResidualField:
    """A field with residual correction of its pictures; opacity and depth stay those of the field.

    Support views near a new view are rendered on first use and kept, at 32 bytes a pixel. For a fine-tuned field with a
    correction network they are up to eight all around (`network_share`) and those near them.
    """

    def __init__(self, uncorrected: Renderable, views: Views, network: CorrectionNetwork | None = None) -> None:
        """A field and its support views.

        Args:
            uncorrected: the field.
            views: its support views, over the background that the field renders.
            network: which computes the correction from what the support views show; without it, the mean of their
                residuals is added. After gradient steps, a mean of both is added (`network_share`).
        """
        count, (height, width) = len(views), views.size
        needed = 4 * CHANNELS * count * height * width
        require_memory("views", f"{count} of {width}x{height}", needed, "show fewer or smaller ones")
        self.uncorrected = uncorrected
        self.views = views
        self.network = network
        self._planes = ImagePlanes(
            views.images.new_zeros(count, CHANNELS, height, width), views.cameras, 0.0, exact=True
        )
        self._known: set[int] = set()  # views whose channels are computed
        self._share: float | None = None

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
        images, cameras = pictures.images, camera.to(cameras, pictures.images.device)
        added = [self._added(pictures, cameras, view) for view in range(len(images))]
        return replace(pictures, images=(images + torch.stack(added).to(images)).clamp(0, 1) if added else images)

    @torch.no_grad()
    def readings(
        self, pictures: Pictures, cameras: PinholeCamera, view: int, without: int | None = None
    ) -> Float[Tensor, "16 height width"] | None:
        """The inputs of a correction network for one of these pictures; None if it shows nothing of the scene.

        Args:
            pictures: of the field, one a camera.
            cameras: as in `render`.
            view: index of the picture.
            without: index of a support view that is left out.
        """
        seen, rays, depth = self._surface(pictures, cameras, view)
        points = torch.stack([rays.at(depth + self.views.bounds.radius * offset) for offset in DEPTH_OFFSETS])
        found = self._reprojected(points, rays.directions, without)
        if found is None:
            return None
        image, opacity = pictures.images[view].to(depth), pictures.opacity[view, 0].to(depth)
        return readings(image, opacity, seen, found, len(self.views) - (without is not None))

    @without_autocast
    def network_share(self) -> float:
        """The share of the network in the correction of a fine-tuned field, the rest being the mean residual.

        It is found by leave-one-out cross-validation: the residual of a support view is predicted from the other views,
        for up to LEFT_OUT_VIEWS of them. The share with the least squared error is multiplied by SHARE_FACTOR, and
        limited to MIN_SHARE to 1. For other fields, and with fewer than MIN_CROSS_VALIDATED_VIEWS views, it is 1.
        """
        fine_tuned = isinstance(self.uncorrected, AdaptedField) and self.uncorrected.fine_tuned
        if self.network is None or not fine_tuned or len(self.views) < MIN_CROSS_VALIDATED_VIEWS:
            return 1.0
        if self._share is None:
            self._share = min(1.0, max(MIN_SHARE, SHARE_FACTOR * self._best_share()))
        return self._share

    @torch.no_grad()
    def _best_share(self) -> float:
        """The share of the network that predicts the residuals of support views from the other views best."""
        assert self.network is not None
        count = min(LEFT_OUT_VIEWS, len(self.views))
        chosen = [place * (len(self.views) - 1) // (count - 1) for place in range(count)]
        self._compute(chosen)
        product = square = 0.0
        for view in chosen:
            maps = self._planes.images[[view]]
            residual, moment, opacity, image = maps.split([3, 1, 1, 3], 1)
            own = Pictures(image - residual, opacity, moment / opacity.clamp_min(1e-3), samples=0)
            read = self.readings(own, camera.select(self._planes.cameras, [view]), 0, without=view)
            if read is None:
                continue
            mean = read[MEAN_RESIDUAL]
            change = self._network_output(read) - mean
            product += float(((residual[0] - mean) * change).sum())
            square += float(change.square().sum())
        return product / square if square > 0 else 1.0

    def _added(self, pictures: Pictures, cameras: PinholeCamera, view: int) -> Float[Tensor, "3 height width"]:
        """What is added to the colours of a picture."""
        if self.network is not None:
            read = self.readings(pictures, cameras, view)
            if read is None:
                return torch.zeros_like(pictures.images[0])
            return torch.lerp(read[MEAN_RESIDUAL], self._network_output(read), self.network_share())
        result = torch.zeros_like(pictures.images[view])
        seen, rays, depth = self._surface(pictures, cameras, view)
        found = self._reprojected(rays.at(depth)[None], rays.directions)
        if found is not None:
            result[:, seen] = found.residual[0].T.to(result) * covered(pictures.opacity[view, 0][seen])
        return result

    def _network_output(self, read: Float[Tensor, "16 height width"]) -> Float[Tensor, "3 height width"]:
        """What the network adds to a picture, from its inputs."""
        assert self.network is not None
        return self.network(read[None].to(next(self.network.parameters())))[0].to(read)

    def _surface(
        self, pictures: Pictures, cameras: PinholeCamera, view: int
    ) -> tuple[Bool[Tensor, "height width"], Rays, Float[Tensor, " pixel"]]:
        """The pixels of a picture that are corrected, their rays, and their depths."""
        opacity, depth = pictures.opacity[view, 0], pictures.depth[view, 0]
        seen = (opacity > MIN_CORRECTED_OPACITY) & (depth > 0)
        height, width = seen.shape
        pixels = pixel_grid(height, width, seen.device)[seen.flatten()]
        rays = cast(cameras, torch.full((len(pixels),), view, device=seen.device), pixels, self.views.bounds)
        rays = rays.to(self._planes.images.dtype)
        return seen, rays, depth[seen].to(rays.directions)

    @torch.no_grad()
    def prepare(self, on_view: Callable[[int], None] | None = None) -> None:
        """Render all support views now, instead of on first use, and find the share of the network.

        Args:
            on_view: called with the number of views done.
        """
        for view in range(len(self.views)):
            self._compute([view])
            if on_view is not None:
                on_view(view + 1)
        self.network_share()

    def _reprojected(
        self, points: Float[Tensor, "depth pixel 3"], directions: Float[Tensor, "pixel 3"], without: int | None = None
    ) -> Reprojected | None:
        """What support views show at points seen along these directions; None if no view sees any of them.

        Args:
            points: one or several of each ray, the farthest last.
            directions: of the rays.
            without: index of a support view that is left out.
        """
        chosen, near = nearest_views(self._planes, points[-1], directions, without)
        if not near.any():
            return None
        self._compute(near.nonzero()[:, 0].tolist())
        views, along = (each.repeat(len(points), 1) for each in (chosen, directions))
        found = reproject(self._planes, views, points.flatten(0, 1), along, self.views.bounds.radius)
        return found.map(lambda values: values.view(*points.shape[:2], -1))

    def _beside(self, view: int) -> Renderable:
        """The field, which reads a support view as if it stood OWN_VIEW_ANGLE farther away."""
        if not isinstance(self.uncorrected, AdaptedField):
            return self.uncorrected
        centre = camera.centres(self._planes.cameras)[view]
        return self.uncorrected.with_penalty_at(centre, OWN_VIEW_ANGLE / PENALTY_RADIANS)

    def _compute(self, chosen: list[int]) -> None:
        """Computes the channels of the chosen support views, unless done already.

        One at a time: a picture depends a little on the others of its call (`AdaptedField.render`), and which views are
        missing depends on the pictures before.
        """
        with _rendering:
            for view in chosen:
                if view in self._known:
                    continue
                own = self._beside(view).render(camera.select(self._planes.cameras, [view]))
                image = self.views.images[[view]].to(own.images)
                maps = torch.cat([image - own.images, own.depth * own.opacity, own.opacity, image], 1)
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
    if network.config.fine_tuned:
        adapted = replace(adapted, fine_tuned=True)
    if not are_corrected(network, support):
        return adapted
    corrector = network.corrector if network.config.learned_correction else None
    residuals = ResidualField(adapted, network.to_own(support), corrector)
    return CorrectedField(**attributes_of(adapted), uncorrected=adapted, residuals=residuals)
