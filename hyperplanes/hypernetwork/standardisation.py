"""Standardisation of codes over objects."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor, nn

__all__ = ["RunningStandardisation"]


class RunningStandardisation(nn.Module):
    """Subtracts a running mean over objects and divides by a running standard deviation.

    Batch normalisation without an affine part that uses its running statistics in training too, so that a step of a
    single object is possible and training and evaluation compute the same function. No gradient flows through the
    statistics. Without it, codes of different objects of one class differ by about 2 % of what they have in common.

    Args:
        shape: of the codes of one object.
        momentum: weight of the newest step in the statistics; the first 1 / momentum steps are averaged evenly.
        epsilon: added to the variance.
    """

    mean: Tensor
    variance: Tensor
    steps: Tensor

    def __init__(self, shape: tuple[int, ...], momentum: float = 0.02, epsilon: float = 1e-5) -> None:
        super().__init__()
        self.momentum = momentum
        self.epsilon = epsilon
        self.register_buffer("mean", torch.zeros(shape))
        self.register_buffer("variance", torch.ones(shape))
        self.register_buffer("steps", torch.zeros(()))

    def forward(self, codes: Float[Tensor, object * shape]) -> Float[Tensor, object * shape]:
        """Codes of mean 0 and variance 1 over the objects of the training; updates the statistics in training."""
        if self.training:
            self._update(codes.detach())
        return (codes - self.mean) * torch.rsqrt(self.variance + self.epsilon)

    @torch.no_grad()
    def _update(self, codes: Tensor) -> None:
        self.steps += 1
        weight = torch.clamp_min(1 / self.steps, self.momentum)
        if self.steps == 1:
            self.mean.copy_(codes.mean(0))
            if len(codes) > 1:
                self.variance.copy_(codes.var(0))
            return
        before = codes - self.mean
        self.mean += weight * before.mean(0)
        self.variance += weight * ((before * (codes - self.mean)).mean(0) - self.variance)
