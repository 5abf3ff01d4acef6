"""The base classes of target networks: an MLP with explicit parameters, bound to planes as a field."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Annotated, Any, ClassVar, Self

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn.functional import linear, relu, softplus

from hyperplanes.fields.encoding import encode, encoded_size
from hyperplanes.fields.layers import Layer, PackedLayers, has_mixed_precision
from hyperplanes.fields.rig import Rig
from hyperplanes.geometry.image_planes import ImagePlanes
from hyperplanes.geometry.occupancy import Occupancy
from hyperplanes.geometry.rays import Sphere
from hyperplanes.parameters import Parameters
from hyperplanes.utilities.messages.arguments import checked_fields
from hyperplanes.utilities.tensors.cached_on import cached_on
from hyperplanes.utilities.tensors.transforms import wants_values_alone
from hyperplanes.views import Views

__all__ = ["Field", "MLPField", "Target", "TargetConfig"]


@checked_fields
@dataclass(frozen=True)
class TargetConfig:
    """The shape of a target network (HyperPlanes, Appendix B, has depth 8 and width 256).

    Attributes:
        depth: fully connected layers before the heads.
        width: of each of them; the layer before colours has half of it.
        planes: number of ImagePlanes of the network; for a field that takes any number of views, the number that is
            read at a point.
        point_frequencies: number of frequencies of the positional encoding of points.
        direction_frequencies: number of frequencies of the positional encoding of viewing directions.
        density_scale: factor of the density head; an object of unit radius is a few voxels deep, so typical densities
            are in the tens.
    """

    depth: Annotated[int, range(1, 257)] = 8
    width: Annotated[int, range(2, 8193)] = 256
    planes: Annotated[int, range(1, 1025)] = 25
    point_frequencies: Annotated[int, range(33)] = 10
    direction_frequencies: Annotated[int, range(33)] = 4
    density_scale: float = 25.0

    def __post_init__(self) -> None:
        if not 0 < self.density_scale < math.inf:
            raise ValueError(f"density_scale: expected more than 0 and finite, got {self.density_scale}")


class Target(nn.Module):
    """F(x, z, d; theta) = (c, sigma): colour depends on the direction, density does not.

    The module holds theta; `bind` makes a field of any parameters with the same names and shapes, or of those that
    `finer` returns. Subclasses define the input of the first layer, and override what differs from the paper's fields.

    Attributes:
        config_type: the dataclass of its configuration.
        permutation_invariant: whether it takes any number of views in any order, and so could copy the view that a ray
            comes from; otherwise it takes `config.planes` views, each at a fixed position in its input.
        reads_planes: whether it looks something up in support views. If not, and no hypernetwork reads them, all views
            are taken as they are.
        volume_size: channels and cells an axis of the result of `volume_of`; None if there is no such volume.
    """

    config_type: ClassVar[type[TargetConfig]] = TargetConfig
    permutation_invariant: ClassVar[bool] = False
    reads_planes: ClassVar[bool] = True
    volume_size: ClassVar[tuple[int, int] | None] = None

    def __init__(self, config: TargetConfig) -> None:
        super().__init__()
        self.config = config
        width = config.width
        self.skip = config.depth // 2
        self.layers = nn.ModuleList()
        for index in range(config.depth):
            size = self.input_size if index == 0 else width
            self.layers.append(nn.Linear(size + (self.input_size if index == self.skip > 0 else 0), width))
        self.density = nn.Linear(width, 1)
        self.feature = nn.Linear(width, width)
        self.view = nn.Linear(width + encoded_size(config.direction_frequencies), width // 2)
        self.colour = nn.Linear(width // 2, 3)
        for layer in self.modules():
            if isinstance(layer, nn.Linear):
                nn.init.kaiming_uniform_(layer.weight, nonlinearity="relu")
                nn.init.zeros_(layer.bias)
        nn.init.constant_(self.density.bias, -2.0)

    @property
    def reading_layers(self) -> tuple[str, ...]:
        """The names of the layers that read the inputs: the first one and that of the skip connection."""
        return ("layers.0",) if self.skip == 0 else ("layers.0", f"layers.{self.skip}")

    @property
    def input_size(self) -> int:
        """Number of inputs of the first layer."""
        raise TypeError(f"{type(self).__name__} does not define input_size")

    def inputs(self, points: Float[Tensor, "point 3"], planes: ImagePlanes | None, bounds: Sphere) -> Tensor:
        """The inputs of the first layer for world points, (point, input_size)."""
        raise TypeError(f"{type(self).__name__} does not define inputs")

    @property
    def rig_size(self) -> int:
        """Number of planes in the rig; 0 for a network that takes any number of views."""
        return 0 if self.permutation_invariant else self.config.planes

    @property
    def fine_tuning_rates(self) -> Mapping[str, float]:
        """Learning rates that suit this field better than the default ones, by their names in `FineTuning`."""
        return {}

    def arrange(self, support: Views, rig: Rig) -> Views:
        """The support views as planes: by default the nearest view for each plane of the rig, or all without a rig."""
        return support[rig.places(support)] if len(rig) else support

    def choose_hyperplanes(self, views: Views, rig: Rig, count: int, choice: str) -> Int[Tensor, " k"]:
        """The indices of the arranged views that a hypernetwork reads.

        Args:
            views: as `arrange` returned them.
            rig: of the views.
            count: k.
            choice: the "farthest" apart, or the "first".
        """
        if choice == "first":
            return torch.arange(count, device=views.images.device)
        return rig.farthest(count).to(views.images.device)

    def hull_resolution(self, configured: int, support: Views) -> int:
        """Voxels an axis of the visual hull of some views; by default the configured number."""
        return configured

    def planes_of(self, views: Views, occupancy: Occupancy) -> Any:
        """The input of `bind` from support views and their visual hull; by default the ImagePlanes alone."""
        return ImagePlanes(views.images, views.cameras)

    def volume_of(self, planes: Any) -> Float[Tensor, "channel x y z"] | None:
        """The planes projected onto a grid over the scene, for a hypernetwork that reads it; by default None."""
        return None

    def with_surface(self, planes: Any, voxels: Occupancy) -> Any:
        """The planes, with visibility by the surface of the voxels that a field fills; by default unchanged.

        Args:
            planes: of `planes_of`.
            voxels: inside the visual hull.
        """
        return planes

    def bind(self, parameters: Parameters, planes: Any, bounds: Sphere | None = None) -> Field:
        """The field of these parameters and planes.

        Args:
            parameters: theta or theta + delta.
            planes: of `planes_of`; None for a network that reads no image.
            bounds: the sphere of the scene, which is normalised to the unit sphere.

        Returns:
            A callable (points, directions) -> (colour, density).

        Raises:
            ValueError: a number of planes other than `config.planes`.
        """
        if planes is not None and len(planes) != self.config.planes:
            raise ValueError(f"planes: expected {self.config.planes}, got {len(planes)}")
        return MLPField(self, parameters, planes, bounds or Sphere())

    def finer(self, parameters: Parameters, cells: int) -> Parameters:
        """Parameters of nearly the same field with more capacity for detail; by default unchanged.

        Args:
            parameters: theta or theta + delta.
            cells: an axis of a grid of features, if there is one.
        """
        return parameters

    def config_of(self, parameters: Parameters) -> TargetConfig:
        """The configuration for these parameters: that of this network, except for what `finer` changes.

        Args:
            parameters: as `bind` takes them.
        """
        return self.config

    def parameters_of(self, field: object) -> Parameters:
        """The parameters that a field of this network was bound with.

        Raises:
            ValueError: a field that is not a network.
        """
        if not isinstance(field, Field):
            raise ValueError(f"adapted: expected a field that HyperPlanes made, got {type(field).__name__}")
        return field.parameters


@dataclass(frozen=True)
class Field:
    """A target network with its parameters and planes, as the renderer calls it.

    Attributes:
        target: the network.
        parameters: its weights for this object.
        planes: of `Target.planes_of` for this object.
        bounds: the sphere of the scene.
        mixed_precision: whether the layers before the heads may multiply in bfloat16 where that is faster and no
            gradient is needed.
    """

    target: Target
    parameters: Parameters
    planes: Any
    bounds: Sphere
    mixed_precision: bool = False

    thread_safe: ClassVar[bool] = True  # evaluation has no side effects, so threads can share a picture

    def __repr__(self) -> str:
        weights = sum(value.numel() for value in self.parameters.values())
        planes = "" if self.planes is None else f", {len(self.planes)} planes"
        return f"{type(self).__name__}({type(self.target).__name__}, {weights:,} weights{planes})"

    @cached_property
    def in_mixed_precision(self) -> Self:
        """The same field, with layers that may multiply in bfloat16; itself if that is not faster."""
        return replace(self, mixed_precision=True) if has_mixed_precision() and not self.mixed_precision else self

    @property
    def dtype(self) -> torch.dtype:
        """The precision of the weights, in which points are expected."""
        return next(iter(self.parameters.values())).dtype

    def __call__(
        self, points: Float[Tensor, "point 3"], directions: Float[Tensor, "point 3"]
    ) -> tuple[Float[Tensor, "point 3"], Float[Tensor, " point"]]:
        """Colour in [0, 1] and density per world unit at points seen along unit directions."""
        raise TypeError(f"{type(self).__name__} does not define __call__")

    def density(self, points: Float[Tensor, "point 3"]) -> Float[Tensor, " point"]:
        """Density per world unit, without colour."""
        raise TypeError(f"{type(self).__name__} does not define density")

    def trunk(self, inputs: Float[Tensor, "point input"]) -> Float[Tensor, "point width"]:
        """The layers before the heads, with the skip connection of NeRF in their middle."""
        names = [f"layers.{index}" for index in range(self.target.config.depth)]
        layers = [(self.parameters[f"{name}.weight"], self.parameters[f"{name}.bias"]) for name in names]
        values = (inputs, *(value for layer in layers for value in layer))
        if wants_values_alone(*values) and not torch.is_autocast_enabled("cpu"):
            packed = self._packed(layers)
            if packed is not None and packed.takes(inputs):
                return packed(inputs)
        value = inputs
        for index, (weight, bias) in enumerate(layers):
            if index == self.target.skip > 0:  # of inputs and values concatenated, without copying them
                size = inputs.shape[-1]
                value = torch.addmm(linear(inputs, weight[:, :size], bias), value, weight[:, size:].T)
            else:
                value = linear(value, weight, bias)
            value = relu(value, inplace=True)
        return value

    def _packed(self, layers: Sequence[Layer]) -> PackedLayers | None:
        """The layers for the kernel, packed once, and again if weights have changed in place."""
        values = [value for layer in layers for value in layer]
        return cached_on(
            self,
            "packed",
            values,
            lambda: PackedLayers.of(layers, self.target.skip, mixed_precision=self.mixed_precision),
        )

    def __getstate__(self) -> dict[str, Any]:
        """The attributes without cached values, for copies and pickles."""
        return {each.name: getattr(self, each.name) for each in fields(self)}

    def viewed(self, hidden: Float[Tensor, "point width"], seen: Float[Tensor, "point number"]) -> Tensor:
        """Output of the layer "view", before ReLU, for the concatenation of "feature" and the direction's inputs."""
        weight, bias, of_view = self._view_of_hidden()
        return torch.addmm(linear(seen, of_view, bias), hidden, weight.T)

    def _view_of_hidden(self) -> tuple[Tensor, Tensor, Tensor]:
        """Weight and bias of "feature" and "view" merged (nothing lies between them), and the weight for the rest.

        W [F h + f, d] + b = (W_h F) h + W_d d + (W_h f + b): two fifths of the multiplications for `small`.
        """
        view, width = self.parameters["view.weight"], self.target.config.width
        own, of_view = view[:, :width], view[:, width:]
        bias = torch.addmv(self.parameters["view.bias"], own, self.parameters["feature.bias"])
        return own @ self.parameters["feature.weight"], bias, of_view

    def layer(self, name: str, value: Tensor) -> Tensor:
        """A fully connected layer of the network."""
        return linear(value, self.parameters[f"{name}.weight"], self.parameters[f"{name}.bias"])


@dataclass(frozen=True, repr=False)
class MLPField(Field):
    """The field of a network whose first layer reads all planes at a point."""

    def __call__(
        self, points: Float[Tensor, "point 3"], directions: Float[Tensor, "point 3"]
    ) -> tuple[Float[Tensor, "point 3"], Float[Tensor, " point"]]:
        """Colour in [0, 1] and density per world unit at points seen along unit directions."""
        hidden = self.hidden(points)
        return self.colour_of(hidden, directions), self.density_of(hidden)

    def density(self, points: Float[Tensor, "point 3"]) -> Float[Tensor, " point"]:
        """Density per world unit, without colour."""
        return self.density_of(self.hidden(points))

    def hidden(self, points: Float[Tensor, "point 3"]) -> Float[Tensor, "point width"]:
        """The input of the heads, which is the expensive part of a point."""
        return self.trunk(self.target.inputs(points, self.planes, self.bounds))

    def density_of(self, hidden: Float[Tensor, "point width"]) -> Float[Tensor, " point"]:
        """The density head, with softplus instead of NeRF's ReLU, which could die as a hypernetwork moves its bias."""
        raw = self.layer("density", hidden)[:, 0]
        # per radius of the scene, so that a larger scene is not denser
        return softplus(raw) * (self.target.config.density_scale / self.bounds.radius)

    def colour_of(
        self, hidden: Float[Tensor, "point width"], directions: Float[Tensor, "point 3"]
    ) -> Float[Tensor, "point 3"]:
        """The colour head."""
        # the viewing direction is concatenated with the features of the point, for a layer of half the width
        seen = encode(directions, self.target.config.direction_frequencies)
        return torch.sigmoid(self.layer("colour", relu(self.viewed(hidden, seen), inplace=True)))

    def colours_along(
        self, hidden: Float[Tensor, "point width"], directions: Float[Tensor, "direction 3"]
    ) -> Float[Tensor, "point direction 3"]:
        """The colour head for all pairs of points and directions; what depends on one of them is computed once."""
        weight, bias, of_view = self._view_of_hidden()
        # W [h, d] + b = (W_h h + b) + W_d d: one product a point, one a direction
        here, along = linear(hidden, weight, bias), encode(directions, self.target.config.direction_frequencies)
        return torch.sigmoid(self.layer("colour", relu(here[:, None] + linear(along, of_view))))
