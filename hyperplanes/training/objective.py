"""How the gradient of a step is found: here, by backpropagating the losses of rendered rays."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence

import torch
from torch import Tensor
from torch.profiler import record_function

from hyperplanes.adaptation.base import AdaptedField
from hyperplanes.adaptation.context import SupportContext
from hyperplanes.adaptation.gradients import summed_gradients
from hyperplanes.adaptation.hyperplanes import HyperPlanes
from hyperplanes.configuration.training import TrainingConfig
from hyperplanes.parameters import Parameters
from hyperplanes.training.episodes import Batch
from hyperplanes.training.forward import forward
from hyperplanes.training.losses import losses_of
from hyperplanes.utilities.environment import has_amx
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
        automatic = model.reads_volume and model.rig.device.type == "cpu" and has_amx()
        self.mixed_precision = {"automatic": automatic, "single": False, "bfloat16": True}[config.precision]

    def gradients(self, batch: Batch) -> float:
        """Backpropagate the mean over the rendered objects of the sum of the losses."""
        # the HyperPlanes of all objects in one batch, which batch statistics are taken over (Eq. 7)
        with record_function("step:update"):
            read = [each.episode.prepared for each in (*batch.rendered, *batch.reference)]
            updates = self.model.updates(read, mixed_precision=self.mixed_precision)
        self.updates = [update.detach() for update in updates]
        weights = [value for value in self.model.parameters() if value.requires_grad]
        leaves = [Parameters((name, value.requires_grad_()) for name, value in each.items()) for each in self.updates]
        thread_safe = self.model.field(batch.rendered[0].episode.prepared, self.model.theta).thread_safe

        def loss(place: int) -> Tensor:
            output = forward(self.model, batch.rendered[place], leaves[place], self.config)
            return sum((each(output) for each in self.losses), torch.zeros(())) / len(batch.rendered)

        # back from the rays of each object to theta and to its update
        variables = [*weights, *(value for update in leaves for value in update.values())]
        total, found = summed_gradients(loss, len(batch.rendered), variables, thread_safe=thread_safe)
        of_weights, of_updates = found[: len(weights)], found[len(weights) :]
        for value, gradient in zip(weights, of_weights, strict=True):
            value.grad = gradient
        # and from all updates, if a hypernetwork wrote any, through it
        written = zip((value for update in updates for value in update.values()), of_updates, strict=True)
        ends = [(value, gradient) for value, gradient in written if gradient is not None]
        if ends:
            with record_function("step:gradients"):
                torch.autograd.backward([value for value, _ in ends], [gradient for _, gradient in ends])
        return float(total)

    def adapt(self, prepared: SupportContext) -> AdaptedField:
        """The field of a held-out object, in a single step."""
        return self.model.adapt_to(prepared)
