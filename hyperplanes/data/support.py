"""Tasks with other support or query views than their data set states, or with a sphere that its files do not state."""

from __future__ import annotations

import zlib
from dataclasses import dataclass, replace
from typing import Literal

import torch
from torch import Tensor

from hyperplanes.data.wrapper import TaskWrapper
from hyperplanes.geometry.poses import farthest_first
from hyperplanes.geometry.rays import Sphere
from hyperplanes.views import Task, join_views

__all__ = ["Choice", "FewerQueries", "Inputs", "Shown", "SingleView", "WithBounds", "WithSupport"]

Choice = Literal["first", "farthest", "random"]


@dataclass(frozen=True)
class WithSupport(TaskWrapper):
    """Tasks with another number of support views.

    Where there are more than an object has, its query views follow, in their order: support and query unified, as the
    paper does to have up to 50 ImagePlanes. They stay query views, too, so a method is then judged by views that it was
    shown.

    Attributes:
        count: support views of every object.
        choose: which of an object's support views, if there are fewer than it has: the first ones; those whose cameras
            are farthest apart, beginning with the first view; or a random choice, another one for every object.
        seed: of random choices.
    """

    count: int
    choose: Choice = "first"
    seed: int = 0

    def __post_init__(self) -> None:
        if self.count < 1:
            raise ValueError(f"support: expected at least 1 view, got {self.count}")

    def change(self, task: Task) -> Task:
        """The task with `count` support views; ValueError where the object has fewer views."""
        total = len(task.support) + len(task.query)
        if self.count > total:
            raise ValueError(
                f"{task.name}: expected {self.count} views for the support, got {total}; "
                f"--support {total} takes all of them"
            )
        more = self.count - len(task.support)
        support = task.support[self._chosen(task)] if more <= 0 else join_views(task.support, task.query[:more])
        return replace(task, support=support)

    def _chosen(self, task: Task) -> Tensor:
        """Indices of the chosen support views."""
        if self.choose == "farthest":
            return torch.tensor(farthest_first(task.support.camera_directions, 0, self.count))
        if self.choose == "random":
            generator = torch.Generator().manual_seed(zlib.crc32(f"{self.seed} {task.name}".encode()))
            return torch.randperm(len(task.support), generator=generator)[: self.count]
        return torch.arange(self.count)


@dataclass(frozen=True)
class SingleView(TaskWrapper):
    """Tasks of which one support view is left, always the same of an object."""

    def change(self, task: Task) -> Task:
        """The task with the view that the name of the object decides on."""
        chosen = zlib.crc32(task.name.encode()) % len(task.support)
        return replace(task, support=task.support[[chosen]])


@dataclass(frozen=True)
class WithBounds(TaskWrapper):
    """Tasks whose scene is held by a given sphere, whatever their masks say.

    Attributes:
        bounds: the sphere; rays of constant span begin and end at the distance of its centre minus and plus its radius.
    """

    bounds: Sphere

    def change(self, task: Task) -> Task:
        """The task with that sphere."""
        support, query = (replace(views, bounds=self.bounds) for views in (task.support, task.query))
        return replace(task, support=support, query=query)


@dataclass(frozen=True)
class FewerQueries(TaskWrapper):
    """Tasks with fewer query views, evenly chosen.

    Attributes:
        count: query views of every object; objects that have fewer keep all.
    """

    count: int

    def __post_init__(self) -> None:
        if self.count < 1:
            raise ValueError(f"query: expected at least 1 view, got {self.count}")

    def change(self, task: Task) -> Task:
        """The task with at most `count` query views."""
        return replace(task, query=task.query[_evenly(self.count, len(task.query))])


@dataclass(frozen=True)
class Shown(TaskWrapper):
    """Tasks of which some views are shown, those that stand farthest apart, and some query views are kept back.

    Attributes:
        count: views that are shown, support and query alike, at most all but those that are kept back.
        query: how many of the query views are kept back, evenly chosen.
    """

    count: int
    query: int

    def change(self, task: Task) -> Task:
        """The task with the views that are farthest apart, the first one first."""
        asked = _evenly(self.query, len(task.query))
        rest = [index for index in range(len(task.query)) if index not in asked.tolist()]
        views = join_views(task.support, task.query[rest])
        chosen = farthest_first(views.camera_directions, 0, min(self.count, len(views)))
        return replace(task, support=views[torch.tensor(chosen)], query=task.query[asked])


@dataclass(frozen=True)
class Inputs(TaskWrapper):
    """Tasks whose support views are those at given places in the order of their names, whose query views the others.

    Protocols that name their input views are followed with it: views 64, or 64 and 128, of SRN's 251.

    Attributes:
        places: of the support views, from 0.
    """

    places: tuple[int, ...]

    def change(self, task: Task) -> Task:
        """The task with these support views; ValueError where the object has no such view."""
        views = join_views(task.support, task.query)
        order = sorted(range(len(views)), key=lambda index: views.names[index]) if views.names else range(len(views))
        if not all(0 <= place < len(views) for place in self.places):
            raise ValueError(f"{task.name}: expected inputs from 0 to {len(views) - 1}, got {self.places}")
        inputs = [order[place] for place in self.places]
        rest = [index for index in order if index not in inputs]
        return replace(task, support=views[inputs], query=views[rest])


def _evenly(count: int, total: int) -> Tensor:
    """Indices of `count` of `total` views, evenly spaced; of all where there are fewer."""
    return torch.linspace(0, total - 1, min(count, total)).round().long()
