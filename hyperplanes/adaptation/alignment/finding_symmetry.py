"""The symmetry by which the views of an object are reflected for a model."""

from __future__ import annotations

import torch

from hyperplanes.adaptation.base import check_masks
from hyperplanes.adaptation.network import HyperPlanesNetwork
from hyperplanes.adaptation.symmetry.detection import possible_symmetries, symmetry_of
from hyperplanes.geometry.symmetry.reflections import Symmetry
from hyperplanes.views import Views

__all__ = ["find_symmetry"]

SINGLE_VIEW_SIZE = 128  # pixels of a single view along its longer side
SINGLE_VIEW_PIXELS = 2048  # that are compared


@torch.no_grad()
def find_symmetry(network: HyperPlanesNetwork, support: Views) -> Symmetry | None:
    """As `HyperPlanes.find_symmetry`.

    Args:
        network: the model.
        support: the views of an object.
    """
    check_masks(support)
    config = network.config
    if config.symmetry is not None or not config.symmetric:
        return config.symmetry
    views = network.to_own(support)
    return _of_one_view(network, views) if len(views) == 1 else symmetry_of(views)


def _of_one_view(network: HyperPlanesNetwork, view: Views) -> Symmetry | None:
    """Several planes if the view shows them; otherwise the plane, or None, with which the model renders it best.

    A single plane is judged by the model's own rendering of the view; several are judged by the visual hull alone.
    """
    if view.masks is None or not view.masks.any():
        return None
    view = view.resized(SINGLE_VIEW_SIZE)
    possible = possible_symmetries(view)
    if any(each.order > 1 for each in possible):
        return possible[0]
    near_far = network.config.sampling.near_far
    rays, truth = view.sample_rays(SINGLE_VIEW_PIXELS, generator=torch.Generator().manual_seed(0), near_far=near_far)

    def error(symmetry: Symmetry | None) -> float:
        context = network.prepare(view, symmetry=symmetry)
        found = network.field(context, network.adapted_weights(context)).trace(rays, differentiable=False)
        return float((found.colour - truth).square().sum())

    return min((None, *possible), key=error)
