"""What the renderer asks of a sampler: where along rays to evaluate a field, and how to make pixels of the values."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol, runtime_checkable

import torch
from torch import Tensor

from hyperplanes.geometry.occupancy import Occupancy
from hyperplanes.geometry.rays import Rays
from hyperplanes.rendering.compositing import Rendered

__all__ = ["FieldFunction", "Sampler", "evaluate", "points_per_batch"]

FieldFunction = Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]
"""Points (n, 3) and unit directions (n, 3) -> colours (n, 3) in [0, 1] and densities (n,) per world unit."""


@runtime_checkable
class Sampler(Protocol):
    """A sampling scheme with all that training and rendering need to know about it."""

    @property
    def span(self) -> str:
        """How near and far of the rays are chosen, as in `geometry.cast`."""
        ...

    @property
    def needs_occupancy(self) -> bool:
        """Whether samples are placed by an occupancy grid."""
        ...

    @property
    def for_rendering(self) -> Sampler:
        """The sampler for images of a field that was trained with this one."""
        ...

    @property
    def summary(self) -> str:
        """Its samples, for tables."""
        ...

    def rays_per_chunk(self, device: torch.device) -> int:
        """How many rays are rendered at once where no gradient is wanted."""
        ...

    def render(
        self,
        field: FieldFunction,
        rays: Rays,
        *,
        occupancy: Occupancy | None = None,
        proposal: FieldFunction | None = None,
        generator: torch.Generator | None = None,
        background: float = 1.0,
        differentiable: bool = True,
    ) -> Rendered:
        """The pixels of rays, all at once; arguments as in `renderer.render`."""
        ...


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
        ValueError: values of another shape.
    """
    size = len(points) if differentiable else points_per_batch(points.device)
    parts = [field(*part) for part in zip(points.split(max(1, size)), directions.split(max(1, size)), strict=True)]
    colour, density = parts[0] if len(parts) == 1 else (torch.cat(values) for values in zip(*parts, strict=True))
    if colour.shape != points.shape or density.shape != points.shape[:1]:
        raise ValueError(
            f"field: expected colours {tuple(points.shape)} and densities {tuple(points.shape[:1])}, "
            f"got {tuple(colour.shape)} and {tuple(density.shape)}"
        )
    return colour, density


def points_per_batch(device: torch.device) -> int:
    """How many points a field is evaluated at in one call where no gradient is kept.

    On a CPU a few megabytes of activations, which stay in its cache; on a GPU a hundredth of its free memory, at about
    8 KiB a point.
    """
    if device.type == "cuda":
        free, _ = torch.cuda.mem_get_info(device)
        return max(1 << 16, free // 100 // 8192)
    return 1 << 13
