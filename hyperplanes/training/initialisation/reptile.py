"""Reptile: an initialisation near the weights after gradient descent on each object (Nichol et al. 2018)."""

from __future__ import annotations

from dataclasses import replace

import torch

from hyperplanes.adaptation.fine_tuning import make_descent
from hyperplanes.adaptation.optimisation.descent import ray_loss
from hyperplanes.data.support import SingleView
from hyperplanes.training.episodes import Batch
from hyperplanes.training.initialisation.base import InitialisationObjective, draw_rays, draw_seed
from hyperplanes.training.meta_gradients import reptile_gradient
from hyperplanes.views import Tasks

__all__ = ["Reptile"]


class Reptile(InitialisationObjective):
    """Passes theta minus the weights after gradient descent on an object to Adam as a gradient (Tancik et al. 2021).

    Gradient descent uses rays of the support views. The reported loss is that of query rays after it.
    """

    def tasks(self, data: Tasks) -> Tasks:
        """The tasks to train on; for "sv_meta", each has one support view."""
        return SingleView(data) if self.initialisation.method == "sv_meta" else data

    @property
    def rays_per_step(self) -> int:
        """The number of rays of all inner steps, over all objects."""
        return super().rays_per_step * self.initialisation.inner_steps

    def gradients(self, batch: Batch) -> float:
        """Set the gradient of Reptile, averaged over the objects; returns the mean loss of query rays."""
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
            # the reported loss, of query rays with the final weights
            with torch.no_grad():
                rays, truth = draw_rays(episode, field, self.config.rays, generator)
                total += float(ray_loss(field.trace(rays, generator), truth))
        self.set_gradients(reptile_gradient(theta, adapted))
        return total / len(batch.rendered)
