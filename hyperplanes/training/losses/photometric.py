"""The squared error of the colours of rays (HyperPlanes, Eq. 8)."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from hyperplanes.adaptation.descent import ray_loss
from hyperplanes.training.forward import ForwardOutput

__all__ = ["PhotometricLoss"]


@dataclass(frozen=True)
class PhotometricLoss:
    """Mean squared error of the colours of query rays, that of the coarse pass added where there is one (Eq. 2)."""

    def __call__(self, output: ForwardOutput) -> Tensor:
        """The error of the rays of one object."""
        return ray_loss(output.rendered, output.truth)
