"""How well views are shown by their visual hull with reflections, and the plane by which they are shown best."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from hyperplanes.adaptation.context import live_pixels
from hyperplanes.adaptation.hull_blend import HullBlend
from hyperplanes.adaptation.reflections import HULL_SIDE, SHOWN, images_by
from hyperplanes.geometry.kernels.threads import side_by_side
from hyperplanes.geometry.occupancy import Occupancy, carve
from hyperplanes.geometry.rays import Rays, Sphere, join_rays
from hyperplanes.geometry.reflections import Plane, Symmetry
from hyperplanes.geometry.visibility import VisibilityPlanes
from hyperplanes.rendering.footprint import footprint
from hyperplanes.rendering.images import EDGE, EDGE_SUBPIXELS, pixels_at_edges
from hyperplanes.views import Views

__all__ = ["TOLERANCE", "SymmetryJudge", "best_vertical_plane", "carved"]

SIZE, COARSE_SIZE = 64, 32  # pixels of views along the longer side, at most: to judge a plane, and to look for one
COARSE_HULL = 48  # voxels an axis, to look for one
STEPS = 2  # of rays in a voxel
AZIMUTHS = 24  # of vertical planes that are tried
NEARLY = 1.5  # times the error of the best of these, up to which better ones are looked for near to the second, too
COARSE_ROUNDS, FINE_ROUNDS = 3, 2  # of looking for better ones
SPAN = 0.04  # radii of the scene, by which planes are moved first
LOST = 0.05  # share of the object's pixels that the hull with reflections may miss
TOLERANCE = 1.75  # times the squared error without reflections, by which the views still show the same object
FLOOR = 3e-3  # of that error in a pixel of the object; smaller ones are those of the hull's voxels

ORDERS = {2: (), 3: (), 4: (2,), 6: (2, 3), 8: (2, 4)}
"""Orders that are tried, and those that an object of such a symmetry has, too."""
MOST_IMAGES = 64  # views and reflections; more make no better pictures, and take longer
MOST_PIXELS = 1 << 25  # of them about several planes: with 192 million adapting takes 10 GB and ten times as long
WORTH = 0.5  # power of the order by which the error may grow


@dataclass(frozen=True)
class _PixelRays:
    """Rays through pixels of views as pictures are rendered, which are cast once: five where the views have an edge.

    Attributes:
        rays: of all pixels.
        pixels: that each goes through, as flat indices (view, row, column).
        shares: of each in its pixel.
    """

    rays: Rays
    pixels: Int[Tensor, " ray"]
    shares: Float[Tensor, " ray"]

    @classmethod
    def of(cls, views: Views, pixels: Int[Tensor, " pixel"]) -> _PixelRays:
        """The rays of pixels of views with masks."""
        assert views.masks is not None
        # an edge of a picture that was scaled down is two pixels wide, each of which differs half as much
        values = torch.cat([views.images, views.masks], 1).permute(0, 2, 3, 1)
        edges = pixels[pixels_at_edges(values, EDGE / 2).flatten()[pixels]]
        centres, _, _ = views.rays_at(pixels)
        others, _, _ = views.rays_at(edges, subpixels=EDGE_SUBPIXELS[1:])
        through = torch.cat([pixels, edges.repeat(len(EDGE_SUBPIXELS) - 1)])
        return cls(join_rays(centres, others), through, 1 / through.bincount()[through])

    def picture(self, colours: Float[Tensor, "ray 3"], shape: torch.Size) -> Float[Tensor, "view 3 height width"]:
        """The means of the colours of rays in masks of a shape (view, 1, height, width); white elsewhere."""
        found = colours.new_ones(shape.numel(), 3).index_fill_(0, self.pixels, 0.0)
        found.index_add_(0, self.pixels, colours * self.shares[:, None])
        return found.unflatten(0, (shape[0], *shape[2:])).permute(0, 3, 1, 2)


@dataclass(frozen=True)
class SymmetryJudge:
    """How well views are shown by `HullBlend` of them and their reflections.

    Attributes:
        views: small ones.
        voxels: their visual hull.
        rays: through the pixels of the views that may show it.
        alone: squared error without reflections, and FLOOR.
        floor: of all errors.
    """

    views: Views
    voxels: Occupancy
    rays: _PixelRays
    alone: float
    floor: float

    @classmethod
    def of(cls, support: Views, size: int = SIZE, side: int = HULL_SIDE) -> SymmetryJudge:
        """The judge of views with masks, so many pixels along the longer side at most."""
        views = support.resized(size)
        assert views.masks is not None
        voxels, floor = carved(views, side), FLOOR * float((views.masks >= SHOWN).sum())
        judge = cls(views, voxels, _PixelRays.of(views, live_pixels(voxels, views)), 1.0, floor)
        return replace(judge, alone=judge.squared_error(None) + floor)

    def errors(self, planes: Sequence[Plane], most: float = math.inf) -> dict[Plane, float]:
        """Those of the planes by which they are at most so large, and finite."""
        errors = side_by_side(lambda plane: self.error(Symmetry(plane)), planes, self.views.images.device)
        found = zip(planes, errors, strict=True)
        return {plane: error for plane, error in found if error <= most and math.isfinite(error)}

    def several(
        self, plane: Plane, error: float, given: Views, least: int = 2, most: float = TOLERANCE
    ) -> tuple[Symmetry, float] | None:
        """The most likely order of symmetries of several planes, one of which is known, and its error over its worth.

        Args:
            plane: the one.
            error: by it alone.
            given: all views of the object, of which there are to be reflections.
            least: order.
            most: error of such an order.

        Returns:
            None where it is more likely that there are no other ones.
        """
        if abs(plane.normal[1]) > 1e-6:
            return None
        centre = self.views.bounds.centre
        apart = sum(a * b for a, b in zip(plane.normal, centre, strict=True)) - plane.offset
        x, y, z = (a - apart * b for a, b in zip(centre, plane.normal, strict=True))
        room = min(MOST_IMAGES // len(given), MOST_PIXELS // given.images[:, 0].numel())
        found, best, possible = None, error, set[int]()
        for order, parts in ORDERS.items():
            symmetry = Symmetry(plane, order, (x, y, z))
            if symmetry.images > room or not possible.issuperset(parts):
                continue
            error = self.error(symmetry)
            if error > TOLERANCE:
                continue
            possible.add(order)
            if order >= least and error <= most and error / order**WORTH < best:
                found, best = symmetry, error / order**WORTH
        return None if found is None else (found, best)

    def error(self, symmetry: Symmetry) -> float:
        """That of the hull of views and reflections; infinite where it loses too many pixels."""
        return (self.squared_error(symmetry) + self.floor) / self.alone

    def squared_error(self, symmetry: Symmetry | None) -> float:
        """That of the views by `HullBlend` of them and their reflections.

        Args:
            symmetry: of the reflections, if there are any.

        Returns:
            The sum over pixels; infinite where the hull with reflections loses too many of them.
        """
        views, shown, voxels = self.views, self.views, self.voxels
        assert views.masks is not None
        among = torch.ones_like(views.masks, dtype=torch.bool)
        if symmetry is not None:
            shown = images_by(views, symmetry)
            voxels = carved(shown[len(views) :], len(voxels.occupied), voxels)
            seen, held = views.masks >= SHOWN, footprint(voxels, views.cameras)[:, None]
            if not voxels.occupied.any() or float((seen & ~held).sum()) > LOST * float(seen.sum()):
                return math.inf
            among = held | ~seen
        assert shown.masks is not None
        planes = VisibilityPlanes(shown.images, shown.cameras, shown.masks, voxels)
        blend = HullBlend(steps=STEPS * len(voxels.occupied)).adapt_to(planes)
        found = self.rays.picture(blend.trace(self.rays.rays, differentiable=False).colour, views.masks.shape)
        return float((found - views.images).square().mean(1, keepdim=True)[among].sum())


def best_vertical_plane(judge: SymmetryJudge, views: Views) -> Plane:
    """The vertical plane by which views are shown best.

    Planes of all azimuths are tried by smaller pictures, then those near to the best one or two, and last, by larger
    pictures, those beside the best of these. A few degrees beside the right plane the error is several times as large.

    Args:
        judge: by the larger pictures.
        views: what is judged.
    """
    coarse, step = SymmetryJudge.of(views, COARSE_SIZE, COARSE_HULL), math.pi / AZIMUTHS
    angles = {_vertical(views.bounds, index * step): index * step for index in range(AZIMUTHS)}
    errors = coarse.errors(list(angles))
    if not errors:
        return next(iter(angles))
    first, *others = sorted(errors, key=errors.__getitem__)
    apart = [each for each in others if abs(math.sin(angles[each] - angles[first])) > math.sin(1.5 * step)]
    likely = [first, *(each for each in apart[:1] if errors[each] <= NEARLY * errors[first])]
    nearer = [_refined(coarse, (angles[each], 0.0), (step / 2, 0.0), COARSE_ROUNDS) for each in likely]
    start, _ = min(nearer, key=lambda each: each[1])
    (angle, offset), _ = _refined(judge, start, (step / 2**COARSE_ROUNDS, SPAN), FINE_ROUNDS)
    return _vertical(views.bounds, angle, offset)


def carved(views: Views, side: int = HULL_SIDE, within: Occupancy | None = None) -> Occupancy:
    """The visual hull of views with masks, which may be empty; the part of it within some voxels, if there are any."""
    assert views.masks is not None
    return carve(views.masks, views.cameras, views.bounds, side, within=within)


def _refined(
    judge: SymmetryJudge, start: tuple[float, float], steps: tuple[float, float], rounds: int
) -> tuple[tuple[float, float], float]:
    """Azimuth and offset of a vertical plane near to another one by which views are shown better, and its error.

    Args:
        judge: of the views.
        start: azimuth and offset of the other one.
        steps: by which both are changed first; half as much in each further round.
        rounds: how many.
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
    """The vertical plane whose normal has this azimuth, so many radii from the middle of a scene."""
    return Plane.of_sphere(bounds, (math.cos(angle), 0.0, math.sin(angle)), offset)
