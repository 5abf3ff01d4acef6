"""Samplers: where along rays a field is evaluated. They place samples and know no field; the renderer composites.

Samples come in two layouts, `DenseSamples` (the same number on every ray) and `PackedSamples` (any number on each).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float, Int
from torch import Tensor

from hyperplanes.geometry.occupancy import Occupancy
from hyperplanes.geometry.rays import Rays

__all__ = ["DenseSamples", "OpaqueSamples", "PackedSamples", "Sampler"]


@dataclass(frozen=True)
class DenseSamples:
    """Equally many samples on every ray.

    Attributes:
        distances: of the samples along their rays, ascending.
        edges: of the intervals that they stand for.
    """

    distances: Float[Tensor, "ray sample"]
    edges: Float[Tensor, "ray edge"]


@dataclass(frozen=True)
class PackedSamples:
    """Samples of many rays, one row a sample, ray after ray, in the order of distance.

    Attributes:
        ray: index of the ray of each sample, ascending.
        distances: of the samples along their rays.
        step: length of the interval that each stands for, in world units.
    """

    ray: Int[Tensor, " sample"]
    distances: Float[Tensor, " sample"]
    step: float

    def __len__(self) -> int:
        return len(self.ray)

    def __getitem__(self, index: slice | Tensor) -> PackedSamples:
        return PackedSamples(self.ray[index], self.distances[index], self.step)


class OpaqueSamples(PackedSamples):
    """Samples that hide all that lies behind them, at most one a ray: their densities need not be evaluated."""


@runtime_checkable
class Sampler(Protocol):
    """A sampling scheme with all that training and rendering need to know about it."""

    @property
    def near_far(self) -> str:
        """How near and far of the rays are chosen, as in `geometry.cast`."""
        ...

    @property
    def needs_occupancy(self) -> bool:
        """Whether samples are placed by an occupancy grid."""
        ...

    @property
    def stop(self) -> float:
        """Transmittance below which a ray of packed samples is finished; 0 never stops.

        With gradients rays end there on a CPU alone, where samples are random.
        """
        ...

    def for_rendering(self, pixels: float) -> Sampler:
        """The sampler for images of a field that was trained with this one; so many pixels cross the scene's sphere."""
        ...

    @property
    def summary(self) -> str:
        """Its samples, for tables."""
        ...

    def rays_per_chunk(self, device: torch.device) -> int:
        """How many rays are rendered at once where no gradient is wanted."""
        ...

    def place(
        self, rays: Rays, occupancy: Occupancy | None, generator: torch.Generator | None
    ) -> DenseSamples | PackedSamples:
        """The first samples of rays with near and far; a generator jitters them."""
        ...

    def refine(
        self, rays: Rays, samples: DenseSamples, weights: Tensor, generator: torch.Generator | None
    ) -> DenseSamples | None:
        """Samples in place of dense ones whose compositing weights are known; None where those are final."""
        ...
