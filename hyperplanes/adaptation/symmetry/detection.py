"""Detection of the symmetry of an object from its views, by their visual hull and its colours, without weights."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from hyperplanes.adaptation.base import AdaptedField
from hyperplanes.adaptation.baselines.hull_blend import HullBlend
from hyperplanes.adaptation.context import live_pixels
from hyperplanes.adaptation.symmetry.judging import (
    MAX_ERROR_RATIO,
    SymmetryJudge,
    best_vertical_plane,
    carved,
)
from hyperplanes.adaptation.symmetry.reflections import HULL_SIDE, penalty_offsets, with_reflections
from hyperplanes.geometry.kernels.threads import map_long_parts
from hyperplanes.geometry.occupancy import Occupancy
from hyperplanes.geometry.poses import farthest_first
from hyperplanes.geometry.rays import Rays
from hyperplanes.geometry.symmetry.mirror_symmetry import more_symmetric_plane, most_symmetric_plane
from hyperplanes.geometry.symmetry.reflections import Plane, Symmetry
from hyperplanes.views import Views

__all__ = ["ReflectedHullBlend", "possible_symmetries", "symmetry_of"]

MIN_VIEWS = 2  # views to judge planes by: a single one contradicts none
FEWEST_TO_REFINE = 10  # views whose hull is near enough to the object to find planes by it
MAX_VIEWS = 8  # views that are used
SINGLE_VIEW_ORDER = 3  # at least: in one view, many cars look the same from the front and the back
SINGLE_VIEW_TOLERANCE = 1.5  # of such an order: 1.7 for a car and a lamp without it, up to 1.3 for solids of revolution
ALIKE = 1.02  # ratio of errors that counts as equal
FOLDS, ONE_IN = 3, 6  # of cross-validation, each of which holds out one view in ONE_IN
FEW_VIEWS = 16  # number of views below which held-out views must gain more
GAIN_OF_FEW, GAIN = 0.6, 0.1  # dB that held-out views must gain with reflections
FOLD_SIZE, PIXELS_PER_FOLD = 128, 1024  # most pixels of views along the longer side, and pixels compared in each fold

VERTICAL = ((1.0, 0.0, 0.0), (0.0, 0.0, 1.0))
PRINCIPAL_NORMALS = (*VERTICAL, (0.0, 1.0, 0.0))
"""Normals of the planes that are tried first."""


@torch.no_grad()
def symmetry_of(support: Views) -> Symmetry | None:
    """The planes about which an object looks symmetric, if there are any.

    If an object is symmetric, the visual hull of its views and their reflections still agrees with the views. If not,
    this hull is too small, or has the colours of another part of the object. Silhouettes and colours are compared; no
    weights are needed. Planes through the centre of the scene that are orthogonal to its axes are tried first. If none
    of them fits, vertical planes of all azimuths are tried. For an object that is symmetric about a vertical plane, 2,
    3, 4, 6 and 8 planes through one axis are also tried.

    With FEWEST_TO_REFINE views, the hull is near enough to the object to look for planes by it: one near the best of
    those orthogonal to an axis (`more_symmetric_plane`) or, if none fits, the vertical plane about which the hull is
    most symmetric (`most_symmetric_plane`). Several planes are not looked for. Reflections of the other views must
    improve held-out views by GAIN_OF_FEW or GAIN.

    Args:
        support: views with masks, y up; the MAX_VIEWS that are farthest apart are used.

    Returns:
        The symmetry with which `HullBlend` renders the views best, if its squared error is at most MAX_ERROR_RATIO
        times that without reflections; None with fewer than MIN_VIEWS views, without masks, or if `HullBlend` shows
        hardly any of the object (`SymmetryJudge.squared_error`).
    """
    if support.masks is None or len(support) < MIN_VIEWS or not support.masks.any():
        return None
    chosen = farthest_first(support.camera_directions.cpu(), 0, min(MAX_VIEWS, len(support)))
    views = support[sorted(chosen)]
    judge = SymmetryJudge.of(views)
    across = judge.errors([Plane.of_sphere(support.bounds, normal) for normal in PRINCIPAL_NORMALS], MAX_ERROR_RATIO)
    if len(support) >= FEWEST_TO_REFINE:
        return _of_many(support, judge, across)
    errors = across or judge.errors([best_vertical_plane(judge, views)], MAX_ERROR_RATIO)
    if not errors:
        return None
    found = _least(errors)
    several = judge.several(found, errors[found], support)
    return Symmetry(found) if several is None else several[0]


@torch.no_grad()
def possible_symmetries(view: Views) -> list[Symmetry]:
    """The symmetries about vertical planes through the centre of a scene that a single view does not contradict.

    Args:
        view: with a mask; y is up, as models are trained.

    Returns:
        The most likely symmetry of several planes, if there is one, since few other objects look like that. Otherwise
        those about one plane, between which a single view cannot decide.
    """
    judge = SymmetryJudge.of(view)
    errors = judge.errors([Plane.of_sphere(view.bounds, normal) for normal in VERTICAL])
    several = [judge.several(plane, errors[plane], view, SINGLE_VIEW_ORDER, SINGLE_VIEW_TOLERANCE) for plane in errors]
    likely = [each for each in several if each is not None]
    if likely:
        return [min(likely, key=lambda each: each[1])[0]]
    return [Symmetry(plane) for plane in errors]


class ReflectedHullBlend:
    """`HullBlend` of the views of an object and, if it looks symmetric, of their reflections with penalties."""

    def adapt(self, support: Views) -> AdaptedField:
        """The hull of views and reflections, and its colours."""
        return _blend(support, symmetry_of(support))


def _least(errors: Mapping[Plane, float]) -> Plane:
    """The first plane whose error is at most ALIKE times the least one."""
    return next(plane for plane, error in errors.items() if error <= ALIKE * min(errors.values()))


def _of_many(support: Views, judge: SymmetryJudge, across: Mapping[Plane, float]) -> Symmetry | None:
    """The symmetry about the best plane for the hull of many views, if held-out views gain from it.

    Args:
        support: the views.
        judge: of some of them.
        across: the fitting planes orthogonal to an axis, with their errors.
    """
    voxels = carved(support)
    if not voxels.occupied.any():
        return None
    if across:
        more = more_symmetric_plane(voxels, _least(across))
    else:
        more = most_symmetric_plane(voxels)
    errors = {**across, **judge.errors([more], MAX_ERROR_RATIO)}
    if not errors:
        return None
    symmetry = Symmetry(min(errors, key=errors.__getitem__))
    needed = GAIN_OF_FEW if len(support) < FEW_VIEWS else GAIN
    return symmetry if _held_out_gain(support, symmetry) >= needed else None


def _blend(support: Views, symmetry: Symmetry | None, known: Occupancy | None = None) -> AdaptedField:
    """`HullBlend` of views, and of their reflections if there is a symmetry; `known` is the hull of the views."""
    blend = HullBlend(side=HULL_SIDE)
    planes = blend.planes_of(with_reflections(support, symmetry, known), known)
    if symmetry is not None:
        planes = planes.with_penalty_offsets(penalty_offsets(len(support), symmetry))
    return blend.adapt_to(planes)


def _held_out_gain(support: Views, symmetry: Symmetry) -> float:
    """The gain in PSNR, in dB, of held-out views by `HullBlend` with reflections of the other views.

    One view in ONE_IN is held out FOLDS times (cross-validation, Stone 1974), and the same pixels are compared. This
    needs no weights, and says more than two views held out from a trained field (docs/image-based-measurements.md).
    """
    views = support.resized(FOLD_SIZE)
    order = torch.randperm(len(views), generator=torch.Generator().manual_seed(0)).tolist()
    folds = [Fold.of(views, sorted(order[fold::ONE_IN])) for fold in range(FOLDS)]
    trials = [(fold, by) for by in (symmetry, None) for fold in folds]  # the longer ones first
    errors = map_long_parts(lambda trial: trial[0].error(trial[1]), trials, views.images.device)
    reflected, alone = sum(errors[:FOLDS]), sum(errors[FOLDS:])
    return 10 * math.log10(alone / reflected) if reflected else math.inf


@dataclass(frozen=True)
class Fold:
    """A fold of cross-validation, in which some views are held out.

    Attributes:
        shown: the other views.
        voxels: their visual hull.
        rays: some rays of the held-out views that meet it.
        truth: the true colours of these rays.
    """

    shown: Views
    voxels: Occupancy
    rays: Rays
    truth: Float[Tensor, "ray 3"]

    @classmethod
    def of(cls, views: Views, held_out: list[int]) -> Fold:
        """The fold in which these views are held out, with PIXELS_PER_FOLD rays at most."""
        shown, others = views[sorted({*range(len(views))} - {*held_out})], views[held_out]
        voxels = carved(shown)
        among = live_pixels(voxels, others)
        drawn = torch.randint(max(1, len(among)), (PIXELS_PER_FOLD,), generator=torch.Generator().manual_seed(0))
        rays, truth, _ = others.rays_at(among[drawn.to(among.device)] if len(among) else among)
        return cls(shown, voxels, rays, truth)

    def error(self, symmetry: Symmetry | None) -> float:
        """The squared error of the rays for the other views, with their reflections if there is a symmetry."""
        if not len(self.rays):
            return 0.0
        found = _blend(self.shown, symmetry, self.voxels).trace(self.rays, differentiable=False).colour
        return float((found - self.truth).square().sum())
