"""A gating network: the weights of two pictures in each pixel of their average, computed from both."""

from __future__ import annotations

import math
from typing import TypeVar

import torch
from jaxtyping import Float
from torch import Tensor, nn

from hyperplanes.adaptation.base import Pictures
from hyperplanes.rendering.compositing import Rendered

__all__ = ["GatingNetwork", "readings"]

HIDDEN_WIDTH = 16
READINGS = 9  # inputs for a pixel
BIAS = -2.0  # initial bias of the logit: a share of an eighth

Pixels = TypeVar("Pixels", Rendered, Pictures)


class GatingNetwork(nn.Module):
    """The share of the visual hull in each pixel of a stacked picture (Jacobs et al. 1991, "Adaptive mixtures").

    Its weights are trained by `training.gating`, on objects that the field was not trained on, and by nothing else.
    """

    def __init__(self) -> None:
        super().__init__()
        self.layers = nn.Sequential(nn.Linear(READINGS, HIDDEN_WIDTH), nn.ReLU(), nn.Linear(HIDDEN_WIDTH, 1))
        last = self.layers[-1]
        assert isinstance(last, nn.Linear)
        nn.init.constant_(last.bias, BIAS)
        self.requires_grad_(requires_grad=False)

    def forward(self, read: Float[Tensor, "*pixel 9"]) -> Float[Tensor, "*pixel"]:
        """Shares in [0, 1].

        Args:
            read: the result of `readings`.
        """
        return torch.sigmoid(self.layers(read))[..., 0]

    def shares(self, learned: Pixels, hull: Pixels, share: float, views: int) -> Float[Tensor, "*pixel"]:
        """The share of the hull in pixels of rays (ray,), or of pictures (view, 1, height, width).

        Args:
            learned: the pixels of a learned field.
            hull: the same pixels by the visual hull.
            share: of the hull over all pixels, as decided by held-out views.
            views: number of support views.
        """
        (ours, our_opacity), (theirs, their_opacity) = _by_pixel(learned), _by_pixel(hull)
        read = readings(ours, theirs, our_opacity, their_opacity, share, views)
        found = self(read.to(next(self.parameters()))).to(learned.opacity)
        return found[:, None] if isinstance(learned, Pictures) else found


def _by_pixel(pixels: Rendered | Pictures) -> tuple[Float[Tensor, "*pixel 3"], Float[Tensor, "*pixel"]]:
    """Colours and opacities."""
    if isinstance(pixels, Pictures):
        return pixels.images.movedim(1, -1), pixels.opacity[:, 0]
    return pixels.colour, pixels.opacity


def readings(
    learned: Float[Tensor, "*pixel 3"],
    hull: Float[Tensor, "*pixel 3"],
    learned_opacity: Float[Tensor, "*pixel"],
    hull_opacity: Float[Tensor, "*pixel"],
    share: float,
    views: int,
) -> Float[Tensor, "*pixel 9"]:
    """The inputs for pixels: the difference of both colours, both opacities, the overall share and the number of views.

    Args:
        learned: colours of a learned field.
        hull: colours of the visual hull.
        learned_opacity: of the same pixels.
        hull_opacity: of the same pixels.
        share: of the hull over all pixels, as decided by held-out views.
        views: number of support views.
    """
    differing = 4 * (learned - hull).abs().mean(-1)
    every = torch.ones_like(differing)
    edges = (4 * opacity * (1 - opacity) for opacity in (learned_opacity, hull_opacity))
    return torch.stack(
        [
            differing,
            learned_opacity,
            hull_opacity,
            *edges,
            share * every,
            math.log2(views) / 5 * every,
            share * differing,
            share * (learned_opacity - hull_opacity),
        ],
        -1,
    )
