"""How the gradient of a step is found: here, by backpropagating the losses of rendered rays."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from itertools import pairwise

import torch
from torch import Tensor
from torch.profiler import record_function

from hyperplanes.adaptation.base import AdaptedField
from hyperplanes.adaptation.context import SupportContext
from hyperplanes.adaptation.gradients import sum_present, summed_gradients
from hyperplanes.adaptation.hyperplanes import HyperPlanes
from hyperplanes.configuration.training import TrainingConfig
from hyperplanes.geometry.kernels.threads import parallel_map
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
        self.mixed_precision = config.precision == "bfloat16"

    def gradients(self, batch: Batch) -> float:
        """Backpropagate the mean over the rendered objects of the sum of the losses."""
        # the updates of all objects (Eq. 7)
        groups = self._groups([each.episode.prepared for each in (*batch.rendered, *batch.reference)])
        with record_function("step:update"):
            written = list(parallel_map(self._write, groups))
        self.updates = [update.detach() for group in written for update in group]
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
        # and from those updates that the losses depend on, if a hypernetwork wrote any, through it
        gradients = iter(of_updates)
        ends = [[(value, next(gradients)) for update in group for value in update.values()] for group in written]
        ends = [[(value, found) for value, found in group if found is not None] for group in ends]
        ends = [group for group in ends if group]

        def written_loss(part: int) -> Tensor:
            """Whose gradients are those of the losses at the updates of a group."""
            return torch.stack([(value * found).sum() for value, found in ends[part]]).sum()

        if ends:
            _, of_network = summed_gradients(written_loss, len(ends), weights)
            for value, gradient in zip(weights, of_network, strict=True):
                value.grad = sum_present([value.grad, gradient])
        return float(total)

    def _groups(self, objects: list[SupportContext]) -> list[list[SupportContext]]:
        """The objects that go through the hypernetwork together: all of them, since it may compare them.

        One that reads volumes reads each alone. There every thread has a group, where there are two objects for each:
        PyTorch's convolutions of single volumes, back and forth, take three times as long.
        """
        threads, total = torch.get_num_threads(), len(objects)
        apart = self.model.reads_volume and self.model.rig.device.type == "cpu" and threads <= total // 2
        count = threads if apart else 1
        bounds = [total * group // count for group in range(count + 1)]
        return [objects[first:last] for first, last in pairwise(bounds)]

    @torch.enable_grad()
    def _write(self, objects: list[SupportContext]) -> list[Parameters]:
        """The updates of a group, with their graph, in whatever thread."""
        return self.model.updates(objects, mixed_precision=self.mixed_precision)

    def adapt(self, prepared: SupportContext) -> AdaptedField:
        """The field of a held-out object, in a single step."""
        return self.model.adapt_to(prepared)
