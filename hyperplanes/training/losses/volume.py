"""The loss that teaches a hypernetwork what objects look like where the views that it reads do not show them."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor
from torch.nn.functional import binary_cross_entropy_with_logits

from hyperplanes.configuration.compatibility import VOLUME_CHANNELS
from hyperplanes.training.forward import ForwardOutput

__all__ = ["VolumeLoss"]


@dataclass(frozen=True)
class VolumeLoss:
    """How far the first features of the grid are from the hull and the colours of all views of the object.

    The cross entropy of the occupied share, of which feature 0 is the logit, over the cells that the hull of the views
    shown leaves, plus the squared error of the colours, features 1 to 3, over those that are occupied.

    Attributes:
        weight: beside the squared error of pixels.
    """

    weight: float

    def __call__(self, output: ForwardOutput) -> Tensor:
        """The loss of a field with a grid of at least VOLUME_CHANNELS features."""
        shown, target = output.episode.prepared.volume, output.episode.target_volume
        assert shown is not None
        assert target is not None
        grid = output.parameters["fine.grid.weight"][:VOLUME_CHANNELS]
        # only cells that the views shown leave: what they rule out, the field never evaluates
        left = shown[0] > 0
        cells, truth = grid[:, left], target[:, left].to(grid)
        entropy = binary_cross_entropy_with_logits(cells[0], truth[0])
        # a cell counts for its colour as far as it is occupied
        error = ((cells[1:] - truth[1:]).square().mean(0) * truth[0]).sum() / truth[0].sum().clamp_min(1)
        return self.weight * (entropy + error)
