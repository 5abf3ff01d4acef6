"""Reptile: an initialisation near what gradient descent on each object leads to (Nichol et al. 2018)."""

from __future__ import annotations

from dataclasses import replace

import torch

from hyperplanes.adaptation.descent import ray_loss
from hyperplanes.adaptation.fine_tuning import make_descent
from hyperplanes.data.support import SingleView
from hyperplanes.training.episodes import Batch
from hyperplanes.training.initialisation.base import InitialisationObjective, draw_rays, draw_seed
from hyperplanes.training.meta_gradients import reptile_gradient
from hyperplanes.views import Tasks

__all__ = ["Reptile"]


class Reptile(InitialisationObjective):
    """theta minus what gradient descent on an object leads to is the gradient that Adam gets (Tancik et al. 2021).

    The rays of an object are those of its support views. The loss reported is that of query rays after the descent.
    """

    def tasks(self, data: Tasks) -> Tasks:
        """The tasks; for "sv_meta" with one support view each."""
        return SingleView(data) if self.initialisation.method == "sv_meta" else data

    @property
    def rays_per_step(self) -> int:
        """Rays of all inner steps on all objects."""
        return super().rays_per_step * self.initialisation.inner_steps

    def gradients(self, batch: Batch) -> float:
        """Reptile's gradient, averaged over the objects."""
        total, adapted = 0.0, []
        theta = self.model.theta.detach()
        for draw in batch.rendered:
            episode, generator = draw.episode, draw.generator
            # gradient steps from theta on rays of its support views
            settings = replace(self.initialisation.descent(self.config.rays), seed=draw_seed(generator))
            descent = make_descent(self.model, episode.prepared, settings, start=theta)
            for _ in descent.run(self.initialisation.inner_steps):
                pass
            weights = descent.weights().detach()
            adapted.append(weights)
            field = self.model.field(episode.prepared, weights)
            # what is reported: the loss of query rays there
            with torch.no_grad():
                rays, truth = draw_rays(episode, field, self.config.rays, generator)
                total += float(ray_loss(field.trace(rays, generator), truth))
        self.set_gradients(reptile_gradient(theta, adapted))
        return total / len(batch.rendered)
