"""Data sets whose tasks have other support or query views, or a given scene sphere."""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, get_args

import torch
from torch import Tensor

from hyperplanes.data.wrapper import TaskWrapper
from hyperplanes.geometry.poses import farthest_first
from hyperplanes.geometry.rays import Sphere
from hyperplanes.utilities.files.order import natural_order
from hyperplanes.views import Task, join_views

__all__ = ["Choice", "FarthestSupport", "FewerQueries", "SingleView", "SupportByPosition", "WithBounds", "WithSupport"]

Choice = Literal["first", "farthest", "random"]


@dataclass(frozen=True)
class WithSupport(TaskWrapper):
    """Tasks with another number of support views.

    If an object has fewer support views, its first query views are added to them, as the paper does to have up to 50
    ImagePlanes. The added views also stay query views, so a method is then evaluated on views that it was given.

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
        if self.choose not in get_args(Choice):
            raise ValueError(f"choose: expected one of {', '.join(get_args(Choice))}, got {self.choose!r}")

    def change(self, task: Task) -> Task:
        """The task with `count` support views.

        Raises:
            ValueError: the object has fewer views in total, or fewer support views and these are to be chosen.
        """
        total = len(task.support) + len(task.query)
        if self.count > total:
            raise ValueError(
                f"{task.name}: expected {self.count} views for the support, got {total}; "
                f"--support {total} takes all of them"
            )
        more = self.count - len(task.support)
        if more > 0 and self.choose != "first":
            raise ValueError(
                f"{task.name}: expected at least {self.count} support views to choose from, got {len(task.support)}; "
                "choose fewer, or the first ones"
            )
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
class FarthestSupport(TaskWrapper):
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
        asked = _evenly(self.query, len(task.query))
        rest = [index for index in range(len(task.query)) if index not in asked.tolist()]
        views = join_views(task.support, task.query[rest])
        chosen = farthest_first(views.camera_directions, 0, min(self.count, len(views)))
        return replace(task, support=views[torch.tensor(chosen)], query=task.query[asked])


@dataclass(frozen=True)
class SupportByPosition(TaskWrapper):
    """Tasks whose support views have given positions in the order of view names; all other views are query views.

    Numbers in names are sorted as numbers, so that r_2 comes before r_10.

    It serves protocols that prescribe their input views, such as view 64, or 64 and 128, of SRN's 251.

    Attributes:
        places: positions of the support views, from 0.
    """

    places: tuple[int, ...]

    def __post_init__(self) -> None:
        if not self.places or min(self.places) < 0 or len(set(self.places)) < len(self.places):
            found = " ".join(map(str, self.places)) or "none"
            raise ValueError(f"inputs: expected different positions of views, from 0, got {found}")

    def change(self, task: Task) -> Task:
        """The task with these support views; raises ValueError if the object has no such view."""
        views = join_views(task.support, task.query)
        order: Sequence[int] = range(len(views))
        if views.names:
            order = sorted(order, key=lambda index: natural_order(views.names[index]))
        if max(self.places) >= len(views):
            found = " ".join(map(str, self.places))
            raise ValueError(f"{task.name}: expected inputs from 0 to {len(views) - 1}, got {found}; name other views")
        if len(self.places) == len(views):
            raise ValueError(
                f"{task.name}: expected fewer inputs than its {len(views)} views, got all of them; leave out some"
            )
        inputs = [order[place] for place in self.places]
        rest = [index for index in order if index not in inputs]
        return replace(task, support=views[inputs], query=views[rest])


def _evenly(count: int, total: int) -> Tensor:
    """Indices of `count` of `total` views, evenly spaced; of all where there are fewer."""
    return torch.linspace(0, total - 1, min(count, total)).round().long()
