"""The plane about which a model is shown reflections of an object's views."""

from __future__ import annotations

import torch

from hyperplanes.adaptation.held_out import draw_pixels, hold_out
from hyperplanes.adaptation.network import HyperPlanesNetwork
from hyperplanes.adaptation.symmetry import possible_planes, symmetry_plane
from hyperplanes.geometry.reflections import Plane
from hyperplanes.views import Views

__all__ = ["find_symmetry"]

SIZE, PIXELS = 128, 2048  # along the longer side of a single view, and those by which it is judged
FEWEST_JUDGED = 10  # views from which on some are held out; fewer gain more, and tell less


@torch.no_grad()
def find_symmetry(network: HyperPlanesNetwork, support: Views) -> Plane | None:
    """As `HyperPlanes.find_symmetry`.

    Args:
        network: the model.
        support: the views of an object.
    """
    config = network.config
    if config.symmetry is not None or not config.symmetric:
        return config.symmetry
    views = network.to_own(support)
    if len(views) == 1:
        return _plane_of_one(network, views)
    plane = symmetry_plane(views)
    if plane is None or len(views) < FEWEST_JUDGED:
        return plane
    return plane if _is_shown_better(network, views, plane) else None


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


def _is_shown_better(network: HyperPlanesNetwork, views: Views, plane: Plane) -> bool:
    """Whether views that are held out are shown better with reflections of the others than without."""
    parts = hold_out(views)
    if parts is None:
        return True
    shown, held_out = parts
    alone, both = network.prepare(shown), network.prepare(shown, symmetry=plane)
    pixels = draw_pixels(alone, held_out, network.config.sampling.near_far)
    if pixels is None:
        return True
    without, reflected = (
        float(pixels.errors(network.rendering_field(each, network.adapted_weights(each))).square().sum())
        for each in (alone, both)
    )
    return reflected < without
