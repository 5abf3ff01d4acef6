"""One object prepared for training steps: planes, visual hull and query views."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from jaxtyping import Float, Int
from torch import Tensor

from hyperplanes.adaptation.context import SupportContext, live_pixels
from hyperplanes.adaptation.hyperplanes import HyperPlanes
from hyperplanes.configuration.compatibility import VOLUME_CHANNELS
from hyperplanes.geometry.visibility.planes import VisibilityPlanes
from hyperplanes.utilities.messages.errors import prefix_errors
from hyperplanes.views import Task, Views, join_views

__all__ = ["Episode", "prepare_episode", "prepare_subset", "volume_of_all_views"]

QUERIES = 4  # query views of an episode with random support views


@dataclass(frozen=True)
class Episode:
    """One object, on the device of the model.

    Attributes:
        prepared: the support views and what is computed from them.
        query: the views from which the rays of the loss are drawn.
        live: flat indices of the query pixels whose rays may meet the hull; None if rays are drawn from all pixels.
        target_volume: the result of `volume_of_all_views`, if the training has a volume loss.
    """

    prepared: SupportContext
    query: Views
    live: Int[Tensor, " pixel"] | None
    target_volume: Float[Tensor, "4 x y z"] | None = None

    @cached_property
    def support_live(self) -> Int[Tensor, " pixel"] | None:
        """Flat indices of the pixels of the planes whose rays may meet the hull; None if rays are drawn from all."""
        if self.live is None:
            return None
        return live_pixels(self.prepared.occupancy, self.prepared.views)

    @property
    def nbytes(self) -> int:
        """The bytes of images, masks, hull, volumes and indices, and of the copy of the planes that lookups make."""
        planes = self.prepared.views
        own = (
            planes.nbytes * (2 if isinstance(self.prepared.planes, VisibilityPlanes) else 1)
            + planes.images.nbytes // 3
            + self.query.nbytes
            + self.prepared.occupancy.occupied.nbytes
        )
        further = (self.live, self.prepared.volume, self.target_volume)
        return own + sum(each.nbytes for each in further if each is not None)


def prepare_episode(model: HyperPlanes, task: Task, *, carved: bool = True) -> Episode:
    """An object prepared for training steps.

    Args:
        model: the model, which determines the planes and the device.
        task: the object.
        carved: whether to carve the visual hull; `Hierarchical` sampling does not need it.

    Returns:
        Everything that does not depend on weights.
    """
    with prefix_errors(task.name):
        prepared = model.prepare(task.support, carved=carved)
        query = model.to_own(task.query)
        live = None
        if model.config.sampling.needs_occupancy:
            live = live_pixels(prepared.occupancy, query)
    return Episode(prepared, query, live)


def prepare_subset(
    model: HyperPlanes,
    task: Task,
    counts: Sequence[int],
    generator: torch.Generator,
    target_volume: Float[Tensor, "4 x y z"] | None = None,
) -> Episode:
    """An object with a random number of random support views, and up to QUERIES of its other views as query views.

    Args:
        model: a model for any number of views in any order.
        task: the object; its division into support and query views does not matter.
        counts: numbers of support views, each with equal probability; at least one view is left as a query view.
        generator: the generator of the choice.
        target_volume: the result of `volume_of_all_views`.

    Returns:
        The object, prepared for training steps.
    """
    views = join_views(task.support, task.query)
    count = counts[int(torch.randint(len(counts), (), generator=generator))]
    count = min(count, len(views) - 1)
    order = torch.randperm(len(views), generator=generator).to(views.images.device)
    shown, asked = views[order[:count]], views[order[count : count + QUERIES]]
    return replace(prepare_episode(model, Task(shown, asked, task.name)), target_volume=target_volume)


def volume_of_all_views(model: HyperPlanes, task: Task) -> Float[Tensor, "4 x y z"]:
    """For each cell of the volume, the share in the hull of all views, and the mean colour of all views.

    Returns:
        The first channels of `volume_of`, in half precision, because they are kept for every object of a training.
    """
    with prefix_errors(task.name):
        volume = model.prepare(join_views(task.support, task.query)).volume
    assert volume is not None
    return volume[:VOLUME_CHANNELS].half()
