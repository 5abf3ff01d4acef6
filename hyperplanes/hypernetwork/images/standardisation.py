"""Standardisation of codes over objects."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor, nn

from hyperplanes.hypernetwork.synchronisation import gather_objects

__all__ = ["RunningStandardisation"]

EPSILON = 1e-5  # added to the variance
MOMENTUM = 0.05  # weight of the newest step in the statistics; the first 1 / MOMENTUM steps have equal weights


class RunningStandardisation(nn.Module):
    """Batch renormalisation (Ioffe 2017) over objects, without affine parameters.

    The value is (code - running mean) / running standard deviation in training and evaluation. The gradient is that of
    normalising with the statistics of the objects of the step, so that nothing is learned from what they share. With a
    single object there are no such statistics, and the running ones are constants.

    Without it, codes of different objects of one class differ by about 2 % of what they share, and later layers learn
    to use what they share: docs/hypernetwork.md.

    Args:
        shape: of the codes of one object.
    """

    mean: Tensor
    variance: Tensor
    steps: Tensor

    def __init__(self, shape: tuple[int, ...]) -> None:
        super().__init__()
        self.register_buffer("mean", torch.zeros(shape))
        self.register_buffer("variance", torch.ones(shape))
        self.register_buffer("steps", torch.zeros(()))

    def forward(self, codes: Float[Tensor, "object ..."]) -> Float[Tensor, "object ..."]:
        """Codes with mean 0 and variance 1 over the training objects; in training, this updates the statistics."""
        if not self.training:
            return self._standardised(codes)
        codes, own = gather_objects(codes)
        return self._renormalised(codes)[own]

    def _renormalised(self, codes: Tensor) -> Tensor:
        self._update(codes.detach())
        if len(codes) == 1:
            return self._standardised(codes)
        deviation = (codes.var(0, unbiased=False) + EPSILON).sqrt()
        normalised = (codes - codes.mean(0)) / deviation
        running = (self.variance + EPSILON).sqrt()
        scale = (deviation / running).detach()
        shift = ((codes.mean(0) - self.mean) / running).detach()
        return normalised * scale + shift

    def _standardised(self, codes: Tensor) -> Tensor:
        return (codes - self.mean) * torch.rsqrt(self.variance + EPSILON)

    @torch.no_grad()
    def _update(self, codes: Tensor) -> None:
        self.steps += 1
        weight = torch.clamp_min(1 / self.steps, MOMENTUM)
        if self.steps == 1:
            self.mean.copy_(codes.mean(0))
            if len(codes) > 1:
                self.variance.copy_(codes.var(0))
            return
        before = codes - self.mean
        self.mean += weight * before.mean(0)
        # a first step with a single object has no variance: the first one measured replaces the initial one
        first = bool(self.steps == 2) and bool((self.variance == 1).all())
        self.variance += (1.0 if first else weight) * ((before * (codes - self.mean)).mean(0) - self.variance)
