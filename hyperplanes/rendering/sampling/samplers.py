"""Samplers: where along rays a field is evaluated. They are independent of the field; the renderer composites.

Samples come in two layouts, `DenseSamples` (the same number on every ray) and `PackedSamples` (any number on each).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Protocol, runtime_checkable

import torch
from jaxtyping import Float, Int
from torch import Tensor

from hyperplanes.geometry.occupancy import Occupancy
from hyperplanes.geometry.rays import Rays

__all__ = ["DenseSamples", "OpaqueSamples", "PackedSamples", "Sampler"]


@dataclass(frozen=True)
class DenseSamples:
    """The same number of samples on every ray.

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
        step: length of the interval that each sample stands for, in world units.
    """

    ray: Int[Tensor, " sample"]
    distances: Float[Tensor, " sample"]
    step: float

    def __len__(self) -> int:
        return len(self.ray)

    def __getitem__(self, index: slice | Tensor) -> PackedSamples:
        return PackedSamples(self.ray[index], self.distances[index], self.step)


class OpaqueSamples(PackedSamples):
    """Samples that hide everything behind them, at most one per ray; their densities need not be evaluated."""


@runtime_checkable
class Sampler(Protocol):
    """A sampling scheme, for training and rendering.

    Attributes:
        near_far: how near and far of the rays are chosen, as in `geometry.cast`.
        needs_occupancy: whether samples are placed with an occupancy grid.
    """

    near_far: ClassVar[str]
    needs_occupancy: ClassVar[bool]

    @property
    def stop(self) -> float:
        """Transmittance below which a ray of packed samples ends; 0 never stops.

        With gradients, rays end only on a CPU, and only if samples are random.
        """
        ...

    def for_rendering(self, pixels: float) -> Sampler:
        """The sampler for pictures of a field that was trained with this one; the scene's sphere is `pixels` across."""
        ...

    @property
    def summary(self) -> str:
        """The samples in short, for tables."""
        ...

    def rays_per_chunk(self, device: torch.device) -> int:
        """Number of rays that are rendered at once without gradients."""
        ...

    def place(
        self, rays: Rays, occupancy: Occupancy | None, generator: torch.Generator | None
    ) -> DenseSamples | PackedSamples:
        """The first samples of rays; a generator jitters them."""
        ...

    def refine(
        self, rays: Rays, samples: DenseSamples, weights: Tensor, generator: torch.Generator | None
    ) -> DenseSamples | None:
        """Samples that replace dense ones, given the weights of these; None if these are final."""
        ...
