"""A field that takes any number of views of any rig in any order, as in image-based rendering.

What the trunk reads of a point is that of the few views that see it best, sorted by how well they do: neither their
number nor their order is built into its weights. The colour is a blend of what the views closest to the direction show
(Buehler et al. 2001, "Unstructured Lumigraph Rendering"; Wang et al. 2021, "IBRNet"), which the network shifts.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Annotated, ClassVar

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn.functional import pad, relu, softplus

from hyperplanes.fields.base import Field, Target, TargetConfig
from hyperplanes.fields.encoding import encode, encoded_size
from hyperplanes.fields.rig import Rig
from hyperplanes.geometry.chosen_views import ChosenViews, Described, Reading, Visibility
from hyperplanes.geometry.occupancy import Occupancy
from hyperplanes.geometry.poses import outermost_first
from hyperplanes.geometry.rays import Sphere
from hyperplanes.geometry.visibility import VisibilityPlanes
from hyperplanes.geometry.volume import CHANNELS, SIDE, interpolate_grid, resampled_grid, volume_of
from hyperplanes.parameters import Parameters
from hyperplanes.utilities.arguments import checked_fields
from hyperplanes.utilities.kept import kept
from hyperplanes.utilities.transforms import wants_values_alone
from hyperplanes.views import Views

__all__ = ["ImageBasedConfig", "ImageBasedField", "ImageBasedNeRF", "FeatureGrid"]

FALLOFF = 8.0  # of depths behind the hull, in 1 / radii, where tanh makes them inputs
VOXELS_PER_PIXEL = 3 / 4  # of a side of the pictures: 96 voxels for 128 pixels, as the preset "small" is trained
FINEST_HULL = 192
EMPTY = -4.0  # what the density head begins with outside the masks, before softplus
SOLID = 4.0  # and within them

GRID_RATES = {"learning_rate": 2e-2, "muon_learning_rate": 0.05}
"""Of fine-tuning the weights of a field with a grid of features, trained or random; docs/small-training.md."""


READ = 9  # numbers that the trunk reads of a view: colour, depth, coverage, validity, direction
BLENDED = 7  # numbers that the colour head reads of a view: colour, angle, depth, coverage, validity
OVERALL = 11  # mean, variance and difference to the best of the colours, least coverage, number of views


class FeatureGrid(nn.Module):
    """Features of the cells of a grid over the scene, as one more layer of weights; zero at first.

    Hybrids of a grid and an MLP learn a scene in fewer steps than an MLP alone (Sun et al. 2022, "Direct Voxel Grid
    Optimization"; Mueller et al. 2022, "Instant Neural Graphics Primitives").

    Args:
        channels: features of a cell.
        cells: an axis.
    """

    def __init__(self, channels: int, cells: int) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.zeros(channels, cells, cells, cells))


@checked_fields
@dataclass(frozen=True)
class ImageBasedConfig(TargetConfig):
    """The shape of a field of any number of views.

    Attributes:
        blended: views whose colours are blended.
        grid: features of the cells of a grid over the scene that are read beside the views; 0 is no grid.
        cells: of this grid, an axis.
    """

    blended: Annotated[int, range(1, 65)] = 4
    grid: Annotated[int, range(65)] = 0
    cells: Annotated[int, range(1, 257)] = SIDE


class ImageBasedNeRF(Target):
    """F(x, z, d; theta) = (c, sigma), where z is sorted by visibility.

    With its first weights it is nearly the visual hull in the blended colours of the views that see it; what is learned
    is the difference to that. With `grid` channels the trunk also reads features that are interpolated in a grid over
    the scene, the first of them through a sigmoid: weights like all others, which a hypernetwork updates.
    """

    config_type: ClassVar[type[TargetConfig]] = ImageBasedConfig
    permutation_invariant: ClassVar[bool] = True
    config: ImageBasedConfig
    volume_size: ClassVar[tuple[int, int] | None] = (CHANNELS, SIDE)

    def __init__(self, config: ImageBasedConfig) -> None:
        super().__init__(config)
        width, blended = config.width, config.blended
        if config.grid:
            self.grid = FeatureGrid(config.grid, config.cells)
        self.density = nn.Linear(width + 1, 1)
        self.view = nn.Linear(width + encoded_size(config.direction_frequencies) + BLENDED * blended, width // 2)
        self.colour = nn.Linear(width // 2, blended + 3)
        # heads that begin with the visual hull: density follows the masks, colours are the plain blend
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
        config = self.config
        return encoded_size(config.point_frequencies) + READ * config.planes + OVERALL + config.grid

    @property
    def fine_tuning_rates(self) -> Mapping[str, float]:
        """Those of a grid of features."""
        return GRID_RATES if self.config.grid else {}

    def arrange(self, support: Views, rig: Rig) -> Views:
        """The views as they come."""
        return support

    def choose_hyperplanes(self, views: Views, rig: Rig, count: int, choice: str) -> Int[Tensor, " k"]:
        """At most so many of the views: the first, or from the one that stands farthest from their mean onwards."""
        count, device = min(count, len(views)), views.images.device
        if choice == "first":
            return torch.arange(count, device=device)
        return torch.tensor(outermost_first(views.camera_directions.cpu(), count), dtype=torch.long, device=device)

    def hull_resolution(self, configured: int, support: Views) -> int:
        """More than configured where masks are larger, so that the hull is as fine as they are."""
        if support.masks is None:
            return configured
        return max(configured, min(FINEST_HULL, round(VOXELS_PER_PIXEL * max(support.size))))

    def planes_of(self, views: Views, occupancy: Occupancy) -> VisibilityPlanes:
        """The views with their masks and the depth of the hull."""
        return VisibilityPlanes(views.images, views.cameras, views.masks, occupancy)

    def volume_of(self, planes: VisibilityPlanes) -> Float[Tensor, "channel x y z"]:
        """What the views show of the cells of the grid."""
        return volume_of(planes)

    def with_surface(self, planes: VisibilityPlanes, voxels: Occupancy) -> VisibilityPlanes:
        """The planes, whose colours come from those that see the surface of these voxels, and no longer the hull's."""
        return planes.with_surface(voxels)

    def finer(self, parameters: Parameters, cells: int) -> Parameters:
        """The grid of features interpolated to more cells, where it has fewer, which smooths it."""
        grid = parameters.get("grid.weight")
        if grid is None or grid.shape[-1] >= cells:
            return parameters
        return Parameters({**parameters, "grid.weight": resampled_grid(grid, cells)})

    def config_of(self, parameters: Parameters) -> ImageBasedConfig:
        """This one, with the cells of the grid."""
        grid = parameters.get("grid.weight")
        return self.config if grid is None else replace(self.config, cells=grid.shape[-1])

    def bind(
        self, parameters: Parameters, planes: VisibilityPlanes | None, bounds: Sphere | None = None
    ) -> ImageBasedField:
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
        return ImageBasedField(self, parameters, planes, bounds or planes.occupancy.bounds)


@dataclass(frozen=True)
class HiddenPoints:
    """What the heads read of points.

    Attributes:
        points: in the world.
        values: of the trunk.
        coverage: the least opacity over the views that show the point.
    """

    points: Float[Tensor, "point 3"]
    values: Float[Tensor, "point width"]
    coverage: Float[Tensor, " point"]

    def __getitem__(self, index: slice | Tensor) -> HiddenPoints:
        return HiddenPoints(*(each[index] for each in (self.points, self.values, self.coverage)))


@dataclass(frozen=True, repr=False)
class ImageBasedField(Field):
    """The field of `ImageBasedNeRF`."""

    target: ImageBasedNeRF

    def __call__(
        self, points: Float[Tensor, "point 3"], directions: Float[Tensor, "point 3"]
    ) -> tuple[Float[Tensor, "point 3"], Float[Tensor, " point"]]:
        """Colour in [0, 1] and density per world unit at points seen along unit directions."""
        if self._is_described(points, directions):
            # one kernel: the best views of each point (point, input), the nearest ones (point, blended, ...)
            inputs, coverage, near = self._read(points, directions)
            hidden = self.trunk(inputs)
            return self._coloured(hidden, near), self._density(hidden, coverage)
        # the same in PyTorch: which views see a point best, which stand nearest to the direction
        config = self.target.config
        visibility = self.planes.choose(points, directions, best=config.planes, nearest=config.blended)
        colours = self.planes.colours.lookup(points).colours  # (point, view, 3)
        hidden = self._hidden(points, visibility, colours)
        return self._colour(hidden, visibility, colours, directions), self._density(hidden, visibility.coverage)

    def density(self, points: Float[Tensor, "point 3"]) -> Float[Tensor, " point"]:
        """Density per world unit alone."""
        return self.density_of(self.hidden(points))

    def hidden(self, points: Float[Tensor, "point 3"]) -> HiddenPoints:
        """What the heads read; all that is expensive about a point."""
        if self._is_described(points):
            inputs, coverage, _ = self._read(points)
            return HiddenPoints(points, self.trunk(inputs), coverage)
        visibility = self.planes.choose(points, best=self.target.config.planes)
        hidden = self._hidden(points, visibility, self.planes.colours.lookup(points).colours)
        return HiddenPoints(points, hidden, visibility.coverage)

    def density_of(self, hidden: HiddenPoints) -> Float[Tensor, " point"]:
        """Density per world unit."""
        return self._density(hidden.values, hidden.coverage)

    def colour_of(self, hidden: HiddenPoints, directions: Float[Tensor, "point 3"]) -> Float[Tensor, "point 3"]:
        """Colour in [0, 1] as seen along unit directions."""
        points, config = hidden.points, self.target.config
        if self._is_described(points, directions):
            near = self.planes.describe(points, directions, replace(self._reading, best=0), self.bounds)
            return self._coloured(hidden.values, near)
        visibility = self.planes.choose(points, directions, best=0, nearest=config.blended)
        return self._colour(hidden.values, visibility, self.planes.colours.lookup(points).colours, directions)

    @property
    def _reading(self) -> Reading:
        config = self.target.config
        return Reading(config.planes, config.blended, config.point_frequencies, config.direction_frequencies, FALLOFF)

    def _is_described(self, points: Tensor, directions: Tensor | None = None) -> bool:
        """Whether one kernel writes what the network reads; not of fields that read something else."""
        plain = type(self) is ImageBasedField and self.dtype == torch.float32 == points.dtype
        return plain and isinstance(self.planes, VisibilityPlanes) and self.planes.can_describe(points, directions)

    def _read(self, points: Tensor, directions: Tensor | None = None) -> tuple[Tensor, Tensor, Described]:
        """The inputs of the trunk, the least coverage, and what the colour head reads where there are directions."""
        grid = self.parameters.get("grid.weight")
        learned = grid is not None and not wants_values_alone(grid)
        found = self.planes.describe(points, directions, self._reading, self.bounds, None if learned else self._cells)
        if not learned:
            return found.rows, found.coverage, found
        return torch.cat([found.rows, *self._features(points)], 1), found.coverage, found

    @property
    def _cells(self) -> Float[Tensor, "channel x y z"] | None:
        """The grid, with the numbers of a cell side by side in memory: copied once, and anew where it has changed."""
        grid = self.parameters.get("grid.weight")
        if grid is None:
            return None
        return kept(self, "cells", [grid], lambda: grid.detach().permute(1, 2, 3, 0).contiguous().permute(3, 0, 1, 2))

    def _features(self, points: Tensor) -> list[Float[Tensor, "point number"]]:
        """Those of the grid, the first through a sigmoid."""
        if not self.target.config.grid:
            return []
        features = interpolate_grid(self.parameters["grid.weight"], points, self.bounds)
        return [torch.sigmoid(features[:, :1]), features[:, 1:]]

    def _coloured(self, hidden: Tensor, near: Described) -> Float[Tensor, "point 3"]:
        """As `_colour`, of what the kernel wrote."""
        return self._blend(self.viewed(hidden, near.near_rows), near.near_weights, near.near_colours)

    def _hidden(self, points: Tensor, visibility: Visibility, shown: Tensor) -> Float[Tensor, "point width"]:
        """The trunk at points, which reads the `config.planes` views that see them best; `shown` are all colours."""
        config, seen = self.target.config, visibility.best
        # what each of the best views shows, from [0, 1] to [-1, 1]: (point, chosen, 3), then (point, chosen, READ)
        colours = (2 * _of(shown, seen.views) - 1) * seen.valid[..., None]
        slots = torch.cat([colours, _described(seen), seen.directions * seen.valid[..., None]], -1)

        # what they have in common: mean, variance, difference to the best, least coverage, number of views
        weights = seen.weights[..., None]
        mean = (weights * colours).sum(1)
        variance = (weights * (colours - mean[:, None]).square()).sum(1)
        number = visibility.number.clamp_min(1).log()
        overall = [mean, variance, colours[:, 0] - mean, torch.stack([visibility.coverage, number], 1)]

        # the encoded point, the views one after the other, what they have in common, the grid
        inputs = [encode(self.bounds.normalise(points), config.point_frequencies)]
        inputs += [_padded(slots, config.planes).flatten(1), *overall, *self._features(points)]
        return self.trunk(torch.cat(inputs, 1))

    def _density(self, hidden: Tensor, coverage: Tensor) -> Float[Tensor, " point"]:
        weight, bias = self.parameters["density.weight"][0], self.parameters["density.bias"]
        # of both side by side, without putting them there
        raw = torch.addmv(torch.addcmul(bias, coverage, weight[-1]), hidden, weight[:-1])
        return softplus(raw) * (self.target.config.density_scale / self.bounds.radius)

    def _colour(
        self, hidden: Tensor, visibility: Visibility, shown: Tensor, directions: Tensor
    ) -> Float[Tensor, "point 3"]:
        """A blend of the colours of the views nearest to the direction that see the point, and a shift of it.

        The network multiplies the weights of the unstructured lumigraph (`ChosenViews.lumigraph_weights`), and shifts
        the logit of the result.
        """
        config, near = self.target.config, visibility.nearest
        assert near is not None
        count, angles = min(config.blended, len(self.planes)), near.angles(directions)
        weights = near.lumigraph_weights(angles, count)
        seen = near.first(count)
        colours, valid = _of(shown, seen.views), seen.valid[..., None]  # (point, blended, 3), (point, blended, 1)

        # what the head reads: the trunk's features, the encoded direction, what each of these views shows
        slots = torch.cat([(2 * colours - 1) * valid, angles[:, :count, None] * valid, _described(seen)], -1)
        along = encode(directions, config.direction_frequencies)
        value = self.viewed(hidden, torch.cat([along, _padded(slots, config.blended).flatten(1)], 1))
        return self._blend(value, weights.log(), colours)

    def _blend(self, value: Tensor, weights: Tensor, colours: Tensor) -> Float[Tensor, "point 3"]:
        """The mean of colours by weights, given as logarithms, which the network multiplies; and its shift."""
        # the network's factor of each weight, as a logarithm, and its shift of the logit of the colour
        factors, shift = self.layer("colour", relu(value, inplace=True)).split([self.target.config.blended, 3], 1)
        weights = torch.softmax(weights + factors[:, : weights.shape[1]], 1)
        mean = (weights[..., None] * colours).sum(1)
        return torch.sigmoid(torch.logit(mean, 0.005) + shift)


def _of(colours: Float[Tensor, "point view 3"], views: Int[Tensor, "point chosen"]) -> Float[Tensor, "point chosen 3"]:
    """The colours of the chosen views; looking up all of them takes less time than a few by their indices."""
    return colours.gather(1, views[..., None].expand(-1, -1, 3))


def _described(seen: ChosenViews) -> Float[Tensor, "point view 3"]:
    """Depth behind the hull, coverage and validity as inputs, zero where a view is not valid."""
    valid = seen.valid
    return torch.stack([torch.tanh(FALLOFF * seen.behind) * valid, seen.coverage * valid, valid.to(seen.behind)], -1)


def _padded(slots: Float[Tensor, "point view number"], count: int) -> Float[Tensor, "point count number"]:
    """Zeros for the views that are missing."""
    return slots if slots.shape[1] == count else pad(slots, (0, 0, 0, count - slots.shape[1]))
