"""The symmetry by which a model is shown reflections of an object's views."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial

import torch

from hyperplanes.adaptation.held_out import Trial, hold_out
from hyperplanes.adaptation.network import HyperPlanesNetwork, in_use
from hyperplanes.adaptation.symmetry import possible_symmetries, symmetry_of
from hyperplanes.geometry.kernels.threads import side_by_side
from hyperplanes.geometry.reflections import Symmetry
from hyperplanes.views import Views

__all__ = ["FoundSymmetry", "find_symmetry"]

SIZE, PIXELS = 128, 2048  # along the longer side of a single view, and those by which it is judged
FEWEST_JUDGED = 10  # views from which on some are held out; fewer gain more, and tell less


@dataclass(frozen=True)
class FoundSymmetry:
    """What was found about the symmetry of an object.

    Attributes:
        symmetry: by which its views are to be reflected; None where they are not.
        trial: what was made of it so while views were held out, if they were.
    """

    symmetry: Symmetry | None
    trial: Trial | None = None


@torch.no_grad()
def find_symmetry(network: HyperPlanesNetwork, support: Views) -> FoundSymmetry:
    """As `HyperPlanes.find_symmetry`.

    Args:
        network: the model.
        support: the views of an object.
    """
    config = network.config
    if config.symmetry is not None or not config.symmetric:
        return FoundSymmetry(config.symmetry)
    views = network.to_own(support)
    if len(views) == 1:
        return FoundSymmetry(_of_one_view(network, views))
    found = symmetry_of(views)
    if found is None or len(views) < FEWEST_JUDGED:
        return FoundSymmetry(found)
    return _judged(network, views, found)


def _of_one_view(network: HyperPlanesNetwork, view: Views) -> Symmetry | None:
    """Several planes where the view shows them; else the plane by which it is shown best, if not without a reflection.

    The model itself shows a view with few planes: with many, the view is what the hull is made of.
    """
    if view.masks is None or not view.masks.any():
        return None
    view = view.resized(SIZE)
    possible = possible_symmetries(view)
    if any(each.order > 1 for each in possible):
        return possible[0]
    near_far = network.config.sampling.near_far
    rays, truth = view.sample_rays(PIXELS, generator=torch.Generator().manual_seed(0), near_far=near_far)

    def error(symmetry: Symmetry | None) -> float:
        context = network.prepare(view, symmetry=symmetry)
        found = network.field(context, network.adapted_weights(context)).trace(rays, differentiable=False)
        return float((found.colour - truth).square().sum())

    return min((None, *possible), key=error)


def _judged(network: HyperPlanesNetwork, views: Views, symmetry: Symmetry) -> FoundSymmetry:
    """The symmetry, unless views that are held out are shown worse with reflections of the others.

    By more than the standard error of the difference: what looks symmetric mostly is.
    """
    with in_use(network):
        device = views.images.device
        alone, both = side_by_side(partial(hold_out, network, views), [None, symmetry], device)
        if alone is None or both is None:
            return FoundSymmetry(symmetry)
        errors = side_by_side(lambda each: alone.pixels.errors(each.learned), [alone, both], device)
        without, reflected = (each.square().sum(1) for each in errors)
    lost = reflected - without
    worse = lost.mean() > lost.std() / math.sqrt(len(lost))
    return FoundSymmetry(None, alone) if worse else FoundSymmetry(symmetry, both)
