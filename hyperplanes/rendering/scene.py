"""What is rendered: a field, the space it may fill, the field of a coarse pass, and what stands behind."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, is_dataclass
from typing import Any, Protocol, runtime_checkable

import torch
from torch import Tensor

from hyperplanes.geometry.occupancy import Occupancy
from hyperplanes.utilities.arguments import kind_of

__all__ = [
    "FieldFunction",
    "Scene",
    "SplitField",
    "can_be_joined",
    "evaluate",
    "join_hidden",
    "mapped",
    "points_per_batch",
]

FieldFunction = Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]
"""Points (n, 3) and unit directions (n, 3) -> colours (n, 3) in [0, 1] and densities (n,) per world unit.

One with an attribute `thread_safe` that is true is evaluated by several threads at once where no gradient is kept."""


@runtime_checkable
class SplitField(Protocol):
    """A field whose colours can be asked for later than its densities, at some of the points.

    In training its densities are asked for without gradients first, to choose the samples that get one: what a field
    keeps from call to call, such as features of its views, is to be computed under `torch.enable_grad()`.
    """

    def __call__(self, points: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
        """Both at once, as any field."""
        ...

    def hidden(self, points: Tensor) -> Any:
        """What densities and colours of points (n, 3) are computed from.

        It can be indexed like a tensor. What is a tensor of as many rows, or a dataclass of such tensors, is joined
        from several calls before colours are asked for.
        """
        ...

    def density_of(self, hidden: Any) -> Tensor:
        """Densities (n,) per world unit."""
        ...

    def colour_of(self, hidden: Any, directions: Tensor) -> Tensor:
        """Colours (n, 3) in [0, 1] seen along unit directions (n, 3)."""
        ...


def mapped(
    field: FieldFunction,
    points: Callable[[Tensor], Tensor],
    directions: Callable[[Tensor], Tensor],
    values: Callable[[Tensor], Tensor] | None = None,
) -> FieldFunction:
    """A field of other points: its colours can be asked for later where those of the given one can.

    Args:
        field: any callable.
        points: those that it is asked for -> those of the given field.
        directions: likewise.
        values: of colours and densities; None leaves them as they are.
    """
    kind = _SplitMapped if isinstance(field, SplitField) else _Mapped
    return kind(field, points, directions, values)


@dataclass(frozen=True)
class _Mapped:
    """As `mapped`."""

    field: Any
    points: Callable[[Tensor], Tensor]
    directions: Callable[[Tensor], Tensor]
    values: Callable[[Tensor], Tensor] | None

    @property
    def dtype(self) -> torch.dtype:
        return getattr(self.field, "dtype", torch.float32)

    @property
    def thread_safe(self) -> bool:
        return getattr(self.field, "thread_safe", False)

    def __call__(self, points: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
        colour, density = self.field(self.points(points), self.directions(directions))
        return self._value(colour), self._value(density)

    def _value(self, found: Tensor) -> Tensor:
        return found if self.values is None else self.values(found)


class _SplitMapped(_Mapped):
    """Likewise, of one whose colours can be asked for later than its densities."""

    def hidden(self, points: Tensor) -> Any:
        return self.field.hidden(self.points(points))

    def density_of(self, hidden: Any) -> Tensor:
        return self._value(self.field.density_of(hidden))

    def colour_of(self, hidden: Any, directions: Tensor) -> Tensor:
        return self._value(self.field.colour_of(hidden, self.directions(directions)))


@dataclass(frozen=True)
class Scene:
    """What the renderer draws.

    Attributes:
        field: any callable.
        occupancy: voxels where the field can be anything but empty.
        proposal: the field of the coarse pass, where it is another one.
        background: grey value behind everything.
    """

    field: FieldFunction
    occupancy: Occupancy | None = None
    proposal: FieldFunction | None = None
    background: float = 1.0

    @property
    def is_thread_safe(self) -> bool:
        """Whether its fields say, by an attribute `thread_safe`, that several threads may call them at once."""
        fields = (self.field, self.proposal or self.field)
        return all(getattr(field, "thread_safe", False) for field in fields)


def evaluate(
    field: FieldFunction, points: Tensor, directions: Tensor, differentiable: bool = True
) -> tuple[Tensor, Tensor]:
    """Colours and densities of a field at points.

    Args:
        field: any callable.
        points: (n, 3) in the world.
        directions: (n, 3) unit vectors.
        differentiable: all points in one call; otherwise in batches, which bounds the memory of activations.

    Returns:
        Colours (n, 3) and densities (n,).

    Raises:
        ValueError: no pair of tensors, values of another shape, or densities below 0.
    """
    size = len(points) if differentiable else points_per_batch(points.device)
    parts = [field(*part) for part in zip(points.split(max(1, size)), directions.split(max(1, size)), strict=True)]
    for part in parts:
        if not (isinstance(part, tuple | list) and len(part) == 2 and all(isinstance(each, Tensor) for each in part)):
            raise ValueError(f"field: expected a pair of tensors, colours and densities, got {kind_of(part)}")
    colour, density = parts[0] if len(parts) == 1 else (torch.cat(values) for values in zip(*parts, strict=True))
    if colour.shape != points.shape or density.shape != points.shape[:1]:
        raise ValueError(
            f"field: expected colours {tuple(points.shape)} and densities {tuple(points.shape[:1])}, "
            f"got {tuple(colour.shape)} and {tuple(density.shape)}"
        )
    if _is_negative(density):
        raise ValueError(
            f"field: expected densities of 0 or more, got {float(density.detach().min()):.3g}; "
            "torch.nn.functional.softplus or relu makes them so"
        )
    return colour, density


def _is_negative(density: Tensor) -> bool:
    """Whether a density is below 0; values cannot be looked at under `torch.compile` and `torch.func`."""
    if torch.compiler.is_compiling() or torch._C._are_functorch_transforms_active():
        return False
    return bool((density.detach() < 0).any())


def can_be_joined(hidden: Any) -> bool:
    """Whether `join_hidden` takes what a `SplitField` computes densities and colours from.

    Args:
        hidden: of a batch of points.
    """
    if isinstance(hidden, Tensor):
        return True
    parts = fields(hidden) if is_dataclass(hidden) else ()
    return bool(parts) and all(each.init and isinstance(getattr(hidden, each.name), Tensor) for each in parts)


def join_hidden(parts: Sequence[Any]) -> Any:
    """What a `SplitField` computes densities and colours from, of several batches of points as one (`can_be_joined`).

    Args:
        parts: at least one.
    """
    first = parts[0]
    if len(parts) == 1:
        return first
    if isinstance(first, Tensor):
        return torch.cat(list(parts))
    return type(first)(**{each.name: torch.cat([getattr(part, each.name) for part in parts]) for each in fields(first)})


def points_per_batch(device: torch.device) -> int:
    """How many points a field is evaluated at in one call where no gradient is kept.

    On a CPU a few megabytes of activations, which stay in its cache; on a GPU a twentieth of its free memory, at about
    8 KiB a point.
    """
    if device.type == "cpu":
        return 1 << 13
    free, _ = torch.cuda.mem_get_info(device) if device.type == "cuda" else (0, 0)
    return max(1 << 16, free // 20 // 8192)
