"""The base class of the objectives of learned initialisations."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from hyperplanes.adaptation.base import AdaptedField
from hyperplanes.adaptation.context import SupportContext
from hyperplanes.adaptation.fine_tuning import fine_tune_to, ignoring_no_progress
from hyperplanes.configuration.initialisation import InitialisationConfig
from hyperplanes.geometry.rays import Rays
from hyperplanes.parameters import Parameters
from hyperplanes.training.episodes import Episode
from hyperplanes.training.objective import Objective

__all__ = ["InitialisationObjective", "draw_rays", "draw_seed"]


class InitialisationObjective(Objective):
    """An objective whose weights are validated after gradient steps on an object, as many as in training.

    Args:
        model: a model without a hypernetwork, which is trained in place.
        config: the configuration of the training.
    """

    @property
    def initialisation(self) -> InitialisationConfig:
        """How the initialisation is learned."""
        assert self.model.config.initialisation is not None
        return self.model.config.initialisation

    def adapt(self, prepared: SupportContext) -> AdaptedField:
        """The field of a held-out object after as many gradient steps as in training, even if they make no progress."""
        settings = replace(self.initialisation.descent(self.config.rays), seed=self.config.seed)
        return ignoring_no_progress(
            lambda: fine_tune_to(self.model, prepared, self.initialisation.inner_steps, settings)
        )

    def set_gradients(self, gradient: Parameters) -> None:
        """Set the gradients for the optimisers, since no backward pass does so."""
        for name, value in self.model.networks.named_parameters():
            value.grad = gradient[name]


def draw_seed(generator: torch.Generator) -> int:
    """A random seed for another generator."""
    return int(torch.randint(2**31, (), generator=generator))


def draw_rays(
    episode: Episode, field: AdaptedField, count: int, generator: torch.Generator, *, of_support: bool = False
) -> tuple[Rays, Tensor]:
    """Random rays of the query views of an object, or of its planes, and their true colours."""
    views, live = (episode.prepared.views, episode.support_live) if of_support else (episode.query, episode.live)
    return views.sample_rays(count, generator=generator, among=live, near_far=field.sampling.near_far)
