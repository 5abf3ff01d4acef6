"""How the gradient of a step is found: here, by backpropagating the losses of rendered rays."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence

import torch
from torch.profiler import record_function

from hyperplanes.adaptation.base import AdaptedField
from hyperplanes.adaptation.context import SupportContext
from hyperplanes.adaptation.hyperplanes import HyperPlanes
from hyperplanes.configuration.training import TrainingConfig
from hyperplanes.parameters import Parameters
from hyperplanes.training.episodes import Batch
from hyperplanes.training.forward import forward
from hyperplanes.training.losses import losses_of
from hyperplanes.views import Tasks

__all__ = ["Objective", "RenderingObjective"]


class Objective(ABC):
    """What a training does with the objects of a step, and how it is judged.

    Attributes:
        updates: the updates of theta of the last step, an object each; none where it has none.

    Args:
        model: trained in place.
        config: of the training.
    """

    def __init__(self, model: HyperPlanes, config: TrainingConfig) -> None:
        self.model, self.config = model, config
        self.updates: Sequence[Parameters] = ()

    @property
    def rays_per_step(self) -> int:
        """Rays of all objects of a step."""
        return self.config.rays * self.config.tasks

    def tasks(self, data: Tasks) -> Tasks:
        """The tasks as this training shows them to the model: as they are."""
        return data

    @abstractmethod
    def gradients(self, batch: Batch) -> float:
        """Set the gradients of the model's weights for this process's objects; returns the mean loss of these."""

    @abstractmethod
    def adapt(self, prepared: SupportContext) -> AdaptedField:
        """The field of a held-out object."""


class RenderingObjective(Objective):
    """The losses of query rays rendered with theta + delta, by backpropagation (HyperPlanes, Algorithm 1).

    Args:
        model: with a hypernetwork, or a target alone.
        config: of the training.
    """

    def __init__(self, model: HyperPlanes, config: TrainingConfig) -> None:
        super().__init__(model, config)
        self.losses = losses_of(config)

    def gradients(self, batch: Batch) -> float:
        """Backpropagate the mean over the rendered objects of the sum of the losses."""
        total, count = torch.zeros(()), len(batch.rendered)
        # the HyperPlanes of all objects in one batch, which batch statistics are taken over (Eq. 7)
        with record_function("step:update"):
            updates = self.model.updates([each.episode.prepared for each in (*batch.rendered, *batch.reference)])
        for draw, update in zip(batch.rendered, updates[:count], strict=True):
            output = forward(self.model, draw, update, self.config)
            for loss in self.losses:
                total = total + loss(output)
        with record_function("step:gradients"):
            (total / count).backward()
        self.updates = [update.detach() for update in updates]
        return float(total.detach()) / count

    def adapt(self, prepared: SupportContext) -> AdaptedField:
        """The field of a held-out object, in a single step."""
        return self.model.adapt_to(prepared)
