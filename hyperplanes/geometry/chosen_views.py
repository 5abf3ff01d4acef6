"""Which views see points, and how well: parameters and results of `visibility.VisibilityPlanes`."""

from __future__ import annotations

from dataclasses import dataclass, fields

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

__all__ = [
    "BORDER_MARGIN",
    "BORDER_PENALTY",
    "BORDER_POLE",
    "INVISIBLE_PENALTY",
    "MAX_DEPTH_PENALTY",
    "OCTAVES",
    "OPAQUE_MASK",
    "PARTIAL_MASK_PENALTY",
    "PENALTY_RADIANS",
    "SMALLEST_ANGLE",
    "WEIGHT_FALLOFF",
    "ChosenViews",
    "Described",
    "Penalties",
    "Reading",
    "Visibility",
]

MAX_DEPTH_PENALTY = 2.0  # largest penalty of depth behind the surface, in radii
PARTIAL_MASK_PENALTY = 2.0  # penalty of a mask that is not opaque
OPAQUE_MASK = 0.98  # opacity from which on a mask counts as opaque
INVISIBLE_PENALTY = 8.0  # penalty of a view that does not show the point: more than all others together
BORDER_MARGIN = 0.15  # of the shorter side of a picture, along a border that crops the object
BORDER_PENALTY = 0.03  # penalty in the middle of the margin; 3 at the border
BORDER_POLE = 1.01  # widths of the margin from its inner edge to where the penalty would be infinite
WEIGHT_FALLOFF = 10.0  # rate at which the weights of views fall with their penalty
PENALTY_RADIANS = 10.0  # radians of angle that a penalty of 1 is worth
OCTAVES = 8  # of an encoding from one computed sine to the next; the others follow by doubling the angle
SMALLEST_ANGLE = 1e-2  # between a view and a direction, in radians; smaller ones are clamped to it


@dataclass(frozen=True)
class Penalties:
    """What it costs a view not to see a point well; a cost of 1 is worth PENALTY_RADIANS radians of angle.

    Attributes:
        deepest: largest cost of depth behind the first surface.
        partly: cost of a mask that is not opaque.
        steep: cost of each radius behind the surface.
        highest: largest cost of both together.
        least: lowest cost, of points in front of the surface.
    """

    deepest: float = MAX_DEPTH_PENALTY
    partly: float = PARTIAL_MASK_PENALTY
    steep: float = 1.0
    highest: float = MAX_DEPTH_PENALTY + PARTIAL_MASK_PENALTY
    least: float = -MAX_DEPTH_PENALTY

    @classmethod
    def binary(cls) -> Penalties:
        """Visibility is binary: whatever hides a point costs 1; penalty offsets and margins are added."""
        return cls(deepest=1e3, partly=1e6, steep=1e6, highest=1.0, least=0.0)


@dataclass(frozen=True)
class ChosenViews:
    """Some views of each point, best first.

    Attributes:
        views: their indices.
        directions: unit vectors from each camera's centre to the point, in the world.
        behind: how far the point lies behind the first surface of the hull along the ray of each camera, in radii of
            the scene; negative in front of it.
        coverage: opacity of the mask where the point falls.
        penalty: how badly the view sees the point; INVISIBLE_PENALTY where it does not show it at all.
    """

    views: Int[Tensor, "point chosen"]
    directions: Float[Tensor, "point chosen 3"]
    behind: Float[Tensor, "point chosen"]
    coverage: Float[Tensor, "point chosen"]
    penalty: Float[Tensor, "point chosen"]

    @property
    def valid(self) -> Bool[Tensor, "point chosen"]:
        """Whether each view shows the point: it falls into the image, and the view is not masked."""
        return self.penalty < INVISIBLE_PENALTY

    @property
    def weights(self) -> Float[Tensor, "point chosen"]:
        """Weights that fall with the penalty and sum to one; all zero where no view shows the point."""
        weights = torch.exp(-WEIGHT_FALLOFF * self.penalty.clamp_min(0)) * self.valid
        return weights / weights.sum(1, keepdim=True).clamp_min(1e-6)

    def first(self, count: int) -> ChosenViews:
        """The first views.

        Args:
            count: how many; all where there are fewer.
        """
        return ChosenViews(*(getattr(self, each.name)[:, :count] for each in fields(self)))

    def angles(self, directions: Float[Tensor, "point 3"]) -> Float[Tensor, "point chosen"]:
        """Angles between a direction at each point and the ray of each view, in radians."""
        return torch.acos((self.directions * directions[:, None]).sum(-1).clamp(-1 + 1e-6, 1 - 1e-6))

    def lumigraph_weights(self, angles: Float[Tensor, "point chosen"], count: int) -> Float[Tensor, "point blended"]:
        """Weights of the first views in a blend of their colours; not normalised.

        A view at angle a has the weight 1 / a - 1 / a_max, a_max being the angle of the next view, so that the blend
        changes continuously with the direction (Buehler et al. 2001, "Unstructured Lumigraph Rendering"). A view that
        does not see the point counts as one at a greater angle.

        Args:
            angles: as `angles` returns them.
            count: how many views are blended.
        """
        score = (angles + PENALTY_RADIANS * self.penalty.clamp_min(0)).clamp_min(SMALLEST_ANGLE)
        farthest = score[:, count : count + 1] if score.shape[1] > count else 2 * score[:, -1:]
        return (1 / score[:, :count] - 1 / (1.01 * farthest)).clamp_min(1e-6)


@dataclass(frozen=True)
class Visibility:
    """How the planes see points.

    Attributes:
        best: the views that see each point best.
        nearest: the views nearest to the direction that see the point, one more than asked for where there are enough.
        coverage: the least opacity over the views that show the point; 1 where none does.
        number: number of views that show the point.
    """

    best: ChosenViews
    nearest: ChosenViews | None
    coverage: Float[Tensor, " point"]
    number: Float[Tensor, " point"]


@dataclass(frozen=True)
class Reading:
    """How many views a network reads, and how they are encoded.

    Attributes:
        best: number of views of least penalty, or 0.
        nearest: number of views nearest to a direction.
        point_frequencies: frequencies of the encoded point.
        direction_frequencies: frequencies of the encoded direction.
        falloff: factor of depths behind the hull in the tanh that makes them inputs, in 1 / radii.
    """

    best: int
    nearest: int
    point_frequencies: int
    direction_frequencies: int
    falloff: float

    @property
    def row_size(self) -> int:
        """Length of a row: the encoded point, nine numbers for each of the best views, eleven for all of them."""
        return 3 + 6 * self.point_frequencies + 9 * self.best + 11

    @property
    def near_size(self) -> int:
        """Length of a near row: the encoded direction, and seven numbers for each of the nearest views."""
        return 3 + 6 * self.direction_frequencies + 7 * self.nearest


@dataclass(frozen=True)
class Described:
    """What a network reads of each point, as rows.

    Attributes:
        rows: the encoded point; colour in [-1, 1], depth behind the hull, coverage, validity and direction of each of
            the best views; mean, variance and difference to the best of their colours, least coverage, logarithm of the
            number of views; features of a grid.
        coverage: the least opacity over the views that show the point.
        near_rows: the encoded direction; colour, angle, depth, coverage and validity of each of the nearest views.
        near_weights: logarithms of the blending weights (`fields.image_based`).
        near_colours: in [0, 1], white where a view does not show the point.
    """

    rows: Float[Tensor, "point number"]
    coverage: Float[Tensor, " covered"]
    near_rows: Float[Tensor, "point near_number"]
    near_weights: Float[Tensor, "seen near"]
    near_colours: Float[Tensor, "seen near 3"]
