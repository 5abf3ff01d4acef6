"""Ray marching: samples at equal steps, packed over all rays, only where an occupancy grid is occupied."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Annotated

import torch
from jaxtyping import Float, Int
from torch import Tensor

from hyperplanes.geometry.occupancy import Occupancy
from hyperplanes.geometry.rays import Rays
from hyperplanes.rendering.compositing import Rendered, composite_packed, packed_weights
from hyperplanes.rendering.samplers import FieldFunction, evaluate

__all__ = ["Marched", "PackedSamples", "march"]

CANDIDATES = 1 << 21  # samples tested against the grid at once; 12 bytes each
FIRST_ROUND = 4  # samples a ray before the first test for opaque rays
GROWTH = 4  # every later round takes this fraction of the samples so far, and at least as many as the first


@dataclass(frozen=True)
class PackedSamples:
    """Samples of many rays in one row each, ray after ray, in the order of distance.

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


@dataclass(frozen=True)
class Marched:
    """The default sampler: equal steps, only in occupied voxels, and in images only until the ray is opaque.

    Attributes:
        steps: samples along a diameter of the scene's sphere.
        stop: transmittance below which a ray is finished (only where no gradient is wanted); 0 never stops.
    """

    steps: Annotated[int, range(1, 16385)] = 96
    stop: float = 5e-3

    @property
    def span(self) -> str:
        """Near and far where the ray crosses the scene's sphere."""
        return "sphere"

    @property
    def needs_occupancy(self) -> bool:
        """Yes."""
        return True

    @property
    def for_rendering(self) -> Marched:
        """5 samples for 3 in training, where they are jittered."""
        return Marched(self.steps * 5 // 3, self.stop)

    @property
    def summary(self) -> str:
        """Steps along a diameter."""
        return f"{self.steps} in hull"

    def rays_per_chunk(self, device: torch.device) -> int:
        """So many that few chunks make an image and the packed samples fit into memory."""
        return 1 << 16 if device.type == "cuda" else 1 << 14

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
        """The pixels of rays.

        Args:
            field: any callable, as in `renderer.render`.
            rays: with near and far.
            occupancy: which voxels are sampled; its sphere gives the length of a step.
            proposal: a coarse field that is rendered as well where gradients are wanted, so that it learns.
            generator: jitters the samples.
            background: grey value behind everything.
            differentiable: evaluate all samples at once, for gradients; otherwise front to back, until rays are opaque.

        Returns:
            The pixels, of the field and of its proposal.

        Raises:
            ValueError: no occupancy.
        """
        if occupancy is None:
            raise ValueError("occupancy: expected an Occupancy for Marched sampling, got None; geometry.full makes one")
        samples = march(rays, occupancy, 2 * occupancy.bounds.radius / self.steps, generator)
        if differentiable:
            return _all_at_once(field, rays, samples, proposal, background)
        return _front_to_back(field, rays, samples, self.stop, background)


@torch.no_grad()
def march(rays: Rays, occupancy: Occupancy, step: float, generator: torch.Generator | None = None) -> PackedSamples:
    """One sample every `step` along each ray, in the middle of the step, where the grid is occupied.

    Args:
        rays: with near <= far.
        occupancy: which voxels are sampled.
        step: distance between samples in world units.
        generator: shifts each ray's samples by one random fraction of a step; on the CPU.

    Returns:
        The samples in occupied voxels.
    """
    longest = float((rays.far - rays.near).max()) if len(rays) else 0.0
    count = int(longest / step) + 1
    offset = torch.full((len(rays),), 0.5, dtype=rays.near.dtype)
    if generator is not None:
        offset = torch.rand(len(rays), generator=generator, dtype=rays.near.dtype)
    start = rays.near + offset.to(rays.near) * step
    steps = torch.arange(count, dtype=start.dtype, device=start.device) * step
    pieces = []
    for first in range(0, len(rays), max(1, CANDIDATES // count)):
        part = rays[first : first + max(1, CANDIDATES // count)]
        t = start[first : first + len(part), None] + steps
        live = occupancy.contains(part.at(t)) & (t < part.far[:, None])
        ray, index = live.nonzero().unbind(1)
        pieces.append((ray + first, t[ray, index]))
    if not pieces:
        return PackedSamples(start.new_zeros(0, dtype=torch.long), start.new_zeros(0), step)
    return PackedSamples(torch.cat([ray for ray, _ in pieces]), torch.cat([t for _, t in pieces]), step)


def _all_at_once(
    field: FieldFunction, rays: Rays, samples: PackedSamples, proposal: FieldFunction | None, background: float
) -> Rendered:
    """Every sample with its gradient. The proposal, where there is one, is evaluated at every second sample of a ray.

    Each of those stands for the next one too, where there is one, so that both integrate over the same length.
    """

    def composited(function: FieldFunction, chosen: PackedSamples, lengths: Tensor | float) -> Rendered:
        colour, density = _evaluate_packed(function, rays, chosen, differentiable=True)
        weights = packed_weights(density * lengths, chosen.ray, len(rays))
        return composite_packed(colour, weights, chosen.distances, chosen.ray, len(rays), background)

    fine = composited(field, samples, samples.step)
    if proposal is None:
        return fine
    rank, total = _ranks(samples.ray, len(rays))
    even = (rank % 2 == 0).nonzero()[:, 0]
    alone = rank[even] + 1 == total[samples.ray[even]]
    coarse = composited(proposal, samples[even], torch.where(alone, 1, 2) * samples.step)
    return replace(fine, samples=fine.samples + coarse.samples, coarse=coarse)


def _ranks(ray: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """The index of each packed sample within its ray, and the number of samples of each ray."""
    total = torch.bincount(ray, minlength=count)
    first = total.cumsum(0) - total
    return torch.arange(len(ray), device=ray.device) - first[ray], total


def _front_to_back(
    field: FieldFunction, rays: Rays, samples: PackedSamples, stop: float, background: float
) -> Rendered:
    """Rounds of a few samples a ray; rays whose transmittance has fallen below `stop` leave (early ray termination)."""
    optical_depth = torch.zeros(len(rays), dtype=samples.distances.dtype, device=samples.distances.device)
    limit = -math.log(stop) if stop > 0 else math.inf
    remaining = torch.arange(len(samples), device=samples.ray.device)
    rank, _ = _ranks(samples.ray, len(rays))
    colours, weights, evaluated = [rays.origins.new_zeros(0, 3)], [optical_depth[:0]], [remaining[:0]]
    reach = 0
    while len(remaining):
        # This round: the samples of the rays left whose rank is below `reach`.
        reach += max(FIRST_ROUND, reach // GROWTH)
        now = rank[remaining] < reach
        chosen, remaining = remaining[now], remaining[~now]
        part = samples[chosen]
        colour, density = _evaluate_packed(field, rays, part, differentiable=False)
        # Weights within the round, times the transmittance of what earlier rounds passed through.
        added = density * part.step
        weights.append(packed_weights(added, part.ray, len(rays)) * torch.exp(-optical_depth[part.ray]))
        colours.append(colour)
        evaluated.append(chosen)
        optical_depth = optical_depth.index_add(0, part.ray, added)
        remaining = remaining[optical_depth[samples.ray[remaining]] < limit]
    part = samples[torch.cat(evaluated)]
    return composite_packed(torch.cat(colours), torch.cat(weights), part.distances, part.ray, len(rays), background)


def _evaluate_packed(
    field: FieldFunction, rays: Rays, samples: PackedSamples, differentiable: bool
) -> tuple[Tensor, Tensor]:
    """Colours and densities at packed samples."""
    directions = rays.directions[samples.ray]
    points = rays.origins[samples.ray] + samples.distances[:, None] * directions
    return evaluate(field, points, directions, differentiable)
