"""What is rendered: a field, its occupancy, the field of a coarse pass, and the background."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, is_dataclass
from typing import Any, Protocol, runtime_checkable

import torch
from torch import Tensor

from hyperplanes.geometry.occupancy import Occupancy
from hyperplanes.utilities.messages.arguments import kind_of

__all__ = [
    "FieldFunction",
    "Scene",
    "SplitField",
    "can_be_joined",
    "dtype_of",
    "evaluate",
    "is_thread_safe",
    "join_hidden",
    "mapped",
    "points_per_batch",
]

FieldFunction = Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]
"""Points (n, 3) and unit directions (n, 3) -> colours (n, 3) in [0, 1] and densities (n,) per world unit.

If it has an attribute `thread_safe` that is true, several threads evaluate it at once when no gradients are kept."""


@runtime_checkable
class SplitField(Protocol):
    """A field whose colours can be evaluated after its densities, at some of the points.

    In training, densities are first evaluated without gradients, to choose the samples that get one: anything that a
    field caches between calls, such as features of its views, must be computed under `torch.enable_grad()`.
    """

    def __call__(self, points: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
        """Colours and densities, as of any field."""
        ...

    def hidden(self, points: Tensor) -> Any:
        """The values from which densities and colours of points (n, 3) are computed.

        They can be indexed like a tensor. A tensor of n rows, or a dataclass of such tensors, is concatenated over
        several calls before colours are evaluated.
        """
        ...

    def density_of(self, hidden: Any) -> Tensor:
        """Densities (n,) per world unit."""
        ...

    def colour_of(self, hidden: Any, directions: Tensor) -> Tensor:
        """Colours (n, 3) in [0, 1], seen along unit directions (n, 3)."""
        ...


def dtype_of(field: FieldFunction) -> torch.dtype:
    """The dtype in which a field expects points: its attribute `dtype`; float32 without one."""
    return getattr(field, "dtype", torch.float32)


def is_thread_safe(field: FieldFunction) -> bool:
    """Whether several threads may evaluate a field at once: its attribute `thread_safe`; False without one."""
    return getattr(field, "thread_safe", False)


def mapped(
    field: FieldFunction,
    points: Callable[[Tensor], Tensor],
    directions: Callable[[Tensor], Tensor],
    values: Callable[[Tensor], Tensor] | None = None,
) -> FieldFunction:
    """A field with transformed points, directions and values; a `SplitField` if the given one is.

    Args:
        field: any callable.
        points: maps its points to those of the given field.
        directions: maps directions likewise.
        values: maps colours and densities back; None leaves them unchanged.
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
        return dtype_of(self.field)

    @property
    def thread_safe(self) -> bool:
        return is_thread_safe(self.field)

    def __call__(self, points: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
        colour, density = self.field(self.points(points), self.directions(directions))
        return self._value(colour), self._value(density)

    def _value(self, found: Tensor) -> Tensor:
        return found if self.values is None else self.values(found)


class _SplitMapped(_Mapped):
    """The same for a `SplitField`."""

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
        occupancy: voxels outside of which the field is empty.
        proposal: the field of the coarse pass, if it is another one.
        background: grey value behind everything.
    """

    field: FieldFunction
    occupancy: Occupancy | None = None
    proposal: FieldFunction | None = None
    background: float = 1.0

    @property
    def is_thread_safe(self) -> bool:
        """Whether several threads may call its fields at once."""
        return is_thread_safe(self.field) and (self.proposal is None or is_thread_safe(self.proposal))


def evaluate(
    field: FieldFunction, points: Tensor, directions: Tensor, differentiable: bool = True
) -> tuple[Tensor, Tensor]:
    """Colours and densities of a field at points.

    Args:
        field: any callable.
        points: (n, 3) in the world.
        directions: (n, 3) unit vectors.
        differentiable: whether all points are evaluated in one call; otherwise in batches, to bound memory.

    Returns:
        Colours (n, 3) and densities (n,).

    Raises:
        ValueError: not a pair of tensors, values of another shape, or densities below 0.
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
            "apply torch.nn.functional.softplus or relu"
        )
    return colour, density


def _is_negative(density: Tensor) -> bool:
    """Whether a density is below 0; False under `torch.compile` and `torch.func`, where values are not known."""
    if torch.compiler.is_compiling() or torch._C._are_functorch_transforms_active():
        return False
    return bool((density.detach() < 0).any())


def can_be_joined(hidden: Any) -> bool:
    """Whether `join_hidden` supports the hidden values of a `SplitField`.

    Args:
        hidden: of a batch of points.
    """
    if isinstance(hidden, Tensor):
        return True
    parts = fields(hidden) if is_dataclass(hidden) else ()
    return bool(parts) and all(each.init and isinstance(getattr(hidden, each.name), Tensor) for each in parts)


def join_hidden(parts: Sequence[Any]) -> Any:
    """Concatenates the hidden values of a `SplitField` for several batches of points (`can_be_joined`).

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
    """Number of points at which a field is evaluated in one call without gradients.

    On a CPU, for a few megabytes of activations, which stay in its cache; on a GPU, for a twentieth of its free memory,
    at about 8 KiB per point.
    """
    if device.type == "cpu":
        return 1 << 13
    free, _ = torch.cuda.mem_get_info(device) if device.type == "cuda" else (0, 0)
    return max(1 << 16, free // 20 // 8192)
