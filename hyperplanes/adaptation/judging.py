"""How much of what was learned an object gets: support views that are left out for the purpose decide."""

from __future__ import annotations

import torch

from hyperplanes.adaptation.context import SupportContext, live_pixels
from hyperplanes.adaptation.network import HyperPlanesNetwork, in_use
from hyperplanes.fields.rig import camera_directions
from hyperplanes.geometry.poses import outermost_first
from hyperplanes.parameters import Parameters
from hyperplanes.views import Views

__all__ = ["FEWEST", "MARGIN", "STRENGTHS", "attenuated_weights", "judge_strength", "judged_weights"]

STRENGTHS = (1.0, 0.5, 0.0)
"""What is compared: the trained field, halfway to the plain visual hull in blended colours, and that alone."""

FEWEST = 5  # views, of which some can be left out
LEFT_OUT = 2
MARGIN = (
    0.25  # of the squared error, by which less learned has to be better: two views tell smaller differences wrongly
)
RAYS = 2048  # of the views that are left out
PIXELS = 256  # along the longer side of all of them, at most: photographs have no more to say here


@torch.no_grad()
def judge_strength(network: HyperPlanesNetwork, support: Views) -> float:
    """The strength, of STRENGTHS, with which views that are left out are shown best; less than 1 only by a MARGIN.

    A trained field has expectations of its objects, and an object of another kind may be shown worse with them than
    without. Left out are the LEFT_OUT views that the others stand closest around, and the squared error of RAYS of
    their rays through the hull counts. Wortsman et al. 2022, "Robust fine-tuning of zero-shot models", interpolate
    weights likewise; here it is the outputs (`Target.attenuated`).

    Args:
        network: of a field that takes any number of views.
        support: the views of an object, where the model is.

    Returns:
        The strength; 1 with fewer than FEWEST views.
    """
    if len(support) < FEWEST:
        return STRENGTHS[0]
    support = support.resized(PIXELS)
    order = outermost_first(camera_directions(support).cpu(), len(support))
    shown, judged = support[sorted(order[:-LEFT_OUT])], support[order[-LEFT_OUT:]]
    context = network.prepare(shown)
    weights = network.theta + network.update(context)
    fields = [network.field(context, network.attenuated(weights, strength)) for strength in STRENGTHS]
    rays, truth = judged.sample_rays(
        RAYS,
        generator=torch.Generator().manual_seed(0),
        among=live_pixels(context.occupancy, judged),
        near_far=fields[0].sampling.near_far,
    )
    errors = [float((each.trace(rays, differentiable=False).colour - truth).square().mean()) for each in fields]
    best = min(errors)
    return STRENGTHS[errors.index(best)] if best < (1 - MARGIN) * errors[0] else STRENGTHS[0]


@torch.no_grad()
def judged_weights(network: HyperPlanesNetwork, context: SupportContext) -> Parameters:
    """Theta + delta of an object, attenuated as its own views judge them where the model is configured so.

    Args:
        network: the model.
        context: the object.
    """
    return attenuated_weights(network, context, network.adapted_weights(context))


@torch.no_grad()
def attenuated_weights(network: HyperPlanesNetwork, context: SupportContext, weights: Parameters) -> Parameters:
    """Weights attenuated as `judge_strength` says of an object and its own update, where the model is configured so.

    Args:
        network: the model.
        context: the object.
        weights: of the field.
    """
    if not network.config.judged:
        return weights
    with in_use(network):
        return network.attenuated(weights, judge_strength(network, context.views))
