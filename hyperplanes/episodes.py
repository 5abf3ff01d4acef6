"""The objects of a training as its steps need them: planes, hull and query views, kept while there is room."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Generator
from contextlib import contextmanager
from dataclasses import dataclass

from jaxtyping import Int
from torch import Tensor

from hyperplanes.adaptation.hyperplanes import HyperPlanes, Prepared
from hyperplanes.rendering.footprint import footprint
from hyperplanes.views import Task, Views

__all__ = ["Episode", "Kept", "naming", "prepare_episode"]


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
    with naming(task.name):
        prepared = model.prepare(task.support, carved=carved)
        query = task.query.to(model.rig.device)
        live = None
        if model.config.sampling.needs_occupancy:
            live = footprint(prepared.occupancy, query.cameras).flatten().nonzero()[:, 0]
    return Episode(prepared, query, live)


@contextmanager
def naming(name: str) -> Generator[None]:
    """What goes wrong in here says which object it is about.

    Raises:
        ValueError: as the one that was raised, with the name before it.
    """
    try:
        yield
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from error


class Kept:
    """Episodes by name, the least recently used dropped when they take more than some bytes; the last one stays."""

    def __init__(self, budget: int) -> None:
        self.budget = budget
        self.nbytes = 0
        self._episodes: OrderedDict[str, Episode] = OrderedDict()

    def __len__(self) -> int:
        return len(self._episodes)

    def get(self, name: str) -> Episode | None:
        """The episode of that name, where it is still there."""
        if name in self._episodes:
            self._episodes.move_to_end(name)
        return self._episodes.get(name)

    def add(self, name: str, episode: Episode) -> None:
        """Keep one more."""
        self._episodes[name] = episode
        self.nbytes += episode.nbytes
        while self.nbytes > self.budget and len(self._episodes) > 1:
            self.nbytes -= self._episodes.popitem(last=False)[1].nbytes
