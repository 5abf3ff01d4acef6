"""The objective of a training: the class that computes the gradient of a step. Here: losses of rendered rays."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from itertools import pairwise

import torch
from torch import Tensor
from torch.profiler import record_function

from hyperplanes.adaptation.base import AdaptedField
from hyperplanes.adaptation.context import SupportContext
from hyperplanes.adaptation.hyperplanes import HyperPlanes
from hyperplanes.adaptation.optimisation.gradients import sum_present, summed_gradients
from hyperplanes.configuration.training import TrainingConfig
from hyperplanes.geometry.kernels.threads import parallel_map
from hyperplanes.parameters import Parameters
from hyperplanes.training.episodes import Batch
from hyperplanes.training.forward import forward
from hyperplanes.training.losses import losses_of
from hyperplanes.views import Tasks

__all__ = ["Objective", "RenderingObjective"]


class Objective(ABC):
    """Computes the gradients of a training step, and adapts held-out objects for validation.

    Attributes:
        updates: for each object of the last step, its update of theta; empty if the objective has no updates.

    Args:
        model: the model, which is trained in place.
        config: the configuration of the training.
    """

    def __init__(self, model: HyperPlanes, config: TrainingConfig) -> None:
        self.model, self.config = model, config
        self.updates: Sequence[Parameters] = ()

    @property
    def rays_per_step(self) -> int:
        """The number of rays in a step, over all objects."""
        return self.config.rays * self.config.tasks

    def tasks(self, data: Tasks) -> Tasks:
        """The tasks to train on; by default they are not changed."""
        return data

    @abstractmethod
    def gradients(self, batch: Batch) -> float:
        """Set the gradients of the model's weights for the objects of this process; returns their mean loss."""

    @abstractmethod
    def adapt(self, prepared: SupportContext) -> AdaptedField:
        """The field of a held-out object."""


class RenderingObjective(Objective):
    """Backpropagates the losses of query rays that are rendered with theta + delta (HyperPlanes, Algorithm 1).

    Args:
        model: a model with a hypernetwork, or a target network alone.
        config: the configuration of the training.
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

        # backward pass from the rays of each object to theta and to its update
        variables = [*weights, *(value for update in leaves for value in update.values())]
        total, found = summed_gradients(loss, len(batch.rendered), variables, thread_safe=thread_safe)
        of_weights, of_updates = found[: len(weights)], found[len(weights) :]
        for value, gradient in zip(weights, of_weights, strict=True):
            value.grad = gradient
        # backward pass through the hypernetwork, from those updates on which the losses depend
        gradients = iter(of_updates)
        ends = [[(value, next(gradients)) for update in group for value in update.values()] for group in written]
        ends = [[(value, found) for value, found in group if found is not None] for group in ends]
        ends = [group for group in ends if group]

        def written_loss(part: int) -> Tensor:
            """A scalar whose gradient with respect to the updates of a group is that of the losses."""
            return torch.stack([(value * found).sum() for value, found in ends[part]]).sum()

        if ends:
            _, of_network = summed_gradients(written_loss, len(ends), weights)
            for value, gradient in zip(weights, of_network, strict=True):
                value.grad = sum_present([value.grad, gradient])
        return float(total)

    def _groups(self, objects: list[SupportContext]) -> list[list[SupportContext]]:
        """The objects in groups that go through the hypernetwork together.

        All objects are one group, because the hypernetwork may standardise codes over them. One that reads volumes
        treats each object alone: on a CPU with two or more objects per thread, each thread gets a group, because
        forward and backward passes through PyTorch's convolutions of single volumes take three times as long.
        """
        threads, total = torch.get_num_threads(), len(objects)
        apart = self.model.reads_volume and self.model.rig.device.type == "cpu" and threads <= total // 2
        count = threads if apart else 1
        bounds = [total * group // count for group in range(count + 1)]
        return [objects[first:last] for first, last in pairwise(bounds)]

    @torch.enable_grad()
    def _write(self, objects: list[SupportContext]) -> list[Parameters]:
        """The updates of a group, with their graph; it may run in any thread."""
        return self.model.updates(objects, mixed_precision=self.mixed_precision)

    def adapt(self, prepared: SupportContext) -> AdaptedField:
        """The field of a held-out object after one forward pass."""
        return self.model.adapt_to(prepared)
