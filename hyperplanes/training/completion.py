"""The loss that teaches a hypernetwork what objects look like where the views that it reads do not show them."""

from __future__ import annotations

from torch import Tensor
from torch.nn.functional import binary_cross_entropy_with_logits

from hyperplanes.parameters import Parameters
from hyperplanes.training.episodes import COMPLETED, Episode

__all__ = ["completion_loss"]


def completion_loss(weights: Parameters, episode: Episode) -> Tensor:
    """How far the first features of the grid are from the hull and the colours of all views of the object.

    Args:
        weights: theta + delta, with a grid of at least COMPLETED features.
        episode: with what all views show.

    Returns:
        The cross entropy of the occupied share, of which feature 0 is the logit, over the cells that the hull of the
        views shown leaves, plus the squared error of the colours, features 1 to 3, over those that are occupied.
    """
    volume, whole = episode.prepared.volume, episode.whole
    assert volume is not None
    assert whole is not None
    grid = weights["fine.grid.weight"][:COMPLETED]
    left = volume[0] > 0
    cells, truth = grid[:, left], whole[:, left].to(grid)
    entropy = binary_cross_entropy_with_logits(cells[0], truth[0])
    error = ((cells[1:] - truth[1:]).square().mean(0) * truth[0]).sum() / truth[0].sum().clamp_min(1)
    return entropy + error
