"""The plane about which a model is shown reflections of an object's views."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from hyperplanes.adaptation.held_out import Trial, hold_out
from hyperplanes.adaptation.network import HyperPlanesNetwork, in_use
from hyperplanes.adaptation.symmetry import possible_planes, symmetry_plane
from hyperplanes.geometry.reflections import Plane
from hyperplanes.views import Views

__all__ = ["Symmetry", "find_symmetry"]

SIZE, PIXELS = 128, 2048  # along the longer side of a single view, and those by which it is judged
FEWEST_JUDGED = 10  # views from which on some are held out; fewer gain more, and tell less


@dataclass(frozen=True)
class Symmetry:
    """What was found about the symmetry of an object.

    Attributes:
        plane: about which its views are to be reflected; None where they are not.
        trial: what was made of it so while views were held out, if they were.
    """

    plane: Plane | None
    trial: Trial | None = None


@torch.no_grad()
def find_symmetry(network: HyperPlanesNetwork, support: Views) -> Symmetry:
    """As `HyperPlanes.find_symmetry`.

    Args:
        network: the model.
        support: the views of an object.
    """
    config = network.config
    if config.symmetry is not None or not config.symmetric:
        return Symmetry(config.symmetry)
    views = network.to_own(support)
    if len(views) == 1:
        return Symmetry(_plane_of_one(network, views))
    plane = symmetry_plane(views)
    return Symmetry(plane) if plane is None or len(views) < FEWEST_JUDGED else _judged(network, views, plane)


def _plane_of_one(network: HyperPlanesNetwork, view: Views) -> Plane | None:
    """The plane by which a single view is shown best, if not without a reflection."""
    if view.masks is None or not view.masks.any():
        return None
    view = view.resized(SIZE)
    near_far = network.config.sampling.near_far
    rays, truth = view.sample_rays(PIXELS, generator=torch.Generator().manual_seed(0), near_far=near_far)

    def error(plane: Plane | None) -> float:
        context = network.prepare(view, symmetry=plane)
        found = network.field(context, network.adapted_weights(context)).trace(rays, differentiable=False)
        return float((found.colour - truth).square().sum())

    return min((None, *possible_planes(view)), key=error)


def _judged(network: HyperPlanesNetwork, views: Views, plane: Plane) -> Symmetry:
    """The plane if views that are held out are shown better with reflections of the others, or decide nothing."""
    with in_use(network):
        alone, both = hold_out(network, views), hold_out(network, views, plane)
        if alone is None or both is None:
            return Symmetry(plane)
        without, reflected = (float(alone.pixels.errors(each.learned).square().sum()) for each in (alone, both))
    return Symmetry(plane, both) if reflected < without else Symmetry(None, alone)
