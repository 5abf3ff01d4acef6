"""NeRF's hierarchical sampling: stratified samples on every ray, then more samples where their weights are high.

Vocabulary: `edges` are distances that divide a ray into intervals, (ray, interval + 1), ascending; a sample stands for
its interval; `weights` are the compositing weights of the intervals, (ray, interval).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal

import torch
from jaxtyping import Float
from torch import Tensor

from hyperplanes.geometry.occupancy import Occupancy
from hyperplanes.geometry.rays import Rays
from hyperplanes.rendering.sampling.samplers import DenseSamples
from hyperplanes.utilities.messages.arguments import checked_fields

__all__ = ["Hierarchical", "importance", "intervals", "stratified"]


@checked_fields
@dataclass(frozen=True)
class Hierarchical:
    """The paper's sampler: the same number of samples on every ray, in a coarse and a fine pass.

    Attributes:
        coarse: stratified samples per ray.
        fine: importance samples per ray.
        placement: where the field is evaluated. "intervals": importance samples divide the coarse intervals further,
            and the field is evaluated once in each of the coarse + fine intervals. "samples", as in NeRF: at the coarse
            and fine samples themselves, each of which stands for the distance to the next, or to far.
    """

    coarse: Annotated[int, range(1, 16385)] = 64
    fine: Annotated[int, range(16385)] = 128
    placement: Literal["intervals", "samples"] = "intervals"

    near_far: ClassVar[str] = "constant"  # one near and far for all rays of a camera, as in NeRF
    needs_occupancy: ClassVar[bool] = False  # empty space is sampled too

    def __post_init__(self) -> None:
        if self.placement == "samples" and self.fine and self.coarse < 3:
            raise ValueError(f"coarse: expected at least 3 samples to draw fine ones between, got {self.coarse}")

    def for_rendering(self, pixels: float) -> Hierarchical:
        """The same samples as in training."""
        return self

    @property
    def summary(self) -> str:
        """Coarse and fine samples.

        >>> Hierarchical(64, 128).summary
        '64 + 128'
        """
        return f"{self.coarse} + {self.fine}"

    def rays_per_chunk(self, device: torch.device) -> int:
        """An eighth of what `RayMarching` takes on a CPU, since every ray has all its samples."""
        return 1 << 9 if device.type == "cpu" else 1 << 16

    @property
    def stop(self) -> float:
        """0: the paper evaluates every sample."""
        return 0.0

    def place(
        self, rays: Rays, occupancy: Occupancy | None = None, generator: torch.Generator | None = None
    ) -> DenseSamples:
        """The coarse pass: stratified samples; `occupancy` is not used."""
        edges = intervals(rays, self.coarse)
        places = stratified(edges, generator)
        if self.placement == "samples":
            edges = torch.cat([places, rays.far[:, None]], 1)
        return DenseSamples(places, edges)

    def refine(
        self, rays: Rays, samples: DenseSamples, weights: Tensor, generator: torch.Generator | None = None
    ) -> DenseSamples | None:
        """The fine pass: the coarse samples or intervals with those drawn in proportion to the weights."""
        if not self.fine:
            return None
        if self.placement == "samples":  # drawn between the middles of the coarse samples (NeRF, section 5.2)
            first = samples.distances
            middles = (first[:, 1:] + first[:, :-1]) / 2
            added = importance(middles, weights[:, 1:-1], self.fine, generator)
            places = torch.cat([first, added], 1).sort(1).values
            return DenseSamples(places, torch.cat([places, rays.far[:, None]], 1))
        added = importance(samples.edges, weights, self.fine, generator)
        edges = torch.cat([samples.edges, added], 1).sort(1).values
        return DenseSamples(stratified(edges, generator), edges)


def intervals(rays: Rays, count: int) -> Float[Tensor, "ray edge"]:
    """The edges of `count` equal intervals from near to far.

    Args:
        rays: with near <= far.
        count: intervals per ray.

    Returns:
        count + 1 edges per ray; the first is near, the last far.
    """
    fraction = torch.linspace(0, 1, count + 1, dtype=rays.near.dtype, device=rays.near.device)
    return rays.near[:, None] + (rays.far - rays.near)[:, None] * fraction


def stratified(
    edges: Float[Tensor, "ray edge"], generator: torch.Generator | None = None
) -> Float[Tensor, "ray interval"]:
    """One distance in each interval, uniformly distributed if a generator is given (NeRF, Eq. 2).

    Each sample stands for its whole interval, so the sum over samples of density times length is unbiased.

    Args:
        edges: of the intervals, ascending.
        generator: on the CPU; without one, samples are the middles.

    Returns:
        Ascending distances.
    """
    if generator is None:
        return (edges[:, 1:] + edges[:, :-1]) / 2
    place = torch.rand(len(edges), edges.shape[1] - 1, generator=generator).to(edges)
    return edges[:, :-1] + place * edges.diff(dim=1)


def importance(
    edges: Float[Tensor, "ray edge"],
    weights: Float[Tensor, "ray interval"],
    count: int,
    generator: torch.Generator | None = None,
) -> Float[Tensor, "ray new"]:
    """Distances drawn from the piecewise constant density that the weights describe (NeRF, section 5.2).

    Args:
        edges: of the coarse intervals.
        weights: of the coarse intervals; no gradient flows through them.
        count: new distances per ray.
        generator: on the CPU; without one, quantiles are evenly spaced.

    Returns:
        Ascending distances between the edges.
    """
    # the cumulative distribution over the intervals of each ray; every interval has some probability
    mass = weights.detach() + 1e-5
    cumulative = torch.cat([torch.zeros_like(mass[:, :1]), mass.cumsum(1)], 1)
    cumulative = cumulative / cumulative[:, -1:]
    # one quantile per distance, evenly spaced or stratified
    if generator is None:
        quantile = (torch.arange(count, dtype=edges.dtype, device=edges.device) + 0.5) / count
        quantile = quantile.expand(len(edges), -1).contiguous()
    else:
        offset = torch.rand(len(edges), count, generator=generator).to(edges)
        quantile = (torch.arange(count, dtype=edges.dtype, device=edges.device) + offset) / count
    # the interval of each quantile, and the position in it
    above = torch.searchsorted(cumulative, quantile, right=True).clamp(1, mass.shape[1])
    low, high = cumulative.gather(1, above - 1), cumulative.gather(1, above)
    start, end = edges.gather(1, above - 1), edges.gather(1, above)
    return start + (end - start) * ((quantile - low) / (high - low).clamp_min(1e-12)).clamp(0, 1)
