"""Support colours blended on the visual hull: a baseline without learning."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Annotated, ClassVar

import torch
from jaxtyping import Float
from torch import Tensor

from hyperplanes.adaptation.base import AdaptedField, hull
from hyperplanes.geometry.chosen_views import Penalties, Reading
from hyperplanes.geometry.occupancy import LARGEST_SIDE, Occupancy
from hyperplanes.geometry.poses import Count
from hyperplanes.geometry.rays import Rays, Sphere
from hyperplanes.geometry.visibility.hull_hits import centres_in_hull, hull_hits
from hyperplanes.geometry.visibility.planes import VisibilityPlanes
from hyperplanes.rendering.refinement import RefinedOccupancy
from hyperplanes.rendering.renderer import RayMarching
from hyperplanes.rendering.sampling.samplers import OpaqueSamples, PackedSamples
from hyperplanes.utilities.messages.arguments import checked, checked_fields
from hyperplanes.views import Views

__all__ = ["HullBlend", "blend_views"]

HULL_DENSITY = 1e4  # density within the hull, per radius of the scene
# transmittance; low enough to evaluate every sample: with every second one wings lose 0.05 to 0.5 dB
STOP_TRANSMITTANCE = 2e-3
MASK_THRESHOLD = 0.5  # opacity of a mask from which on a pixel shows the object
# difference of opacities between kernels: without it 5 of 424,000 samples in the hull were holes
OPACITY_TOLERANCE = 1e-4


@checked_fields
@dataclass(frozen=True)
class HullBlend:
    """The visual hull of the support masks as an opaque surface, with blended colours of the support views that see it.

    A point lies in the hull unless a view shows background there. Its colour is a mean of the `nearest` of the support
    views that see it, with the weights of the unstructured lumigraph (`blend_views`). A view sees a point if no part of
    the hull lies in front of it and the mask is opaque there, so that no background is mixed into the colour. If fewer
    views see the point, the nearest of the others are added.

    Attributes:
        nearest: number of views whose colours are blended.
        side: voxels an axis of the hull, for ray marching and for the visibility of points.
        steps: samples along a diameter of the scene.
    """

    nearest: Count = 3
    side: Annotated[int, range(1, LARGEST_SIDE + 1)] = 96
    steps: Count = 256

    @checked
    @torch.no_grad()
    def adapt(self, support: Views) -> AdaptedField:
        """The hull with its colours; raises as `planes_of` does."""
        return self.adapt_to(self.planes_of(support))

    def planes_of(self, support: Views, within: Occupancy | None = None) -> VisibilityPlanes:
        """The views and their hull, as `adapt_to` takes them.

        Args:
            support: the views.
            within: voxels that the hull is known to lie in; `side` an axis.

        Raises:
            ValueError: views without masks, or masks whose hull is empty.
        """
        if support.masks is None:
            raise ValueError("hull_blend: expected support views with masks, got none; images with alpha have them")
        support = support.to(dtype=torch.float32)
        return VisibilityPlanes(support.images, support.cameras, support.masks, hull(support, self.side, within))

    @torch.no_grad()
    def adapt_to(self, planes: VisibilityPlanes) -> AdaptedField:
        """As `adapt`, of views with a visual hull.

        Args:
            planes: the views, with masks; the resolution of their hull is used, not `side`.
        """
        region = planes.occupancy
        # voxels whose centre lies in the hull: with all voxels that it touches, its surface would seem too near
        inside = centres_in_hull(planes, MASK_THRESHOLD - OPACITY_TOLERANCE)
        depth = inside.occupied * (2 * HULL_DENSITY / len(region.occupied))
        voxels = RefinedOccupancy(region.occupied, region.bounds, depth)
        shown = planes.with_penalties(Penalties.binary()).with_surface(inside)
        blend = _Blend(shown, region.bounds, self.nearest)
        sampling = _FirstInHull(self.steps, STOP_TRANSMITTANCE, planes=planes)
        return AdaptedField(blend, region, sampling, densities=(blend.density,), refined=voxels)


def blend_views(
    planes: VisibilityPlanes, points: Float[Tensor, "point 3"], directions: Float[Tensor, "point 3"], nearest: int
) -> Float[Tensor, "point 3"]:
    """The weighted mean of the colours of the nearest views that see a point (`lumigraph_weights`).

    Args:
        planes: the views.
        points: in the world.
        directions: unit vectors along which the points are seen.
        nearest: number of views, at most all.
    """
    if planes.can_describe(points, directions):
        near = planes.describe(points, directions, Reading(0, nearest, 0, 0, 0.0), planes.occupancy.bounds)
        weights, colours = near.near_weights.softmax(1), near.near_colours
    else:
        seen = planes.choose(points, directions, best=0, nearest=nearest).nearest
        assert seen is not None
        weights = seen.lumigraph_weights(seen.angles(directions), min(nearest, len(planes)))
        weights = weights / weights.sum(1, keepdim=True)
        colours = planes.colours.lookup(points).colours
        colours = colours.gather(1, seen.first(nearest).views[..., None].expand(-1, -1, 3))
    return (weights[..., None] * colours).sum(1)


@dataclass(frozen=True)
class _FirstInHull(RayMarching):
    """Ray marching that keeps the first sample of each ray in the hull: all that is seen of an opaque field.

    Attributes:
        planes: the views whose masks are the hull.
    """

    planes: VisibilityPlanes = field(kw_only=True, repr=False)

    def for_rendering(self, pixels: float) -> _FirstInHull:
        """As `RayMarching.for_rendering`."""
        finer = super().for_rendering(pixels)
        return replace(self, steps=finer.steps, stop=finer.stop)

    def place(self, rays: Rays, occupancy: Occupancy | None, generator: torch.Generator | None = None) -> PackedSamples:
        """As `RayMarching.place`; all samples if they are random or no kernel takes the rays."""
        if occupancy is None or generator is not None or not self.planes.has_kernels(rays.origins):
            return super().place(rays, occupancy, generator)
        step = 2 * occupancy.bounds.radius / self.steps
        distances = hull_hits(self.planes, rays, rays.near + step / 2, step, occupancy, MASK_THRESHOLD)
        ray = distances.isfinite().nonzero()[:, 0]
        return OpaqueSamples(ray, distances[ray], step)


@dataclass(frozen=True)
class _Blend:
    """The visual hull as an opaque field, with colours of the support views."""

    planes: VisibilityPlanes
    bounds: Sphere
    nearest: int

    thread_safe: ClassVar[bool] = True

    @property
    def dtype(self) -> torch.dtype:
        """The dtype of the views, in which points are expected."""
        return self.planes.maps.dtype

    def __call__(
        self, points: Float[Tensor, "point 3"], directions: Float[Tensor, "point 3"]
    ) -> tuple[Float[Tensor, "point 3"], Float[Tensor, " point"]]:
        """The blended colours, and the density."""
        return blend_views(self.planes, points, directions, self.nearest), self.density(points)

    def density(self, points: Float[Tensor, "point 3"]) -> Float[Tensor, " point"]:
        """High where every view that shows a point shows the object there, otherwise 0."""
        coverage = self.planes.choose(points, best=0).coverage
        return torch.where(coverage < MASK_THRESHOLD - OPACITY_TOLERANCE, 0.0, HULL_DENSITY / self.bounds.radius)

    def hidden(self, points: Float[Tensor, "point 3"]) -> Float[Tensor, "point 3"]:
        """The points themselves: densities and colours share no computation."""
        return points

    def density_of(self, hidden: Float[Tensor, "point 3"]) -> Float[Tensor, " point"]:
        """The density."""
        return self.density(hidden)

    def colour_of(
        self, hidden: Float[Tensor, "point 3"], directions: Float[Tensor, "point 3"]
    ) -> Float[Tensor, "point 3"]:
        """The blended colours."""
        return blend_views(self.planes, hidden, directions, self.nearest)
