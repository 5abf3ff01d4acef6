"""A field that takes any number of views of any rig in any order, as in image-based rendering.

At each point, the trunk reads the few views that see it best, sorted by how well they do, so its weights do not depend
on the number or order of views. The colour is a blend of the views closest to the direction (Buehler et al. 2001,
"Unstructured Lumigraph Rendering"; Wang et al. 2021, "IBRNet"), with an offset from the network.
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
from hyperplanes.fields.encoding import encode
from hyperplanes.fields.rig import Rig
from hyperplanes.geometry.chosen_views import ChosenViews, Described, Reading, Visibility
from hyperplanes.geometry.occupancy import Occupancy
from hyperplanes.geometry.poses import outermost_first
from hyperplanes.geometry.rays import Sphere
from hyperplanes.geometry.visibility.planes import VisibilityPlanes
from hyperplanes.geometry.volume import VALUES_PER_CELL, VOLUME_SIDE, interpolate_grid, resampled_grid, volume_of
from hyperplanes.parameters import Parameters
from hyperplanes.utilities.messages.arguments import checked_fields
from hyperplanes.utilities.tensors.cached_on import cached_on
from hyperplanes.utilities.tensors.transforms import wants_values_alone
from hyperplanes.views import Views

__all__ = ["FeatureGrid", "ImageBasedConfig", "ImageBasedField", "ImageBasedNeRF"]

FALLOFF = 8.0  # factor of depths behind the hull before tanh, in 1 / radii
VOXELS_PER_PIXEL = 3 / 4  # along a side: 96 voxels for 128 pixels, as the preset "small" is trained
FINEST_HULL = 192
INITIAL_DENSITY_OUTSIDE = -4.0  # initial output of the density head outside the masks, before softplus
INITIAL_DENSITY_INSIDE = 4.0  # and inside

GRID_RATES = {"learning_rate": 2e-2, "muon_learning_rate": 0.05}
"""For fine-tuning the weights of a field with a grid of features, trained or random; docs/small-training.md."""


class FeatureGrid(nn.Module):
    """Features of the cells of a grid over the scene, as another layer of weights; initialised to zero.

    Hybrids of a grid and an MLP learn a scene in fewer steps than an MLP alone (Sun et al. 2022, "Direct Voxel Grid
    Optimization"; Mueller et al. 2022, "Instant Neural Graphics Primitives").

    Args:
        channels: features of each cell.
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
        grid: features of each cell of a grid over the scene, read in addition to the views; 0 means no grid.
        cells: of this grid, an axis.
    """

    blended: Annotated[int, range(1, 65)] = 4
    grid: Annotated[int, range(65)] = 0
    cells: Annotated[int, range(1, 257)] = VOLUME_SIDE

    @property
    def reading(self) -> Reading:
        """What the network reads of the views at each point."""
        return Reading(self.planes, self.blended, self.point_frequencies, self.direction_frequencies, FALLOFF)


class ImageBasedNeRF(Target):
    """F(x, z, d; theta) = (c, sigma), where z is sorted by visibility.

    With its initial weights it is nearly the visual hull with the blended colours of the views that see it; it learns
    the difference from that. With `grid`, the trunk also reads features interpolated in a grid over the scene, the
    first of them through a sigmoid. They are weights like all others, which a hypernetwork updates.
    """

    config_type: ClassVar[type[TargetConfig]] = ImageBasedConfig
    permutation_invariant: ClassVar[bool] = True
    config: ImageBasedConfig
    volume_size: ClassVar[tuple[int, int] | None] = (VALUES_PER_CELL, VOLUME_SIDE)

    def __init__(self, config: ImageBasedConfig) -> None:
        super().__init__(config)
        width = config.width
        if config.grid:
            self.grid = FeatureGrid(config.grid, config.cells)
        self.density = nn.Linear(width + 1, 1)
        self.view = nn.Linear(width + config.reading.near_size, width // 2)
        self.colour = nn.Linear(width // 2, config.blended + 3)
        # initial heads give the visual hull: density follows the masks, colours are the plain blend
        with torch.no_grad():
            for layer in (self.density, self.view, self.colour):
                nn.init.kaiming_uniform_(layer.weight, nonlinearity="relu")
                nn.init.zeros_(layer.bias)
            self.density.weight *= 0.1
            self.density.weight[0, width] = INITIAL_DENSITY_INSIDE - INITIAL_DENSITY_OUTSIDE
            self.density.bias.fill_(INITIAL_DENSITY_OUTSIDE)
            self.colour.weight *= 0.1

    @property
    def input_size(self) -> int:
        """The encoded point, the inputs from the best views, their statistics, and features of the grid."""
        return self.config.reading.row_size + self.config.grid

    @property
    def fine_tuning_rates(self) -> Mapping[str, float]:
        """Those of a grid of features."""
        return GRID_RATES if self.config.grid else {}

    def arrange(self, support: Views, rig: Rig) -> Views:
        """The views as they come."""
        return support

    def choose_hyperplanes(self, views: Views, rig: Rig, count: int, choice: str) -> Int[Tensor, " k"]:
        """At most `count` views: the first, or those farthest apart, beginning with the farthest from their mean."""
        count, device = min(count, len(views)), views.images.device
        if choice == "first":
            return torch.arange(count, device=device)
        return torch.tensor(outermost_first(views.camera_directions.cpu(), count), dtype=torch.long, device=device)

    def hull_resolution(self, configured: int, support: Views) -> int:
        """The configured number, or more for larger masks, so that the hull is as fine as they are."""
        if support.masks is None:
            return configured
        return max(configured, min(FINEST_HULL, round(VOXELS_PER_PIXEL * max(support.size))))

    def planes_of(self, views: Views, occupancy: Occupancy) -> VisibilityPlanes:
        """The views with their masks and the depth of the hull."""
        return VisibilityPlanes(views.images, views.cameras, views.masks, occupancy)

    def volume_of(self, planes: VisibilityPlanes) -> Float[Tensor, "channel x y z"]:
        """The views projected onto the cells of the grid."""
        return volume_of(planes)

    def with_surface(self, planes: VisibilityPlanes, voxels: Occupancy) -> VisibilityPlanes:
        """The planes, with visibility by the surface of these voxels instead of the hull."""
        return planes.with_surface(voxels)

    def finer(self, parameters: Parameters, cells: int) -> Parameters:
        """The parameters with the grid of features interpolated to more cells, if it has fewer; this smooths it."""
        grid = parameters.get("grid.weight")
        if grid is None or grid.shape[-1] >= cells:
            return parameters
        return Parameters({**parameters, "grid.weight": resampled_grid(grid, cells)})

    def config_of(self, parameters: Parameters) -> ImageBasedConfig:
        """The configuration with the number of cells of the grid."""
        grid = parameters.get("grid.weight")
        return self.config if grid is None else replace(self.config, cells=grid.shape[-1])

    def bind(
        self, parameters: Parameters, planes: VisibilityPlanes | None, bounds: Sphere | None = None
    ) -> ImageBasedField:
        """The field of these parameters and planes.

        Args:
            parameters: theta or theta + delta.
            planes: of `planes_of`, any number.
            bounds: the sphere of the scene, which is normalised to the unit sphere.

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
    """The inputs of the heads for points.

    Attributes:
        points: in the world.
        values: outputs of the trunk.
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
            # one kernel for the best views of each point (point, input) and the nearest ones (point, blended, ...)
            inputs, coverage, near = self._read(points, directions)
            hidden = self.trunk(inputs)
            return self._coloured(hidden, near), self._density(hidden, coverage)
        # the same in PyTorch: the views that see a point best, and those nearest to the direction
        config = self.target.config
        visibility = self.planes.choose(points, directions, best=config.planes, nearest=config.blended)
        colours = self.planes.colours.lookup(points).colours  # (point, view, 3)
        hidden = self._hidden(points, visibility, colours)
        return self._colour(hidden, visibility, colours, directions), self._density(hidden, visibility.coverage)

    def density(self, points: Float[Tensor, "point 3"]) -> Float[Tensor, " point"]:
        """Density per world unit, without colour."""
        return self.density_of(self.hidden(points))

    def hidden(self, points: Float[Tensor, "point 3"]) -> HiddenPoints:
        """The input of the heads, which is the expensive part of a point."""
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
            near = self.planes.describe(points, directions, replace(config.reading, best=0), self.bounds)
            return self._coloured(hidden.values, near)
        visibility = self.planes.choose(points, directions, best=0, nearest=config.blended)
        return self._colour(hidden.values, visibility, self.planes.colours.lookup(points).colours, directions)

    def _is_described(self, points: Tensor, directions: Tensor | None = None) -> bool:
        """Whether one kernel computes the inputs of the network; not for subclasses, which may read something else."""
        plain = type(self) is ImageBasedField and self.dtype == torch.float32 == points.dtype
        return plain and isinstance(self.planes, VisibilityPlanes) and self.planes.can_describe(points, directions)

    def _read(self, points: Tensor, directions: Tensor | None = None) -> tuple[Tensor, Tensor, Described]:
        """The inputs of the trunk, the least coverage and, with directions, the inputs of the colour head."""
        grid = self.parameters.get("grid.weight")
        learned = grid is not None and not wants_values_alone(grid)
        found = self.planes.describe(
            points, directions, self.target.config.reading, self.bounds, None if learned else self._cells
        )
        if not learned:
            return found.rows, found.coverage, found
        return torch.cat([found.rows, *self._features(points)], 1), found.coverage, found

    @property
    def _cells(self) -> Float[Tensor, "channel x y z"] | None:
        """The grid with the channels of a cell contiguous in memory, copied once, and again if it has changed."""
        grid = self.parameters.get("grid.weight")
        if grid is None:
            return None
        return cached_on(
            self, "cells", [grid], lambda: grid.detach().permute(1, 2, 3, 0).contiguous().permute(3, 0, 1, 2)
        )

    def _features(self, points: Tensor) -> list[Float[Tensor, "point number"]]:
        """Features of the grid, the first through a sigmoid."""
        if not self.target.config.grid:
            return []
        features = interpolate_grid(self.parameters["grid.weight"], points, self.bounds)
        return [torch.sigmoid(features[:, :1]), features[:, 1:]]

    def _coloured(self, hidden: Tensor, near: Described) -> Float[Tensor, "point 3"]:
        """As `_colour`, from the output of the kernel."""
        return self._blend(self.viewed(hidden, near.near_rows), near.near_weights, near.near_colours)

    def _hidden(self, points: Tensor, visibility: Visibility, shown: Tensor) -> Float[Tensor, "point width"]:
        """The trunk at points, which reads the `config.planes` views that see them best; `shown` has all colours."""
        config, seen = self.target.config, visibility.best
        # colours of the best views, from [0, 1] to [-1, 1]: (point, chosen, 3), then all inputs: (point, chosen, 9)
        colours = (2 * _of(shown, seen.views) - 1) * seen.valid[..., None]
        slots = torch.cat([colours, _described(seen), seen.directions * seen.valid[..., None]], -1)

        # statistics: mean, variance, difference of the best, least coverage, number of views
        weights = seen.weights[..., None]
        mean = (weights * colours).sum(1)
        variance = (weights * (colours - mean[:, None]).square()).sum(1)
        number = visibility.number.clamp_min(1).log()
        overall = [mean, variance, colours[:, 0] - mean, torch.stack([visibility.coverage, number], 1)]

        # the encoded point, the views one after the other, the statistics, the grid
        inputs = [encode(self.bounds.normalise(points), config.point_frequencies)]
        inputs += [_padded(slots, config.planes).flatten(1), *overall, *self._features(points)]
        return self.trunk(torch.cat(inputs, 1))

    def _density(self, hidden: Tensor, coverage: Tensor) -> Float[Tensor, " point"]:
        weight, bias = self.parameters["density.weight"][0], self.parameters["density.bias"]
        # of both concatenated, without copying them
        raw = torch.addmv(torch.addcmul(bias, coverage, weight[-1]), hidden, weight[:-1])
        return softplus(raw) * (self.target.config.density_scale / self.bounds.radius)

    def _colour(
        self, hidden: Tensor, visibility: Visibility, shown: Tensor, directions: Tensor
    ) -> Float[Tensor, "point 3"]:
        """A blend of the colours of the views nearest to the direction that see the point, with an offset.

        The network multiplies the weights of the unstructured lumigraph (`ChosenViews.lumigraph_weights`), and adds an
        offset to the logit of the result.
        """
        config, near = self.target.config, visibility.nearest
        assert near is not None
        count, angles = min(config.blended, len(self.planes)), near.angles(directions)
        weights = near.lumigraph_weights(angles, count)
        seen = near.first(count)
        colours, valid = _of(shown, seen.views), seen.valid[..., None]  # (point, blended, 3), (point, blended, 1)

        # inputs of the head: the trunk's output, the encoded direction, and those from each of these views
        slots = torch.cat([(2 * colours - 1) * valid, angles[:, :count, None] * valid, _described(seen)], -1)
        along = encode(directions, config.direction_frequencies)
        value = self.viewed(hidden, torch.cat([along, _padded(slots, config.blended).flatten(1)], 1))
        return self._blend(value, weights.log(), colours)

    def _blend(self, value: Tensor, weights: Tensor, colours: Tensor) -> Float[Tensor, "point 3"]:
        """The mean of colours with weights, given as logarithms and multiplied by the network, and the offset."""
        # factors of the weights, as logarithms, and the offset of the logit of the colour, by the network
        factors, shift = self.layer("colour", relu(value, inplace=True)).split([self.target.config.blended, 3], 1)
        weights = torch.softmax(weights + factors[:, : weights.shape[1]], 1)
        mean = (weights[..., None] * colours).sum(1)
        return torch.sigmoid(torch.logit(mean, 0.005) + shift)


def _of(colours: Float[Tensor, "point view 3"], views: Int[Tensor, "point chosen"]) -> Float[Tensor, "point chosen 3"]:
    """The colours of the chosen views; looking up all views is faster than a few by their indices."""
    return colours.gather(1, views[..., None].expand(-1, -1, 3))


def _described(seen: ChosenViews) -> Float[Tensor, "point view 3"]:
    """Inputs of depth behind the hull, coverage and validity; zero if a view is not valid."""
    valid = seen.valid
    return torch.stack([torch.tanh(FALLOFF * seen.behind) * valid, seen.coverage * valid, valid.to(seen.behind)], -1)


def _padded(slots: Float[Tensor, "point view number"], count: int) -> Float[Tensor, "point count number"]:
    """Pads missing views with zeros."""
    return slots if slots.shape[1] == count else pad(slots, (0, 0, 0, count - slots.shape[1]))
