"""The losses of a step: a list of callables, each with its weight, that read what the forward pass returned."""

from __future__ import annotations

from typing import Protocol

from torch import Tensor

from hyperplanes.configuration.training import TrainingConfig
from hyperplanes.training.forward import ForwardOutput
from hyperplanes.training.losses.emptiness import EmptinessLoss
from hyperplanes.training.losses.photometric import PhotometricLoss
from hyperplanes.training.losses.volume import VolumeLoss

__all__ = ["EmptinessLoss", "Loss", "PhotometricLoss", "VolumeLoss", "losses_of"]


class Loss(Protocol):
    """A term of what is minimised."""

    def __call__(self, output: ForwardOutput) -> Tensor:
        """Its value for one object, times its weight."""
        ...


def losses_of(config: TrainingConfig) -> list[Loss]:
    """The losses that a training is configured with, in the order in which they are summed.

    Args:
        config: its `empty_points` and `volume_loss` switch two of them on; the photometric loss is always there.
    """
    losses: list[Loss] = [PhotometricLoss()]
    if config.empty_points:
        losses.insert(0, EmptinessLoss(config.empty_points))
    if config.volume_loss:
        losses.append(VolumeLoss(config.volume_loss))
    return losses
