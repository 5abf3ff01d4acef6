"""Support and query views as one set: what the paper's figure of the number of ImagePlanes needs above 25."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch

from hyperplanes.geometry import cameras as camera
from hyperplanes.views import Task, Tasks, Views

__all__ = ["Unified", "join"]


@dataclass(frozen=True)
class Unified:
    """Tasks whose support views are joined by the first query views until there are enough for the planes.

    The query views stay as they are, so every number of planes is judged on the same views; some are planes.

    Attributes:
        data: where the tasks come from.
        planes: support views wanted.
    """

    data: Tasks
    planes: int

    def names(self, split: str) -> Sequence[str]:
        """The objects of a split."""
        return self.data.names(split)

    def task(self, name: str) -> Task:
        """One object; ValueError where all its views are too few."""
        task = self.data.task(name)
        more = self.planes - len(task.support)
        if more > len(task.query):
            raise ValueError(
                f"{name}: expected {self.planes} views to be planes, got {len(task.support) + len(task.query)}"
            )
        return task if more <= 0 else replace(task, support=join(task.support, task.query[:more]))


def join(first: Views, second: Views) -> Views:
    """Views of one scene and image size, one after the other."""
    masks = None
    if first.masks is not None and second.masks is not None:
        masks = torch.cat([first.masks, second.masks])
    return replace(
        first,
        images=torch.cat([first.images, second.images]),
        cameras=camera.concatenate([first.cameras, second.cameras]),
        masks=masks,
        names=(*first.names, *second.names) if first.names and second.names else (),
    )
