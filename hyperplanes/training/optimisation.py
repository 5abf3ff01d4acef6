"""The optimisers of theta and of the hypernetwork, and the schedule of their learning rates."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from hyperplanes.adaptation.hyperplanes import HyperPlanes
from hyperplanes.adaptation.optimisation.optimisers import make_optimisers
from hyperplanes.configuration.training import TrainingConfig

__all__ = ["Optimisation"]


class Optimisation:
    """The optimisers of theta and of the hypernetwork (HyperPlanes, Algorithm 1: separate Adam steps).

    Args:
        model: the model whose weights they update.
        config: rates, schedule and clipping.

    Attributes:
        optimisers: all optimisers, those of theta first.
        parameters: all parameters that they update.
    """

    def __init__(self, model: HyperPlanes, config: TrainingConfig) -> None:
        self.config = config
        theta = list(model.networks.parameters())
        self.optimisers = make_optimisers(theta, config.optimiser, config.learning_rate, config.muon_learning_rate)
        if model.hypernetwork is not None:
            rate = config.hypernetwork_learning_rate
            self.optimisers += make_optimisers(list(model.hypernetwork.parameters()), "adam", rate, 0.0)
        self._rates = [optimiser.param_groups[0]["lr"] for optimiser in self.optimisers]

    @property
    def parameters(self) -> Sequence[Tensor]:
        """All parameters that the optimisers update."""
        return [value for each in self.optimisers for group in each.param_groups for value in group["params"]]

    def zero_grad(self) -> None:
        """Set all gradients to None."""
        for optimiser in self.optimisers:
            optimiser.zero_grad(set_to_none=True)

    def step(self, number: int) -> None:
        """Clip the gradients and update the weights, after `number` steps."""
        for optimiser, rate in zip(self.optimisers, self._rates, strict=True):
            optimiser.param_groups[0]["lr"] = rate * self.rate_factor(number)
        if self.config.clip:
            torch.nn.utils.clip_grad_norm_(self.parameters, self.config.clip)
        for optimiser in self.optimisers:
            optimiser.step()

    def rate_factor(self, number: int) -> float:
        """The factor of all learning rates after `number` steps: linear warm-up to 1, then cosine decay."""
        config = self.config
        if number < config.warmup:
            return (number + 1) / config.warmup
        done = (number - config.warmup) / max(1, config.steps - config.warmup)
        last = config.final_rate_factor
        return last + (1 - last) * (1 + math.cos(math.pi * done)) / 2
