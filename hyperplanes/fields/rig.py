"""The rig: camera directions of the support views in training, for fields with a fixed position for each plane."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from hyperplanes.geometry.poses import farthest_first
from hyperplanes.views import Views

__all__ = ["Rig", "match", "repeated_planes"]


@dataclass(frozen=True)
class Rig:
    """Camera directions of the planes, and which support view becomes which plane.

    Attributes:
        positions: unit vectors from the scene's centre to the cameras in training; zeros if not set yet.
        order: "matched" gives each plane the view nearest to its direction; "file" takes the views in order, repeated
            from the first if there are too few.
    """

    positions: Float[Tensor, "plane 3"]
    order: str = "matched"

    def __len__(self) -> int:
        return len(self.positions)

    @property
    def known(self) -> Float[Tensor, "plane 3"]:
        """The camera directions on the CPU, for matching.

        Raises:
            ValueError: they are not set yet.
        """
        positions = self.positions.float().cpu()
        if not positions.any():
            raise ValueError(
                "rig: expected the camera directions of the training views, got none; set_rig takes them from views"
            )
        return positions

    def places(self, support: Views) -> Int[Tensor, " plane"]:
        """The index of the view that becomes each plane."""
        if self.order == "file":
            chosen = torch.arange(len(self)) % len(support)
        else:
            chosen = match(self.known, support.camera_directions.cpu())
        return chosen.to(support.images.device)

    def repeated(self, support: Views) -> Int[Tensor, " repeated"]:
        """The planes whose view is also at a better fitting plane; these are to be masked."""
        places = self.places(support)
        near = torch.zeros(len(self))
        if self.order != "file":
            near = (self.known * support[places].camera_directions.cpu()).sum(1)
        return repeated_planes(places, near)

    def farthest(self, count: int) -> Int[Tensor, " k"]:
        """The indices of `count` planes that are as far apart as possible, including the first."""
        return torch.tensor(farthest_first(self.known, 0, count), dtype=torch.long, device=self.positions.device)


def match(rig: Float[Tensor, "plane 3"], standing: Float[Tensor, "view 3"]) -> Int[Tensor, " plane"]:
    """The view of each plane, assigned with the least total distance to the directions in training.

    With more views than planes, no view is used twice. With fewer, each is used at most as often as it takes to fill
    all planes, and one that is far from all of them may not be used.

    Args:
        rig: camera directions of the planes in training, on the CPU.
        standing: those of the views, on the CPU.
    """
    from scipy.optimize import linear_sum_assignment

    cost = (1 - rig @ standing.T).double().numpy()
    copies = -(-len(rig) // len(standing))  # of each view, so that there are enough for all planes
    _, column = linear_sum_assignment(np.tile(cost, (1, copies)))
    return torch.as_tensor(column % len(standing))


def repeated_planes(places: Int[Tensor, " plane"], near: Float[Tensor, " plane"]) -> Int[Tensor, " repeated"]:
    """The planes whose view is also at another plane: each view keeps its nearest plane, of equal ones the first.

    >>> repeated_planes(torch.tensor([0, 1, 0, 1]), torch.tensor([0.5, 1.0, 0.9, 1.0])).tolist()
    [0, 3]

    Args:
        places: the view of each plane.
        near: how near each plane's view is to the direction in training; larger is nearer.
    """
    kept = {int(places[plane]): plane for plane in near.argsort(descending=True, stable=True).flip(0).tolist()}
    return torch.tensor(sorted(set(range(len(places))) - set(kept.values())), dtype=torch.long)
