"""Views of an object that are held out, and pixels of them by which what is made of the others is judged."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float

from hyperplanes.adaptation.base import AdaptedField
from hyperplanes.adaptation.context import SupportContext, live_pixels
from hyperplanes.fields.rig import camera_directions
from hyperplanes.geometry.poses import outermost_first
from hyperplanes.geometry.rays import SUBPIXELS, Rays
from hyperplanes.rendering.footprint import pixels_across
from hyperplanes.rendering.renderer import render
from hyperplanes.views import Views

__all__ = ["FEWEST", "HeldOutPixels", "draw_pixels", "hold_out"]

FEWEST = 5  # views, of which some can be held out
HELD_OUT = 2
PIXELS = 2048  # of the views that are held out, at whose edges pictures differ most
SIZE = 128  # of all of them, along the longer side, at most: 256 pixels find no better shares, in three times the time


@dataclass(frozen=True)
class HeldOutPixels:
    """Some pixels of the views that are held out.

    Attributes:
        rays: as many of each pixel as there are SUBPIXELS.
        truth: the colours of the pixels.
        across: pixels along a diameter of the scene.
    """

    rays: Rays
    truth: Float[torch.Tensor, "pixel 3"]
    across: float

    def errors(self, adapted: AdaptedField) -> Float[torch.Tensor, "pixel 3"]:
        """By how much the colours of a field differ from the true ones.

        Args:
            adapted: what is made of the other views.
        """
        found = render(
            adapted.field,
            self.rays,
            adapted.sampling.for_rendering(self.across),
            occupancy=adapted.occupancy,
            proposal=adapted.proposal,
            differentiable=False,
        )
        return found.pooled(len(SUBPIXELS)).colour - self.truth


def hold_out(support: Views) -> tuple[Views, Views] | None:
    """The views that are shown, and the HELD_OUT ones that these stand closest around, of SIZE pixels at most.

    Args:
        support: the views of an object.

    Returns:
        None with fewer than FEWEST views, without masks, and where the object is seen by the held-out views alone.
    """
    if len(support) < FEWEST or support.masks is None:
        return None
    support = support.resized(SIZE)
    order = outermost_first(camera_directions(support).cpu(), len(support))
    shown, held_out = support[sorted(order[:-HELD_OUT])], support[order[-HELD_OUT:]]
    return (shown, held_out) if shown.masks is not None and shown.masks.any() else None


def draw_pixels(context: SupportContext, held_out: Views, near_far: str) -> HeldOutPixels | None:
    """PIXELS of the views that are held out, within the hull of the others; None where they do not see it.

    Args:
        context: of the others.
        held_out: the views.
        near_far: of the rays, as in `geometry.cast`.
    """
    among = live_pixels(context.occupancy, held_out)
    if not len(among):
        return None
    rays, truth, _ = held_out.sample_masked_rays(
        PIXELS, generator=torch.Generator().manual_seed(0), among=among, near_far=near_far, subpixels=SUBPIXELS
    )
    return HeldOutPixels(rays, truth, pixels_across(held_out.cameras, held_out.bounds))
