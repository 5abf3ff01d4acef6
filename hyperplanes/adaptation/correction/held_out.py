"""Held-out views of an object, on whose pixels a field of the other views is evaluated."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from hyperplanes.adaptation.base import AdaptedField
from hyperplanes.adaptation.context import SupportContext, live_pixels
from hyperplanes.adaptation.network import HyperPlanesNetwork
from hyperplanes.adaptation.optimisation.descent import contrast
from hyperplanes.adaptation.optimisation.learned_steps import updated_weights
from hyperplanes.geometry.poses import outermost_first
from hyperplanes.geometry.rays import SUBPIXELS, Rays
from hyperplanes.geometry.symmetry.reflections import Symmetry
from hyperplanes.rendering.footprint import pixels_across
from hyperplanes.views import Views

__all__ = ["MIN_VIEWS", "HeldOutPixels", "Trial", "hold_out"]

MIN_VIEWS = 5  # views of which some can be held out
MIN_HELD_OUT = 2  # least number of held-out views
# one view in ONE_IN is held out, if that is more than MIN_HELD_OUT: 3 of 47 instead of 2 gain 0.16 ± 0.14 dB (20
# objects, all by two of them)
ONE_IN = 12
HELD_OUT_PIXELS = 2048  # of the held-out views
EVEN = 0.2  # contrast up to which one ray through a pixel serves as well as three: half the rays
# most pixels of all views along the longer side: 256 find no better shares and take three times as long
MAX_IMAGE_SIZE = 128


@dataclass(frozen=True)
class HeldOutPixels:
    """Some pixels of the held-out views.

    Attributes:
        even: rays through the centres of the pixels with little contrast.
        uneven: rays through the others, one through each of SUBPIXELS.
        truth: their true colours, even ones first.
        across: pixels along a diameter of the scene.
    """

    even: Rays
    uneven: Rays
    truth: Float[Tensor, "pixel 3"]
    across: float

    def errors(self, adapted: AdaptedField) -> Float[Tensor, "pixel 3"]:
        """The differences of the colours of a field from the true ones.

        Args:
            adapted: a field of the other views.
        """
        finer = adapted.with_sampling(adapted.sampling.for_rendering(self.across))
        one, three = (finer.trace(rays, differentiable=False) for rays in (self.even, self.uneven))
        return torch.cat([one.colour, three.pooled(len(SUBPIXELS)).colour]) - self.truth


@dataclass(frozen=True)
class Trial:
    """The field that a model makes of an object while some views are held out.

    Attributes:
        context: of the other views.
        learned: their field, after half of the learned steps and before any fine-tuning.
        pixels: of the held-out views, inside the hull of the others.
    """

    context: SupportContext
    learned: AdaptedField
    pixels: HeldOutPixels


@torch.no_grad()
def hold_out(network: HyperPlanesNetwork, support: Views, symmetry: Symmetry | None = None) -> Trial | None:
    """Holds out two views or one in twelve, those closest to the others; all are at most MAX_IMAGE_SIZE pixels large.

    Args:
        network: of a field that takes any number of views.
        support: the views of an object, on the device of the model.
        symmetry: by which the other views are reflected.

    Returns:
        None with fewer than MIN_VIEWS views, without masks, and where only the held-out views see the object, or none
        of them does.
    """
    if len(support) < MIN_VIEWS or support.masks is None:
        return None
    support = support.resized(MAX_IMAGE_SIZE)
    order = outermost_first(support.camera_directions.cpu(), len(support))
    count = max(MIN_HELD_OUT, len(support) // ONE_IN)
    shown, held_out = support[sorted(order[:-count])], support[order[-count:]]
    assert shown.masks is not None
    if not shown.masks.any():
        return None
    context = network.prepare(shown, symmetry=symmetry)
    among = live_pixels(context.occupancy, held_out)
    if not len(among):
        return None
    near_far = network.config.sampling.near_far
    pixels = among[
        torch.randint(len(among), (HELD_OUT_PIXELS,), generator=torch.Generator().manual_seed(0)).to(among.device)
    ]
    uneven = contrast(held_out.images).flatten()[pixels] > EVEN
    one, colours, _ = held_out.rays_at(pixels[~uneven], near_far=near_far)
    three, others, _ = held_out.rays_at(pixels[uneven], near_far=near_far, subpixels=SUBPIXELS)
    across = pixels_across(held_out.cameras, held_out.bounds)
    # half of the learned steps, and visibility by the hull: pictures lose 0.01 dB, in half the time
    learned = network.field(context, updated_weights(network, context, -(-network.config.learned_steps // 2)))
    return Trial(context, learned, HeldOutPixels(one, three, torch.cat([colours, others]), across))
