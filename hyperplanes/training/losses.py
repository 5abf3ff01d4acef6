"""The losses of a training step: callables that take the result of the forward pass. Each applies its own weight."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import binary_cross_entropy_with_logits
from torch.profiler import record_function

from hyperplanes.adaptation.optimisation.descent import ray_loss
from hyperplanes.configuration.compatibility import VOLUME_CHANNELS
from hyperplanes.configuration.training import TrainingConfig
from hyperplanes.geometry.rays import Sphere
from hyperplanes.training.episodes.drawing import points_in
from hyperplanes.training.forward import ForwardOutput

__all__ = ["EmptinessLoss", "VolumeLoss", "losses_of", "photometric_loss", "thin_opacity"]

EMPTINESS_WEIGHT = 0.01  # the factor of `EmptinessLoss`; that of the squared error of pixels is 1


def losses_of(config: TrainingConfig) -> list[Callable[[ForwardOutput], Tensor]]:
    """The losses of a training, in the order in which they are summed.

    Args:
        config: the photometric loss is always included; `empty_points` and `volume_loss` each add another.
    """
    losses: list[Callable[[ForwardOutput], Tensor]] = [photometric_loss]
    if config.empty_points:
        losses.insert(0, EmptinessLoss(config.empty_points))
    if config.volume_loss:
        losses.append(VolumeLoss(config.volume_loss))
    return losses


def photometric_loss(output: ForwardOutput) -> Tensor:
    """The mean squared error of the colours of query rays (HyperPlanes, Eq. 8), plus that of a coarse pass (Eq. 2)."""
    return ray_loss(output.rendered, output.truth)


def thin_opacity(density: Float[Tensor, " point"], bounds: Sphere) -> Float[Tensor, " point"]:
    """The opacity of a layer that is a tenth of the radius thick; it does not depend on the unit of the world."""
    return 1 - torch.exp(-density * bounds.radius / 10)


@dataclass(frozen=True)
class EmptinessLoss:
    """Penalises density outside the visual hull, where training with packed samples never evaluates the field.

    The loss is the mean `thin_opacity` of random points in the sphere of the scene; points in the hull count as 0.

    Attributes:
        points: the number of random points per object and step.
    """

    points: int

    def __call__(self, output: ForwardOutput) -> Tensor:
        """The loss of the field of one object, plus that of its proposal field if it has one."""
        field = output.field
        bounds, device = field.occupancy.bounds, field.occupancy.occupied.device
        with record_function("step:emptiness"):
            points = points_in(bounds, self.points, output.generator).to(device)
            points = points[~field.occupancy.contains(points)].to(field.dtype)
            opacity = [thin_opacity(density(points), bounds) for density in field.densities]
            return (
                EMPTINESS_WEIGHT * sum((each.sum() for each in opacity), torch.zeros((), device=device)) / self.points
            )


@dataclass(frozen=True)
class VolumeLoss:
    """The difference of the first features of the grid from the visual hull and the mean colours of all views.

    The hypernetwork learns from it the shape and colour of parts that its support views do not show. The loss is the
    cross entropy of the occupied share of each cell, whose logit is feature 0, over the cells in the hull of the
    support views, plus the squared error of the colours, features 1 to 3, weighted by the true occupied share.

    Attributes:
        weight: the factor of this loss; that of the squared error of pixels is 1.
    """

    weight: float

    def __call__(self, output: ForwardOutput) -> Tensor:
        """The loss of a field with a grid of at least VOLUME_CHANNELS features."""
        shown, target = output.episode.prepared.volume, output.episode.target_volume
        assert shown is not None
        assert target is not None
        grid = output.parameters["fine.grid.weight"][:VOLUME_CHANNELS]
        # only cells in the hull of the support views: the field is never evaluated in others
        left = shown[0] > 0
        cells, truth = grid[:, left], target[:, left].to(grid)
        entropy = binary_cross_entropy_with_logits(cells[0], truth[0])
        # the error of a colour is weighted by the occupied share of the cell
        error = ((cells[1:] - truth[1:]).square().mean(0) * truth[0]).sum() / truth[0].sum().clamp_min(1)
        return self.weight * (entropy + error)
