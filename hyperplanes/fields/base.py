"""What every target network has in common: an MLP of explicit parameters, bound to planes as a field."""

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
from hyperplanes.utilities.arguments import checked_fields
from hyperplanes.utilities.kept import kept
from hyperplanes.utilities.transforms import wants_values_alone
from hyperplanes.views import Views

__all__ = ["Field", "MLPField", "Target", "TargetConfig"]


@checked_fields
@dataclass(frozen=True)
class TargetConfig:
    """The shape of a target network (HyperPlanes, Appendix B, has depth 8 and width 256).

    Attributes:
        depth: fully connected layers before the heads.
        width: of each of them; the layer before colours has half of it.
        planes: number of ImagePlanes the network is made for; of a field that takes any number of views, those
            that are read at a point.
        point_frequencies: number of frequencies of the positional encoding of points.
        direction_frequencies: number of frequencies of the positional encoding of viewing directions.
        density_scale: what the density head is multiplied with; an object of unit radius is a few voxels deep, so
            densities of tens are the rule.
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

    The module holds theta; `bind` evaluates the network with any parameters of the same names and shapes, and with what
    `finer` makes of them. Subclasses say what the first layer reads, and where they treat support views otherwise than
    the paper's fields do.

    Attributes:
        config_type: the dataclass of its shape.
        permutation_invariant: takes any number of views in any order, and so could copy the view that a ray comes from;
            otherwise `config.planes` views, each known by its place.
        reads_planes: looks something up in support views; otherwise, where nothing else reads them by their places, all
            of them are taken as they are.
        volume_size: channels and cells an axis of what `volume_of` makes; None where there is no such volume.
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
        """The names of the layers that read a point: the first one and that of the skip connection."""
        return ("layers.0",) if self.skip == 0 else ("layers.0", f"layers.{self.skip}")

    @property
    def input_size(self) -> int:
        """How many numbers the first layer reads of a point."""
        raise TypeError(f"{type(self).__name__} does not say what it reads")

    def inputs(self, points: Float[Tensor, "point 3"], planes: ImagePlanes | None, bounds: Sphere) -> Tensor:
        """What the first layer reads of world points, (point, input_size)."""
        raise TypeError(f"{type(self).__name__} does not say what it reads")

    @property
    def rig_size(self) -> int:
        """How many planes stand in a rig; 0 for a network that knows none by its place."""
        return 0 if self.permutation_invariant else self.config.planes

    @property
    def fine_tuning_rates(self) -> Mapping[str, float]:
        """Learning rates that suit the weights better than those of all fields, by the names of `FineTuning`."""
        return {}

    def arrange(self, support: Views, rig: Rig) -> Views:
        """The support views as planes: here one a plane, each the nearest to where the rig has one, if it has any."""
        return support[rig.places(support)] if len(rig) else support

    def choose_hyperplanes(self, views: Views, rig: Rig, count: int, choice: str) -> Int[Tensor, " k"]:
        """Which of the arranged views a hypernetwork reads.

        Args:
            views: as `arrange` returned them.
            rig: where they stand.
            count: k.
            choice: the "farthest" apart, or the "first".
        """
        if choice == "first":
            return torch.arange(count, device=views.images.device)
        return rig.farthest(count).to(views.images.device)

    def hull_resolution(self, configured: int, support: Views) -> int:
        """Voxels an axis of the visual hull of some views; here what the model is configured with."""
        return configured

    def planes_of(self, views: Views, occupancy: Occupancy) -> Any:
        """What `bind` reads of support views and their visual hull; here the ImagePlanes alone."""
        return ImagePlanes(views.images, views.cameras)

    def volume_of(self, planes: Any) -> Float[Tensor, "channel x y z"] | None:
        """What the planes show on a grid over the scene, for a hypernetwork that reads it; here nothing."""
        return None

    def with_surface(self, planes: Any, voxels: Occupancy) -> Any:
        """The planes with the surface of the voxels that a field fills; here as they are.

        Args:
            planes: of `planes_of`.
            voxels: within the visual hull.
        """
        return planes

    def bind(self, parameters: Parameters, planes: Any, bounds: Sphere | None = None) -> Field:
        """The field that these parameters and planes make.

        Args:
            parameters: theta or theta + delta.
            planes: the support images, as `planes_of` made them; None for a network that reads none.
            bounds: the sphere of the scene, which the network sees as the unit sphere.

        Returns:
            A callable (points, directions) -> (colour, density).

        Raises:
            ValueError: another number of planes than the network was made for.
        """
        if planes is not None and len(planes) != self.config.planes:
            raise ValueError(f"planes: expected {self.config.planes}, got {len(planes)}")
        return MLPField(self, parameters, planes, bounds or Sphere())

    def finer(self, parameters: Parameters, cells: int) -> Parameters:
        """Nearly the same field by weights that have room for more detail; here as they are.

        Args:
            parameters: theta or theta + delta.
            cells: an axis of a grid of features, where there is one.
        """
        return parameters

    def config_of(self, parameters: Parameters) -> TargetConfig:
        """The shape of the network that these parameters are of: this one, but for what `finer` changes.

        Args:
            parameters: that `bind` takes.
        """
        return self.config

    def parameters_of(self, field: object) -> Parameters:
        """The parameters that a field of this network was bound with.

        Raises:
            ValueError: a field that is no network.
        """
        if not isinstance(field, Field):
            raise ValueError(f"adapted: expected a field that HyperPlanes made, got {type(field).__name__}")
        return field.parameters


@dataclass(frozen=True)
class Field:
    """A target network with its parameters and planes: what the renderer calls.

    Attributes:
        target: the network.
        parameters: its weights for this object.
        planes: the support images of this object, as `Target.planes_of` made them.
        bounds: the sphere of the scene.
        mixed_precision: the layers before the heads may multiply numbers of bfloat16, where no gradient is wanted and
            that is faster; by default they are of single precision.
    """

    target: Target
    parameters: Parameters
    planes: Any
    bounds: Sphere
    mixed_precision: bool = False

    thread_safe: ClassVar[bool] = True  # nothing changes while it is evaluated: several threads share a picture

    def __repr__(self) -> str:
        weights = sum(value.numel() for value in self.parameters.values())
        planes = "" if self.planes is None else f", {len(self.planes)} planes"
        return f"{type(self).__name__}({type(self.target).__name__}, {weights:,} weights{planes})"

    @cached_property
    def in_mixed_precision(self) -> Self:
        """The same field, whose layers may multiply numbers of bfloat16; itself where that is no faster."""
        return replace(self, mixed_precision=True) if has_mixed_precision() and not self.mixed_precision else self

    @property
    def dtype(self) -> torch.dtype:
        """The precision of the weights, in which points are expected."""
        return next(iter(self.parameters.values())).dtype

    def __call__(
        self, points: Float[Tensor, "point 3"], directions: Float[Tensor, "point 3"]
    ) -> tuple[Float[Tensor, "point 3"], Float[Tensor, " point"]]:
        """Colour in [0, 1] and density per world unit at points seen along unit directions."""
        raise TypeError(f"{type(self).__name__} does not say what it computes")

    def density(self, points: Float[Tensor, "point 3"]) -> Float[Tensor, " point"]:
        """Density per world unit alone."""
        raise TypeError(f"{type(self).__name__} does not say what it computes")

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
            if index == self.target.skip > 0:  # of inputs and values side by side, without putting them there
                size = inputs.shape[-1]
                value = torch.addmm(linear(inputs, weight[:, :size], bias), value, weight[:, size:].T)
            else:
                value = linear(value, weight, bias)
            value = relu(value, inplace=True)
        return value

    def _packed(self, layers: Sequence[Layer]) -> PackedLayers | None:
        """The layers for the kernel: packed once, and anew where weights have changed in place."""
        values = [value for layer in layers for value in layer]
        return kept(
            self,
            "packed",
            values,
            lambda: PackedLayers.of(layers, self.target.skip, mixed_precision=self.mixed_precision),
        )

    def __getstate__(self) -> dict[str, Any]:
        """Without what is computed from the rest: for copies and pickles."""
        return {each.name: getattr(self, each.name) for each in fields(self)}

    def viewed(self, hidden: Float[Tensor, "point width"], seen: Float[Tensor, "point number"]) -> Tensor:
        """Output of the layer "view", before ReLU, for the concatenation of "feature" and the direction's inputs."""
        weight, bias, of_view = self._view_of_hidden()
        return torch.addmm(linear(seen, of_view, bias), hidden, weight.T)

    def _view_of_hidden(self) -> tuple[Tensor, Tensor, Tensor]:
        """Weights and biases of "feature" and "view" as one layer, since nothing lies between them; those of the rest.

        W [F h + f, d] + b = (W_h F) h + W_d d + (W_h f + b): of `small` two fifths of the products.
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
        """Density per world unit alone."""
        return self.density_of(self.hidden(points))

    def hidden(self, points: Float[Tensor, "point 3"]) -> Float[Tensor, "point width"]:
        """What the heads read; all that is expensive about a point."""
        return self.trunk(self.target.inputs(points, self.planes, self.bounds))

    def density_of(self, hidden: Float[Tensor, "point width"]) -> Float[Tensor, " point"]:
        """The opacity head. Softplus, not NeRF's ReLU: it cannot die, and a hypernetwork moves its bias."""
        raw = self.layer("density", hidden)[:, 0]
        # per radius of the scene, so that a larger scene is no denser
        return softplus(raw) * (self.target.config.density_scale / self.bounds.radius)

    def colour_of(
        self, hidden: Float[Tensor, "point width"], directions: Float[Tensor, "point 3"]
    ) -> Float[Tensor, "point 3"]:
        """The colour head."""
        # the viewing direction joins the features of the point, in a layer of half the width
        seen = encode(directions, self.target.config.direction_frequencies)
        return torch.sigmoid(self.layer("colour", relu(self.viewed(hidden, seen), inplace=True)))

    def colours_along(
        self, hidden: Float[Tensor, "point width"], directions: Float[Tensor, "direction 3"]
    ) -> Float[Tensor, "point direction 3"]:
        """The colour head for every point in every direction; what does not depend on both is computed once."""
        weight, bias, of_view = self._view_of_hidden()
        # W [h, d] + b = (W_h h + b) + W_d d: one product a point, one a direction
        here, along = linear(hidden, weight, bias), encode(directions, self.target.config.direction_frequencies)
        return torch.sigmoid(self.layer("colour", relu(here[:, None] + linear(along, of_view))))
