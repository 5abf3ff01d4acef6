"""Which support view stands at which plane, for fields that know planes by their places."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from hyperplanes.geometry import cameras as camera
from hyperplanes.views import Views

__all__ = ["match", "standpoints", "superfluous"]


def standpoints(views: Views) -> Float[Tensor, "view 3"]:
    """Unit vectors from the scene's centre to the cameras.

    Args:
        views: of one scene.
    """
    return camera.standpoints(views.cameras, views.bounds.centre).float()


def match(rig: Float[Tensor, "plane 3"], standing: Float[Tensor, "view 3"]) -> Int[Tensor, " plane"]:
    """The view of each plane: together as near as can be to where the views of the training stood.

    More views than planes: none stands at two. Fewer: some stand at several, as evenly as their numbers allow.

    Args:
        rig: standpoints of the planes in training, on the CPU.
        standing: those of the views, on the CPU.
    """
    from scipy.optimize import linear_sum_assignment

    cost = (1 - rig @ standing.T).double().numpy()
    _, column = linear_sum_assignment(np.tile(cost, (1, -(-len(rig) // len(standing)))))
    return torch.as_tensor(column % len(standing))


def superfluous(places: Int[Tensor, " plane"], near: Float[Tensor, " plane"]) -> Int[Tensor, " hidden"]:
    """The planes whose view stands at another one too: each view keeps its nearest plane, of equal ones the first.

    >>> superfluous(torch.tensor([0, 1, 0, 1]), torch.tensor([0.5, 1.0, 0.9, 1.0])).tolist()
    [0, 3]

    Args:
        places: the view of each plane.
        near: how near each plane's view stands to where that of the training stood.
    """
    kept = {int(places[plane]): plane for plane in near.argsort(descending=True, stable=True).flip(0).tolist()}
    return torch.tensor(sorted(set(range(len(places))) - set(kept.values())), dtype=torch.long)
