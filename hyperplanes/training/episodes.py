"""The objects of a training as its steps need them: planes, hull and query views."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

from jaxtyping import Int
from torch import Tensor

from hyperplanes.adaptation.hyperplanes import HyperPlanes, Prepared
from hyperplanes.rendering.footprint import footprint
from hyperplanes.utilities.errors import prefix_errors
from hyperplanes.views import Task, Views

__all__ = ["Episode", "prepare_episode"]


@dataclass(frozen=True)
class Episode:
    """One object, where the model is.

    Attributes:
        prepared: its support side.
        query: the views that the loss is taken on.
        live: flat indices of the query pixels that look into the hull; None where all are drawn from.
    """

    prepared: Prepared
    query: Views
    live: Int[Tensor, " pixel"] | None

    @cached_property
    def support_live(self) -> Int[Tensor, " pixel"] | None:
        """Flat indices of the pixels of the planes that look into the hull; None where all are drawn from."""
        if self.live is None:
            return None
        return footprint(self.prepared.occupancy, self.prepared.views.cameras).flatten().nonzero()[:, 0]

    @property
    def nbytes(self) -> int:
        """Memory of images, masks, hull and indices, and of the copy that lookups make of the planes."""
        planes = self.prepared.views
        own = planes.nbytes + planes.images.nbytes // 3 + self.query.nbytes + self.prepared.occupancy.occupied.nbytes
        return own + (0 if self.live is None else self.live.nbytes)


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
        query = task.query.to(model.rig.device)
        live = None
        if model.config.sampling.needs_occupancy:
            live = footprint(prepared.occupancy, query.cameras).flatten().nonzero()[:, 0]
    return Episode(prepared, query, live)
