"""How well views are explained by the visual hull of them and their reflections, and the best plane of reflection."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from hyperplanes.adaptation.baselines.hull_blend import HullBlend
from hyperplanes.adaptation.context import live_pixels
from hyperplanes.adaptation.symmetry.reflections import HULL_SIDE, MIN_OBJECT_OPACITY, images_by
from hyperplanes.geometry.kernels.threads import map_long_parts
from hyperplanes.geometry.occupancy import Occupancy, carve
from hyperplanes.geometry.rays import Rays, Sphere, join_rays
from hyperplanes.geometry.symmetry.reflections import Plane, Symmetry
from hyperplanes.geometry.visibility.planes import VisibilityPlanes
from hyperplanes.rendering.footprint import footprint
from hyperplanes.rendering.images import EDGE_SUBPIXELS, EDGE_THRESHOLD, pixels_at_edges
from hyperplanes.views import Views

__all__ = ["MAX_ERROR_RATIO", "SymmetryJudge", "best_vertical_plane", "carved"]

JUDGED_SIZE, COARSE_SIZE = 64, 32  # most pixels of views along the longer side: to judge a plane, and to search for one
COARSE_HULL = 48  # voxels an axis, to search for one
STEPS_PER_VOXEL = 2  # of rays in a voxel
AZIMUTHS = 24  # number of vertical planes that are tried
MAX_SECOND_ERROR_RATIO = 1.5  # times the least error, up to which the second best of these is refined too
COARSE_ROUNDS, FINE_ROUNDS = 3, 2  # of refinement
OFFSET_STEP = 0.04  # first change of a plane's offset, in radii of the scene
LOST = 0.05  # fraction of the object's pixels that the hull with reflections may miss
# share of the object that the blend must show in opaque pixels: it is 0.26 or more for procedural objects, and at most
# 0.08 for asymmetric figures of thin wire that any plane would fit
MIN_SHOWN = 0.1
MAX_ERROR_RATIO = 1.75  # times the squared error without reflections, up to which an object counts as symmetric
# added to the squared error per pixel of the object; smaller errors come from the voxels of the hull
ERROR_OFFSET = 3e-3

ORDERS = {2: (), 3: (), 4: (2,), 6: (2, 3), 8: (2, 4)}
"""Orders that are tried, each with the lower ones that it implies."""
MOST_IMAGES = 64  # views and reflections; more do not improve pictures and take longer
MAX_REFLECTED_PIXELS = 1 << 25  # for several planes: with 192 million adapting takes 10 GB and ten times as long
WORTH = 0.5  # the error may grow with this power of the order


@dataclass(frozen=True)
class _PixelRays:
    """Rays through pixels of views, cast once, as for pictures: five through pixels at edges.

    Attributes:
        rays: of all pixels.
        pixels: flat index (view, row, column) of the pixel of each ray.
        shares: weight of each ray in its pixel.
    """

    rays: Rays
    pixels: Int[Tensor, " ray"]
    shares: Float[Tensor, " ray"]

    @classmethod
    def of(cls, views: Views, pixels: Int[Tensor, " pixel"]) -> _PixelRays:
        """The rays of pixels of views with masks."""
        assert views.masks is not None
        # after scaling down, an edge is two pixels wide, and each differs half as much
        values = torch.cat([views.images, views.masks], 1).permute(0, 2, 3, 1)
        edges = pixels[pixels_at_edges(values, EDGE_THRESHOLD / 2).flatten()[pixels]]
        centres, _, _ = views.rays_at(pixels)
        others, _, _ = views.rays_at(edges, subpixels=EDGE_SUBPIXELS[1:])
        through = torch.cat([pixels, edges.repeat(len(EDGE_SUBPIXELS) - 1)])
        return cls(join_rays(centres, others), through, 1 / through.bincount()[through])

    def picture(self, colours: Float[Tensor, "ray 3"], shape: torch.Size) -> Float[Tensor, "view 3 height width"]:
        """Images of the mean colour of the rays in each pixel, white elsewhere; `shape` is (view, 1, height, width)."""
        found = colours.new_ones(shape.numel(), 3).index_fill_(0, self.pixels, 0.0)
        found.index_add_(0, self.pixels, colours * self.shares[:, None])
        return found.unflatten(0, (shape[0], *shape[2:])).permute(0, 3, 1, 2)


@dataclass(frozen=True)
class SymmetryJudge:
    """How well `HullBlend` of views and their reflections renders the views.

    Attributes:
        views: scaled down.
        voxels: their visual hull.
        rays: through the pixels of the views that may show the hull.
        alone: squared error without reflections, plus `floor`; infinite if the views show too little to judge by.
        floor: added to all squared errors.
    """

    views: Views
    voxels: Occupancy
    rays: _PixelRays
    alone: float
    floor: float

    @classmethod
    def of(cls, support: Views, size: int = JUDGED_SIZE, side: int = HULL_SIDE) -> SymmetryJudge:
        """The judge of views with masks, resized to at most `size` pixels along the longer side."""
        views = support.resized(size)
        assert views.masks is not None
        voxels, floor = carved(views, side), ERROR_OFFSET * float((views.masks >= MIN_OBJECT_OPACITY).sum())
        judge = cls(views, voxels, _PixelRays.of(views, live_pixels(voxels, views)), 1.0, floor)
        return replace(judge, alone=judge.squared_error(None) + floor)

    def errors(self, planes: Sequence[Plane], most: float = math.inf) -> dict[Plane, float]:
        """The errors of the planes for which they are finite and at most `most`."""
        errors = map_long_parts(lambda plane: self.error(Symmetry(plane)), planes, self.views.images.device)
        found = zip(planes, errors, strict=True)
        return {plane: error for plane, error in found if error <= most and math.isfinite(error)}

    def several(
        self, plane: Plane, error: float, given: Views, least: int = 2, most: float = MAX_ERROR_RATIO
    ) -> tuple[Symmetry, float] | None:
        """The most likely symmetry of several planes, one of which is known, and its error divided by order**WORTH.

        Args:
            plane: the known one.
            error: of that plane alone.
            given: all views of the object, which are to be reflected.
            least: least order.
            most: largest error.

        Returns:
            None if it is more likely that there is no other plane.
        """
        if abs(plane.normal[1]) > 1e-6:
            return None
        centre = self.views.bounds.centre
        apart = sum(a * b for a, b in zip(plane.normal, centre, strict=True)) - plane.offset
        x, y, z = (a - apart * b for a, b in zip(centre, plane.normal, strict=True))
        room = min(MOST_IMAGES // len(given), MAX_REFLECTED_PIXELS // given.images[:, 0].numel())
        found, best, possible = None, error, set[int]()
        for order, parts in ORDERS.items():
            symmetry = Symmetry(plane, order, (x, y, z))
            if symmetry.images > room or not possible.issuperset(parts):
                continue
            error = self.error(symmetry)
            if error > MAX_ERROR_RATIO:
                continue
            possible.add(order)
            if order >= least and error <= most and error / order**WORTH < best:
                found, best = symmetry, error / order**WORTH
        return None if found is None else (found, best)

    def error(self, symmetry: Symmetry) -> float:
        """The squared error relative to that without reflections; infinite if too little of the object is shown."""
        return (self.squared_error(symmetry) + self.floor) / self.alone if math.isfinite(self.alone) else math.inf

    def squared_error(self, symmetry: Symmetry | None) -> float:
        """The squared error with which `HullBlend` of the views and their reflections renders the views.

        Args:
            symmetry: of the reflections, if there are any.

        Returns:
            The sum over pixels. Infinite if the hull with reflections loses too many of them, or if `HullBlend` shows
            hardly any of those in which the masks are opaque: it is empty where masks are half transparent, and where
            parts are thinner than a pixel.
        """
        views, shown, voxels = self.views, self.views, self.voxels
        assert views.masks is not None
        seen, among = views.masks >= MIN_OBJECT_OPACITY, torch.ones_like(views.masks, dtype=torch.bool)
        if symmetry is not None:
            shown = images_by(views, symmetry)
            voxels = carved(shown[len(views) :], len(voxels.occupied), voxels)
            held = footprint(voxels, views.cameras)[:, None]
            if not voxels.occupied.any() or float((seen & ~held).sum()) > LOST * float(seen.sum()):
                return math.inf
            among = held | ~seen
        assert shown.masks is not None
        planes = VisibilityPlanes(shown.images, shown.cameras, shown.masks, voxels)
        blend = HullBlend(steps=STEPS_PER_VOXEL * len(voxels.occupied)).adapt_to(planes)
        traced = blend.trace(self.rays.rays, differentiable=False)
        visible = (traced.opacity * self.rays.shares)[seen.flatten()[self.rays.pixels]].sum()
        if float(visible) <= MIN_SHOWN * float(views.masks.sum()):
            return math.inf
        found = self.rays.picture(traced.colour, views.masks.shape)
        return float((found - views.images).square().mean(1, keepdim=True)[among].sum())


def best_vertical_plane(judge: SymmetryJudge, views: Views) -> Plane:
    """The vertical plane of reflection with the least error.

    Planes of all azimuths are tried on smaller pictures, then planes near the best one or two, and finally, on larger
    pictures, planes near the best of these. A few degrees off the right plane the error is several times as large.

    Args:
        judge: for the larger pictures.
        views: of the object.
    """
    coarse, step = SymmetryJudge.of(views, COARSE_SIZE, COARSE_HULL), math.pi / AZIMUTHS
    angles = {_vertical(views.bounds, index * step): index * step for index in range(AZIMUTHS)}
    errors = coarse.errors(list(angles))
    if not errors:
        return next(iter(angles))
    first, *others = sorted(errors, key=errors.__getitem__)
    apart = [each for each in others if abs(math.sin(angles[each] - angles[first])) > math.sin(1.5 * step)]
    likely = [first, *(each for each in apart[:1] if errors[each] <= MAX_SECOND_ERROR_RATIO * errors[first])]
    nearer = [_refined(coarse, (angles[each], 0.0), (step / 2, 0.0), COARSE_ROUNDS) for each in likely]
    start, _ = min(nearer, key=lambda each: each[1])
    (angle, offset), _ = _refined(judge, start, (step / 2**COARSE_ROUNDS, OFFSET_STEP), FINE_ROUNDS)
    return _vertical(views.bounds, angle, offset)


def carved(views: Views, side: int = HULL_SIDE, within: Occupancy | None = None) -> Occupancy:
    """The visual hull of views with masks, which may be empty; only the part inside `within`, if given."""
    assert views.masks is not None
    return carve(views.masks, views.cameras, views.bounds, side, within=within)


def _refined(
    judge: SymmetryJudge, start: tuple[float, float], steps: tuple[float, float], rounds: int
) -> tuple[tuple[float, float], float]:
    """Azimuth and offset of the best vertical plane found near another one, and its error.

    Args:
        judge: of the views.
        start: azimuth and offset of the other one.
        steps: first changes of both, halved in each further round.
        rounds: number of rounds.
    """
    (angle, offset), (turn, shift), bounds = start, steps, judge.views.bounds
    error = judge.error(Symmetry(_vertical(bounds, angle, offset)))
    for _ in range(rounds):
        around = [(angle + turn, offset), (angle - turn, offset)]
        around += [(angle, offset + shift), (angle, offset - shift)] if shift else []
        tried = {_vertical(bounds, *each): each for each in around}
        errors = judge.errors(list(tried), error)
        if errors:
            best = min(errors, key=errors.__getitem__)
            (angle, offset), error = tried[best], errors[best]
        turn, shift = turn / 2, shift / 2
    return (angle, offset), error


def _vertical(bounds: Sphere, angle: float, offset: float = 0.0) -> Plane:
    """The vertical plane whose normal has this azimuth, at an offset from the centre of the scene in radii."""
    return Plane.of_sphere(bounds, (math.cos(angle), 0.0, math.sin(angle)), offset)
