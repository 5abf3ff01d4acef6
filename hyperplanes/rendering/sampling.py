"""Where along a ray the field is asked.

Vocabulary: `edges` are distances that cut a ray into intervals, (ray, interval + 1), ascending; a sample stands for its
interval; `weights` are what compositing gave each interval, (ray, interval).
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from hyperplanes.geometry.rays import Rays

__all__ = ["importance", "intervals", "stratified"]


def intervals(rays: Rays, count: int) -> Float[Tensor, "ray edge"]:
    """The edges of `count` equal intervals from near to far.

    Args:
        rays: with near <= far.
        count: intervals a ray.

    Returns:
        count + 1 edges a ray; the first is near, the last far.
    """
    fraction = torch.linspace(0, 1, count + 1, dtype=rays.near.dtype, device=rays.near.device)
    return rays.near[:, None] + (rays.far - rays.near)[:, None] * fraction


def stratified(
    edges: Float[Tensor, "ray edge"], generator: torch.Generator | None = None
) -> Float[Tensor, "ray interval"]:
    """One distance in each interval, uniform within it where a generator is given (NeRF, Eq. 2).

    A sample stands for the whole of its interval, so the sum over samples of density times length is right on average,
    whatever the density.

    Args:
        edges: of the intervals, ascending.
        generator: on the CPU; without one the samples are the middles.

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
        count: new distances a ray.
        generator: on the CPU; without one the quantiles are evenly spaced.

    Returns:
        Ascending distances within the edges.
    """
    mass = weights.detach() + 1e-5
    cumulative = torch.cat([torch.zeros_like(mass[:, :1]), mass.cumsum(1)], 1)
    cumulative = cumulative / cumulative[:, -1:]
    if generator is None:
        quantile = (torch.arange(count, dtype=edges.dtype, device=edges.device) + 0.5) / count
        quantile = quantile.expand(len(edges), -1).contiguous()
    else:
        offset = torch.rand(len(edges), count, generator=generator).to(edges)
        quantile = (torch.arange(count, dtype=edges.dtype, device=edges.device) + offset) / count
    above = torch.searchsorted(cumulative, quantile, right=True).clamp(1, mass.shape[1])
    low, high = cumulative.gather(1, above - 1), cumulative.gather(1, above)
    start, end = edges.gather(1, above - 1), edges.gather(1, above)
    return start + (end - start) * ((quantile - low) / (high - low).clamp_min(1e-12)).clamp(0, 1)
