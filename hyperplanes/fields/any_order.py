"""A field that takes any number of views of any rig in any order, as in image-based rendering.

What the trunk reads of a point is that of the few views that see it best, sorted by how well they do: neither their
number nor their order is built into its weights. The colour is a blend of what the views closest to the direction show
(Buehler et al. 2001, "Unstructured Lumigraph Rendering"; Wang et al. 2021, "IBRNet"), which the network shifts.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn
from torch.nn.functional import pad, relu, softplus

from hyperplanes.fields.base import Field, Target, TargetConfig
from hyperplanes.fields.encoding import encode, encoded_size
from hyperplanes.geometry.occupancy import Occupancy
from hyperplanes.geometry.rays import Sphere
from hyperplanes.geometry.visibility import Visibility, VisibilityPlanes
from hyperplanes.parameters import Parameters
from hyperplanes.views import Views

__all__ = ["AnyOrderField", "AnyOrderNeRF"]

UNSEEN = 8.0  # penalty of a view that does not show the point
PARTLY = 2.0  # penalty where the mask is not whole, so that background is mixed into the colour
WHOLE = 0.98  # opacity of a mask from which on it counts as whole
ANGLE = 10.0  # radians of angle to the ray that a penalty of 1 counts for
SMALLEST_ANGLE = 1e-2
FALLOFF = 8.0  # of depths behind the hull, in 1 / radii, where tanh makes them inputs
EMPTY = -4.0  # what the density head begins with outside the masks, before softplus
SOLID = 4.0  # and within them

READ = 9  # numbers that the trunk reads of a view: colour, depth, coverage, validity, direction
BLENDED = 7  # numbers that the colour head reads of a view: colour, angle, depth, coverage, validity
OVERALL = 11  # mean, variance and difference to the best of the colours, least coverage, number of views


class AnyOrderNeRF(Target):
    """F(x, z, d; theta) = (c, sigma), where z is sorted by visibility.

    With its first weights it is nearly the visual hull in the blended colours of the views that see it; what is learned
    is the difference to that.
    """

    any_order: ClassVar[bool] = True

    def __init__(self, config: TargetConfig) -> None:
        super().__init__(config)
        width, blended = config.width, config.blended
        self.density = nn.Linear(width + 1, 1)
        self.view = nn.Linear(width + encoded_size(config.direction_octaves) + BLENDED * blended, width // 2)
        self.colour = nn.Linear(width // 2, blended + 3)
        with torch.no_grad():
            for layer in (self.density, self.view, self.colour):
                nn.init.kaiming_uniform_(layer.weight, nonlinearity="relu")
                nn.init.zeros_(layer.bias)
            self.density.weight *= 0.1
            self.density.weight[0, width] = SOLID - EMPTY
            self.density.bias.fill_(EMPTY)
            self.colour.weight *= 0.1

    @property
    def input_size(self) -> int:
        """The encoded point, what the best views show, and what all of them have in common."""
        return encoded_size(self.config.point_octaves) + READ * self.config.planes + OVERALL

    def planes_of(self, views: Views, occupancy: Occupancy) -> VisibilityPlanes:
        """The views with their masks and the depth of the hull."""
        return VisibilityPlanes(views.images, views.cameras, views.masks, occupancy)

    def bind(self, parameters: Parameters, planes: VisibilityPlanes | None, bounds: Sphere | None = None) -> Field:
        """The field that these parameters and planes make.

        Args:
            parameters: theta or theta + delta.
            planes: of `planes_of`, any number.
            bounds: the sphere of the scene, which the network sees as the unit sphere.

        Returns:
            A callable (points, directions) -> (colour, density).

        Raises:
            ValueError: no planes.
        """
        if planes is None or not len(planes):
            raise ValueError(f"planes: expected VisibilityPlanes of at least one view, got {planes and len(planes)}")
        return AnyOrderField(self, parameters, planes, bounds or planes.occupancy.bounds)


@dataclass(frozen=True)
class _Point:
    """What the heads read: the trunk's output, the least coverage over the views, and the views themselves."""

    hidden: Float[Tensor, "point width"]
    coverage: Float[Tensor, " point"]
    visibility: Visibility
    penalty: Float[Tensor, "point view"]


@dataclass(frozen=True)
class AnyOrderField(Field):
    """The field of `AnyOrderNeRF`."""

    def __call__(
        self, points: Float[Tensor, "point 3"], directions: Float[Tensor, "point 3"]
    ) -> tuple[Float[Tensor, "point 3"], Float[Tensor, " point"]]:
        """Colour in [0, 1] and density per world unit at points seen along unit directions."""
        here = self._read(points)
        return self._colour(here, points, directions), self._density(here)

    def density(self, points: Float[Tensor, "point 3"]) -> Float[Tensor, " point"]:
        """Density per world unit alone."""
        return self._density(self._read(points))

    def _read(self, points: Tensor) -> _Point:
        """The trunk at points: it reads the `config.planes` views of the least penalty, the best one first."""
        config, planes = self.target.config, self.planes
        visibility = planes.visibility(points)
        hidden = (visibility.behind - planes.tolerance).clamp(0, 2)
        penalty = torch.where(visibility.valid, hidden + PARTLY * (visibility.coverage < WHOLE), UNSEEN)
        least, index = penalty.topk(min(config.planes, len(planes)), 1, largest=False)
        seen, colours = _chosen(visibility, index), planes.colours.lookup(points, index).colours
        colours = (2 * colours - 1) * seen.valid[..., None]
        slots = torch.cat([colours, _described(seen), seen.directions * seen.valid[..., None]], -1)

        weights = torch.exp(-ANGLE * least) * seen.valid
        weights = (weights / weights.sum(1, keepdim=True).clamp_min(1e-6))[..., None]
        mean = (weights * colours).sum(1)
        variance = (weights * (colours - mean[:, None]).square()).sum(1)
        coverage = torch.where(visibility.valid, visibility.coverage, 1.0).amin(1)
        number = visibility.valid.sum(1, keepdim=True).clamp_min(1).log()
        overall = torch.cat([mean, variance, colours[:, 0] - mean, coverage[:, None], number], 1)

        here = encode(self.bounds.normalise(points), config.point_octaves)
        inputs = torch.cat([here, _padded(slots, config.planes).flatten(1), overall], 1)
        return _Point(self.trunk(inputs), coverage, visibility, penalty)

    def _density(self, here: _Point) -> Float[Tensor, " point"]:
        raw = self.layer("density", torch.cat([here.hidden, here.coverage[:, None]], 1))[:, 0]
        return softplus(raw) * (self.target.config.density_scale / self.bounds.radius)

    def _colour(self, here: _Point, points: Tensor, directions: Tensor) -> Float[Tensor, "point 3"]:
        """A blend of the colours of the views nearest to the direction that see the point, and a shift of it.

        As in the unstructured lumigraph a view at angle a has the weight 1 / a - 1 / a_max, a_max being the angle of
        the next view; the network multiplies these weights and shifts the logit of the result.
        """
        config, visibility, total = self.target.config, here.visibility, len(self.planes)
        count = min(config.blended, total)
        angle = torch.acos((visibility.directions * directions[:, None]).sum(-1).clamp(-1 + 1e-6, 1 - 1e-6))
        nearest, index = (angle + ANGLE * here.penalty).topk(min(count + 1, total), 1, largest=False)
        limit = nearest[:, -1:] if total > count else 2 * nearest[:, -1:]
        nearest, index = nearest[:, :count].clamp_min(SMALLEST_ANGLE), index[:, :count]
        weights = (1 / nearest - 1 / limit.clamp_min(1.01 * SMALLEST_ANGLE)).clamp_min(1e-6)
        seen, colours = _chosen(visibility, index), self.planes.colours.lookup(points, index).colours

        angles = (angle.gather(1, index) * seen.valid)[..., None]
        slots = torch.cat([(2 * colours - 1) * seen.valid[..., None], angles, _described(seen)], -1)
        along = encode(directions, config.direction_octaves)
        value = torch.cat([self.layer("feature", here.hidden), along, _padded(slots, config.blended).flatten(1)], 1)
        factors, shift = self.layer("colour", relu(self.layer("view", value))).split([config.blended, 3], 1)
        weights = torch.softmax(weights.log() + factors[:, :count], 1)
        blend = (weights[..., None] * colours).sum(1)
        return torch.sigmoid(torch.logit(blend, 0.005) + shift)


def _chosen(visibility: Visibility, index: Int[Tensor, "point chosen"]) -> Visibility:
    """The chosen views of each point."""
    return Visibility(
        visibility.directions.gather(1, index[..., None].expand(-1, -1, 3)),
        visibility.behind.gather(1, index),
        visibility.coverage.gather(1, index),
        visibility.valid.gather(1, index),
    )


def _described(seen: Visibility) -> Float[Tensor, "point view 3"]:
    """Depth behind the hull, coverage and validity as inputs, zero where a view is not valid."""
    valid: Bool[Tensor, "point view"] = seen.valid
    return torch.stack([torch.tanh(FALLOFF * seen.behind) * valid, seen.coverage * valid, valid.to(seen.behind)], -1)


def _padded(slots: Float[Tensor, "point view number"], count: int) -> Float[Tensor, "point count number"]:
    """Zeros for the views that are missing."""
    return slots if slots.shape[1] == count else pad(slots, (0, 0, 0, count - slots.shape[1]))
