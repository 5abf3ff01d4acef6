"""The symmetry of an object, as its views tell it: their visual hull and its colours, without any weights."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch

from hyperplanes.adaptation.base import AdaptedField
from hyperplanes.adaptation.context import live_pixels
from hyperplanes.adaptation.hull_blend import HullBlend
from hyperplanes.adaptation.reflections import (
    HULL_SIDE,
    SHOWN,
    handicaps,
    images_by,
    with_reflections,
)
from hyperplanes.geometry.cameras import camera_directions
from hyperplanes.geometry.kernels.threads import side_by_side
from hyperplanes.geometry.mirror_symmetry import more_symmetric_plane, most_symmetric_plane
from hyperplanes.geometry.occupancy import Occupancy, carve
from hyperplanes.geometry.poses import farthest_first
from hyperplanes.geometry.rays import Sphere
from hyperplanes.geometry.reflections import Plane, Symmetry
from hyperplanes.geometry.visibility import VisibilityPlanes
from hyperplanes.rendering.footprint import footprint
from hyperplanes.views import Views

__all__ = ["ReflectedHullBlend", "possible_symmetries", "symmetry_of"]

FEWEST = 2  # views that planes are judged by: a single one contradicts none of them
FEWEST_TO_REFINE = 10  # whose hull is near enough to the object to find planes by it
MOST = 8
SIZE, COARSE_SIZE = 64, 32  # pixels of these along the longer side, at most: to judge a plane, and to look for one
COARSE_HULL = 48  # voxels an axis, to look for one
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
SINGLE_VIEW_ORDER = 3  # at least: by one view, many a car is the same from the front and from the back
WORTH = 0.5  # power of the order by which the error may grow
FOLDS, ONE_IN = 3, 6  # that are held out one after the other, each of one view in so many
FEW = 16  # views, of which the held-out ones must gain more
GAIN_OF_FEW, GAIN = 0.6, 0.1  # dB that reflections must bring to held-out views
JUDGED_SIZE, PIXELS = 128, 1024  # of held-out views, along the longer side at most, and those compared of each fold

VERTICAL = ((1.0, 0.0, 0.0), (0.0, 0.0, 1.0))
AXES = (*VERTICAL, (0.0, 1.0, 0.0))
"""Normals of planes that are tried."""


@torch.no_grad()
def symmetry_of(support: Views) -> Symmetry | None:
    """The planes about which an object looks symmetric, if there are any.

    If an object is symmetric, the visual hull of its views and their reflections still shows the views. If not, this
    hull is too small, or it has the colours of another part of the object. Silhouettes and colours are compared; no
    weights are needed. Planes through the middle of the scene that are orthogonal to its axes are tried first. Where
    none of them will do, vertical planes of all azimuths are. Of an object that is symmetric about a vertical plane,
    likewise 2, 3, 4, 6 and 8 planes through one axis are tried.

    FEWEST_TO_REFINE views have a hull that is near enough to the object to look for planes by it: one near to the best
    of those across the axes (`more_symmetric_plane`) or, where none will do, the vertical plane about which the hull is
    most nearly symmetric (`most_symmetric_plane`). Several planes are not looked for. Those of the views that are held
    out must be shown better with reflections of the others, by GAIN_OF_FEW or GAIN.

    Args:
        support: views with masks, y up; MOST of them, those farthest apart, are looked at.

    Returns:
        The symmetry by which `HullBlend` shows the views best, if its squared error is at most TOLERANCE times that
        without reflections; None with fewer than FEWEST views, or without masks.
    """
    if support.masks is None or len(support) < FEWEST or not support.masks.any():
        return None
    centre = support.bounds.centre
    chosen = farthest_first(camera_directions(support.cameras, centre).cpu(), 0, min(MOST, len(support)))
    views = support[sorted(chosen)]
    judge = _Judge.of(views)
    errors = judge.errors(_planes(support.bounds, AXES), TOLERANCE)
    found = min(errors, key=errors.__getitem__, default=None)
    if len(support) < FEWEST_TO_REFINE:
        tried = [] if found else [_best_plane(judge, views)]
    else:
        voxels = _hull(support)
        if not voxels.occupied.any():
            return None
        tried = [most_symmetric_plane(voxels) if found is None else more_symmetric_plane(voxels, found)]
    errors |= judge.errors(tried, TOLERANCE)
    found = min(errors, key=errors.__getitem__, default=None)
    if found is None:
        return None
    if len(support) >= FEWEST_TO_REFINE:
        needed = GAIN_OF_FEW if len(support) < FEW else GAIN
        return Symmetry(found) if _held_out_gain(support, Symmetry(found)) >= needed else None
    several = judge.several(found, errors[found], support)
    return Symmetry(found) if several is None else several[0]


@torch.no_grad()
def possible_symmetries(view: Views) -> list[Symmetry]:
    """The symmetries about vertical planes through the middle of a scene that a single view does not contradict.

    Args:
        view: with a mask; y is up, as models are trained.

    Returns:
        The most likely one where there are several planes through one axis: few other objects look like such a one.
        Else those about one plane, of which a single view tells nothing more.
    """
    judge = _Judge.of(view)
    errors = judge.errors(_planes(view.bounds, VERTICAL))
    several = [judge.several(plane, errors[plane], view, SINGLE_VIEW_ORDER) for plane in errors]
    likely = [each for each in several if each is not None]
    if likely:
        return [min(likely, key=lambda each: each[1])[0]]
    return [Symmetry(plane) for plane in errors]


class ReflectedHullBlend:
    """`HullBlend` of the views of an object that looks symmetric and of their reflections, by their handicaps."""

    def adapt(self, support: Views) -> AdaptedField:
        """The hull of views and reflections, and its colours."""
        return _blend(support, symmetry_of(support))


def _blend(support: Views, symmetry: Symmetry | None) -> AdaptedField:
    """`HullBlend` of views, and of their reflections where there is a symmetry."""
    blend = HullBlend()
    planes = blend.planes_of(with_reflections(support, symmetry))
    return blend.adapt_to(planes if symmetry is None else planes.with_handicaps(handicaps(len(support), symmetry)))


def _held_out_gain(support: Views, symmetry: Symmetry) -> float:
    """By how many dB of PSNR `HullBlend` shows held-out views better by the other views and their reflections.

    FOLDS times one view in ONE_IN is held out (cross-validation, Stone 1974), and the same pixels are compared. No
    weights are needed: two views that are held out from a trained field tell less (docs/image-based.md).
    """
    views = support.resized(JUDGED_SIZE)
    order = torch.randperm(len(views), generator=torch.Generator().manual_seed(0)).tolist()
    trials = [(sorted(order[fold::ONE_IN]), by) for by in (None, symmetry) for fold in range(FOLDS)]
    errors = side_by_side(lambda trial: _held_out_error(views, *trial), trials, views.images.device)
    alone, reflected = sum(errors[:FOLDS]), sum(errors[FOLDS:])
    return 10 * math.log10(alone / reflected) if reflected else math.inf


def _held_out_error(views: Views, held_out: list[int], symmetry: Symmetry | None) -> float:
    """The squared error of some views by the others, in pixels that are the same with a symmetry and without."""
    shown, others = views[sorted({*range(len(views))} - {*held_out})], views[held_out]
    among = live_pixels(_hull(shown), others)
    if not len(among):
        return 0.0
    drawn = torch.randint(len(among), (PIXELS,), generator=torch.Generator().manual_seed(0))
    rays, truth, _ = others.rays_at(among[drawn.to(among.device)])
    return float((_blend(shown, symmetry).trace(rays, differentiable=False).colour - truth).square().sum())


@dataclass(frozen=True)
class _Judge:
    """How well views are shown by `HullBlend` of them and their reflections.

    Attributes:
        views: small ones.
        side: voxels an axis of their hull.
        alone: their squared error without reflections, and FLOOR.
        floor: of all errors.
    """

    views: Views
    side: int
    alone: float
    floor: float

    @classmethod
    def of(cls, support: Views, size: int = SIZE, side: int = HULL_SIDE) -> _Judge:
        """The judge of views with masks, so many pixels along the longer side at most."""
        views = support.resized(size)
        assert views.masks is not None
        floor = FLOOR * float((views.masks >= SHOWN).sum())
        return cls(views, side, _squared_error(views, None, side) + floor, floor)

    def errors(self, planes: Sequence[Plane], most: float = math.inf) -> dict[Plane, float]:
        """Those of the planes by which they are at most so large, and finite."""
        errors = side_by_side(lambda plane: self.error(Symmetry(plane)), planes, self.views.images.device)
        found = zip(planes, errors, strict=True)
        return {plane: error for plane, error in found if error <= most and math.isfinite(error)}

    def several(self, plane: Plane, error: float, given: Views, least: int = 2) -> tuple[Symmetry, float] | None:
        """The most likely order of symmetries of several planes, one of which is known, and its error over its worth.

        Args:
            plane: the one.
            error: by it alone.
            given: all views of the object, of which there are to be reflections.
            least: order.

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
            if order >= least and error / order**WORTH < best:
                found, best = symmetry, error / order**WORTH
        return None if found is None else (found, best)

    def error(self, symmetry: Symmetry) -> float:
        """That of the hull of views and reflections; infinite where it loses too many pixels."""
        return (_squared_error(self.views, symmetry, self.side) + self.floor) / self.alone


def _hull(views: Views, side: int = HULL_SIDE) -> Occupancy:
    """The visual hull of views with masks."""
    assert views.masks is not None
    return carve(views.masks, views.cameras, views.bounds, side)


def _squared_error(views: Views, symmetry: Symmetry | None, side: int) -> float:
    """That of views by `HullBlend` of them and their reflections; infinite where their hull loses too many pixels."""
    assert views.masks is not None
    shown = views if symmetry is None else images_by(views, symmetry)
    among, hull = torch.ones_like(views.masks, dtype=torch.bool), _hull(shown, side)
    if symmetry is not None:
        seen, held = views.masks >= SHOWN, footprint(hull, views.cameras)[:, None]
        if not hull.occupied.any() or float((seen & ~held).sum()) > LOST * float(seen.sum()):
            return math.inf
        among = held | ~seen
    assert shown.masks is not None
    blend = HullBlend().adapt_to(VisibilityPlanes(shown.images, shown.cameras, shown.masks, hull))
    found = blend.render(views.cameras)
    return float((found.images - views.images).square().mean(1, keepdim=True)[among].sum())


def _best_plane(judge: _Judge, views: Views) -> Plane:
    """The vertical plane by which views are shown best.

    Planes of all azimuths are tried by smaller pictures, then those near to the best one or two, and last, by larger
    pictures, those beside the best of these. A few degrees beside the right plane the error is several times as large.

    Args:
        judge: by the larger pictures.
        views: what is judged.
    """
    coarse, step = _Judge.of(views, COARSE_SIZE, COARSE_HULL), math.pi / AZIMUTHS
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


def _refined(
    judge: _Judge, start: tuple[float, float], steps: tuple[float, float], rounds: int
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
    normal = (math.cos(angle), 0.0, math.sin(angle))
    through = sum(a * b for a, b in zip(normal, bounds.centre, strict=True))
    return Plane(normal, through + offset * bounds.radius)


def _planes(bounds: Sphere, normals: Sequence[tuple[float, float, float]]) -> list[Plane]:
    """The planes through the middle of a scene that have these normals."""
    return [Plane(normal, sum(a * b for a, b in zip(normal, bounds.centre, strict=True))) for normal in normals]
