"""Data sets whose tasks have other support views, or a given scene sphere."""

from __future__ import annotations

import zlib
from dataclasses import dataclass, replace

import torch

from hyperplanes.data.wrapper import TaskWrapper
from hyperplanes.geometry.poses import farthest_first
from hyperplanes.geometry.rays import Sphere
from hyperplanes.views import Task, join_views

__all__ = ["Inputs", "Shown", "SingleView", "WithBounds", "WithSupport"]


@dataclass(frozen=True)
class WithSupport(TaskWrapper):
    """Tasks with another number of support views.

    If an object has fewer support views, its first query views are added to them, as the paper does to have up to 50
    ImagePlanes. The added views also stay query views, so a method is then evaluated on views that it was given.

    Attributes:
        count: support views of every object.
    """

    count: int

    def __post_init__(self) -> None:
        if self.count < 1:
            raise ValueError(f"support: expected at least 1 view, got {self.count}")

    def change(self, task: Task) -> Task:
        """The task with `count` support views; raises ValueError if the object has fewer views in total."""
        total = len(task.support) + len(task.query)
        if self.count > total:
            raise ValueError(
                f"{task.name}: expected {self.count} views for the support, got {total}; "
                f"--support {total} takes all of them"
            )
        more = self.count - len(task.support)
        support = task.support[: self.count] if more <= 0 else join_views(task.support, task.query[:more])
        return replace(task, support=support)


@dataclass(frozen=True)
class SingleView(TaskWrapper):
    """Tasks with one support view, always the same one for an object."""

    def change(self, task: Task) -> Task:
        """The task with one of its support views, chosen by a checksum of the object's name."""
        chosen = zlib.crc32(task.name.encode()) % len(task.support)
        return replace(task, support=task.support[[chosen]])


@dataclass(frozen=True)
class WithBounds(TaskWrapper):
    """Tasks with a given scene sphere, in place of the one that files state or masks give.

    Attributes:
        bounds: the sphere. Rays with constant near and far begin and end at the distance of its centre minus and plus
            its radius.
    """

    bounds: Sphere

    def change(self, task: Task) -> Task:
        """The task with that sphere."""
        support, query = (replace(views, bounds=self.bounds) for views in (task.support, task.query))
        return replace(task, support=support, query=query)


@dataclass(frozen=True)
class Shown(TaskWrapper):
    """Tasks whose support views are those farthest apart, and whose query views are some of the original ones.

    Attributes:
        count: number of support views. They are chosen from all original support and query views except the new query
            views; if there are fewer, all are taken.
        query: number of query views, evenly spaced among the original ones.
    """

    count: int
    query: int

    def change(self, task: Task) -> Task:
        """The task with the views that are farthest apart as support, beginning with the first view."""
        asked = torch.linspace(0, len(task.query) - 1, min(self.query, len(task.query))).round().long()
        rest = [index for index in range(len(task.query)) if index not in asked.tolist()]
        views = join_views(task.support, task.query[rest])
        chosen = farthest_first(views.camera_directions, 0, min(self.count, len(views)))
        return replace(task, support=views[torch.tensor(chosen)], query=task.query[asked])


@dataclass(frozen=True)
class Inputs(TaskWrapper):
    """Tasks whose support views have given positions in the order of view names; query views are taken from the others.

    It serves protocols that prescribe their input views, such as view 64, or 64 and 128, of SRN's 251.

    Attributes:
        places: positions of the support views, from 0.
        query: number of query views, evenly spaced among the others; None takes all.
    """

    places: tuple[int, ...]
    query: int | None = None

    def change(self, task: Task) -> Task:
        """The task with these support views; raises ValueError if the object has no such view."""
        views = join_views(task.support, task.query)
        order = sorted(range(len(views)), key=lambda index: views.names[index]) if views.names else range(len(views))
        if not all(0 <= place < len(views) for place in self.places):
            raise ValueError(f"{task.name}: expected inputs from 0 to {len(views) - 1}, got {self.places}")
        inputs = [order[place] for place in self.places]
        rest = [index for index in order if index not in inputs]
        asked = torch.linspace(0, len(rest) - 1, min(self.query or len(rest), len(rest))).round().long()
        return replace(task, support=views[inputs], query=views[[rest[index] for index in asked]])
