"""MAML: an initialisation that minimises the loss after gradient steps, by the gradient through these steps."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from hyperplanes.adaptation.hyperplanes import HyperPlanes
from hyperplanes.adaptation.optimisation.descent import ray_loss
from hyperplanes.configuration.training import TrainingConfig
from hyperplanes.geometry.rays import Rays
from hyperplanes.parameters import Parameters
from hyperplanes.rendering.renderer import RayMarching, Sampler
from hyperplanes.training.episodes import Batch, Episode
from hyperplanes.training.initialisation.base import InitialisationObjective, draw_rays, draw_seed
from hyperplanes.training.meta_gradients import maml_gradient

__all__ = ["MAML"]


class MAML(InitialisationObjective):
    """The loss of query rays after gradient steps on support rays, differentiated through them (Finn et al. 2017).

    Raises:
        ValueError: a permutation-invariant field, which would learn to copy the views of the support rays.
    """

    def __init__(self, model: HyperPlanes, config: TrainingConfig) -> None:
        if model.target.permutation_invariant:
            raise ValueError(f"maml: expected a field with a fixed order of views, got {model.config.target}")
        super().__init__(model, config)

    @property
    def rays_per_step(self) -> int:
        """The number of rays of all inner steps and of the outer loss, over all objects."""
        return super().rays_per_step * (self.initialisation.inner_steps + 1)

    def gradients(self, batch: Batch) -> float:
        """Set the gradient of MAML, averaged over the objects; returns the mean outer loss."""
        total, mean, count = 0.0, Parameters(), len(batch.rendered)
        initialisation, theta = self.initialisation, self.model.theta.detach()
        first_order, sampling = initialisation.method == "maml_first_order", self.model.config.sampling
        if not first_order and isinstance(sampling, RayMarching):
            sampling = replace(sampling, stop=0.0)  # otherwise gradients are estimates with wrong second derivatives
        for draw in batch.rendered:
            episode, generator, rays = draw.episode, draw.generator, self.config.rays
            field = self.model.field(episode.prepared, theta)
            # draw support rays for every inner step, and query rays for the outer loss
            drawn = [
                draw_rays(episode, field, rays, generator, of_support=True) for _ in range(initialisation.inner_steps)
            ]
            drawn.append(draw_rays(episode, field, rays, generator))
            *inner, outer = [self._loss(episode, sampling, *each, draw_seed(generator)) for each in drawn]
            # the gradient of the outer loss through the inner steps
            gradient, loss = maml_gradient(theta, inner, outer, initialisation.inner_rate, first_order=first_order)
            total += float(loss)
            parts = {name: value / count for name, value in gradient.items()}
            mean = mean + parts if mean else Parameters(parts)
        self.set_gradients(mean)
        return total / count

    def _loss(
        self, episode: Episode, sampling: Sampler, rays: Rays, truth: Tensor, seed: int
    ) -> Callable[[Parameters], Tensor]:
        def loss(parameters: Parameters) -> Tensor:
            field = self.model.field(episode.prepared, parameters).with_sampling(sampling)
            return ray_loss(field.trace(rays, torch.Generator().manual_seed(seed)), truth)

        return loss
