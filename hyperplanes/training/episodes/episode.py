"""One object as a step of training needs it: planes, hull and query views."""

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
from hyperplanes.geometry.visibility import VisibilityPlanes
from hyperplanes.utilities.errors import prefix_errors
from hyperplanes.views import Task, Views, join_views

__all__ = ["Episode", "prepare_episode", "prepare_subset", "volume_of_all_views"]

QUERIES = 4  # views that rays are drawn from, of those that an episode does not show


@dataclass(frozen=True)
class Episode:
    """One object, where the model is.

    Attributes:
        prepared: its support side.
        query: the views that the loss is taken on.
        live: flat indices of the query pixels that look into the hull; None where all are drawn from.
        target_volume: of `volume_of_all_views`, where the training has a volume loss.
    """

    prepared: SupportContext
    query: Views
    live: Int[Tensor, " pixel"] | None
    target_volume: Float[Tensor, "4 x y z"] | None = None

    @cached_property
    def support_live(self) -> Int[Tensor, " pixel"] | None:
        """Flat indices of the pixels of the planes that look into the hull; None where all are drawn from."""
        if self.live is None:
            return None
        return live_pixels(self.prepared.occupancy, self.prepared.views)

    @property
    def nbytes(self) -> int:
        """Memory of images, masks, hull, volumes and indices, and of the copy that lookups make of the planes."""
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
    """An object made ready for steps of training.

    Args:
        model: whose planes and device count.
        task: the object.
        carved: without, no hull is made; `Hierarchical` sampling never reads one.

    Returns:
        All of it that does not depend on weights.
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
    """An object shown by a random number of random views, some others of which are the query views.

    Args:
        model: takes any number of views in any order.
        task: the object; which of its views are support and which query does not matter.
        counts: of the views that are shown, each as likely as the others; one is left for the query.
        generator: of the choice.
        target_volume: of `volume_of_all_views`.

    Returns:
        The object, made ready for steps of training.
    """
    views = join_views(task.support, task.query)
    count = counts[int(torch.randint(len(counts), (), generator=generator))]
    count = min(count, len(views) - 1)
    order = torch.randperm(len(views), generator=generator).to(views.images.device)
    shown, asked = views[order[:count]], views[order[count : count + QUERIES]]
    return replace(prepare_episode(model, Task(shown, asked, task.name)), target_volume=target_volume)


def volume_of_all_views(model: HyperPlanes, task: Task) -> Float[Tensor, "4 x y z"]:
    """What all views of an object together show of each cell: the share that the hull occupies, and the mean colour.

    Returns:
        The first channels of `volume_of`, in half precision: they are kept for every object of a training.
    """
    with prefix_errors(task.name):
        volume = model.prepare(join_views(task.support, task.query)).volume
    assert volume is not None
    return volume[:VOLUME_CHANNELS].half()
