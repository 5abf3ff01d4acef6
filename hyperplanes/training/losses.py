"""The losses of a step: a list of callables, each with its weight, that read what the forward pass returned."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import binary_cross_entropy_with_logits
from torch.profiler import record_function

from hyperplanes.adaptation.descent import ray_loss
from hyperplanes.configuration.compatibility import VOLUME_CHANNELS
from hyperplanes.configuration.training import TrainingConfig
from hyperplanes.geometry.rays import Sphere
from hyperplanes.training.episodes.drawing import points_in
from hyperplanes.training.forward import ForwardOutput

__all__ = ["EmptinessLoss", "VolumeLoss", "losses_of", "photometric_loss", "thin_opacity"]


def losses_of(config: TrainingConfig) -> list[Callable[[ForwardOutput], Tensor]]:
    """The losses that a training is configured with, in the order in which they are summed.

    Args:
        config: its `empty_points` and `volume_loss` switch two of them on; the photometric loss is always there.
    """
    losses: list[Callable[[ForwardOutput], Tensor]] = [photometric_loss]
    if config.empty_points:
        losses.insert(0, EmptinessLoss(config.empty_points))
    if config.volume_loss:
        losses.append(VolumeLoss(config.volume_loss))
    return losses


def photometric_loss(output: ForwardOutput) -> Tensor:
    """The mean squared error of the colours of query rays (HyperPlanes, Eq. 8), that of a coarse pass added (Eq. 2)."""
    return ray_loss(output.rendered, output.truth)


def thin_opacity(density: Float[Tensor, " point"], bounds: Sphere) -> Float[Tensor, " point"]:
    """The opacity of a layer a tenth of a radius thick, which does not depend on the unit of the world."""
    return 1 - torch.exp(-density * bounds.radius / 10)


@dataclass(frozen=True)
class EmptinessLoss:
    """Teaches a field to be empty outside the visual hull, which packed training never samples.

    The mean `thin_opacity` of random points of the sphere, of which those in the hull count as empty.

    Attributes:
        points: of the sphere, an object and step.
        weight: beside the squared error of pixels.
    """

    points: int
    weight: float = 0.01

    def __call__(self, output: ForwardOutput) -> Tensor:
        """The opacity outside the hull of one object, of its field and of its proposal."""
        field = output.field
        bounds, device = field.occupancy.bounds, field.occupancy.occupied.device
        with record_function("step:emptiness"):
            points = points_in(bounds, self.points, output.generator).to(device)
            points = points[~field.occupancy.contains(points)].to(field.dtype)
            opacity = [thin_opacity(density(points), bounds) for density in field.densities]
            return self.weight * sum((each.sum() for each in opacity), torch.zeros((), device=device)) / self.points


@dataclass(frozen=True)
class VolumeLoss:
    """How far the first features of the grid are from the hull and the colours of all views of the object.

    Teaches a hypernetwork what objects look like where the views that it reads do not show them. The cross entropy of
    the occupied share, of which feature 0 is the logit, over the cells that the hull of the views shown leaves, plus
    the squared error of the colours, features 1 to 3, over those that are occupied.

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
