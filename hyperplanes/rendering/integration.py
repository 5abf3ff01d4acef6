"""Samples of a scene made into pixels: all at once, for gradients, or front to back until rays are opaque."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from hyperplanes.geometry.rays import Rays
from hyperplanes.rendering.compositing import Rendered, composite, composite_packed, packed_weights
from hyperplanes.rendering.samplers import DenseSamples, PackedSamples, Sampler
from hyperplanes.rendering.scene import FieldFunction, Scene, evaluate

__all__ = ["integrate"]

FIRST_ROUND = 4  # samples a ray before the first test for opaque rays
GROWTH = 4  # every later round takes this fraction of the samples so far, and at least as many as the first


def integrate(
    scene: Scene, rays: Rays, sampler: Sampler, generator: torch.Generator | None, differentiable: bool
) -> Rendered:
    """The pixels of rays, all in one pass.

    Args:
        scene: what is rendered.
        rays: with near and far.
        sampler: places the samples.
        generator: jitters them.
        differentiable: packed samples are evaluated all at once, for gradients; otherwise front to back.

    Returns:
        The pixels, of the field and of its coarse pass where there is one.
    """
    samples = sampler.place(rays, scene.occupancy, generator)
    if isinstance(samples, DenseSamples):
        return _coarse_to_fine(scene, rays, sampler, samples, generator, differentiable)
    return _all_at_once(scene, rays, samples) if differentiable else _front_to_back(scene, rays, samples, sampler.stop)


def _coarse_to_fine(
    scene: Scene,
    rays: Rays,
    sampler: Sampler,
    samples: DenseSamples,
    generator: torch.Generator | None,
    differentiable: bool,
) -> Rendered:
    """The first samples by the proposal; then, where the sampler refines them by their weights, those by the field."""

    def composited(function: FieldFunction, samples: DenseSamples) -> tuple[Rendered, Tensor]:
        points = rays.at(samples.distances)
        directions = rays.directions[:, None].expand_as(points)
        colour, density = evaluate(function, points.reshape(-1, 3), directions.reshape(-1, 3), differentiable)
        shape = samples.distances.shape
        return composite(
            colour.reshape(*shape, 3), density.reshape(shape), samples.edges, scene.background,
            distances=samples.distances,
        )  # fmt: skip

    coarse, weights = composited(scene.proposal or scene.field, samples)
    refined = sampler.refine(rays, samples, weights, generator)
    if refined is None:
        return coarse
    fine, _ = composited(scene.field, refined)
    return replace(fine, samples=coarse.samples + fine.samples, coarse=coarse)


def _all_at_once(scene: Scene, rays: Rays, samples: PackedSamples) -> Rendered:
    """Every sample with its gradient. The proposal, where there is one, is evaluated at every second sample of a ray.

    Each of those stands for the next one too, where there is one, so that both integrate over the same length.
    """

    def composited(function: FieldFunction, chosen: PackedSamples, lengths: Tensor | float) -> Rendered:
        colour, density = _evaluate_packed(function, rays, chosen, differentiable=True)
        weights = packed_weights(density * lengths, chosen.ray, len(rays))
        return composite_packed(colour, weights, chosen.distances, chosen.ray, len(rays), scene.background)

    fine = composited(scene.field, samples, samples.step)
    if scene.proposal is None:
        return fine
    rank, total = _ranks(samples.ray, len(rays))
    even = (rank % 2 == 0).nonzero()[:, 0]
    alone = rank[even] + 1 == total[samples.ray[even]]
    coarse = composited(scene.proposal, samples[even], torch.where(alone, 1, 2) * samples.step)
    return replace(fine, samples=fine.samples + coarse.samples, coarse=coarse)


def _ranks(ray: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """The index of each packed sample within its ray, and the number of samples of each ray."""
    total = torch.bincount(ray, minlength=count)
    first = total.cumsum(0) - total
    return torch.arange(len(ray), device=ray.device) - first[ray], total


def _front_to_back(scene: Scene, rays: Rays, samples: PackedSamples, stop: float) -> Rendered:
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
        colour, density = _evaluate_packed(scene.field, rays, part, differentiable=False)
        # Weights within the round, times the transmittance of what earlier rounds passed through.
        added = density * part.step
        weights.append(packed_weights(added, part.ray, len(rays)) * torch.exp(-optical_depth[part.ray]))
        colours.append(colour)
        evaluated.append(chosen)
        optical_depth = optical_depth.index_add(0, part.ray, added)
        remaining = remaining[optical_depth[samples.ray[remaining]] < limit]
    part = samples[torch.cat(evaluated)]
    return composite_packed(
        torch.cat(colours), torch.cat(weights), part.distances, part.ray, len(rays), scene.background
    )


def _evaluate_packed(
    field: FieldFunction, rays: Rays, samples: PackedSamples, differentiable: bool
) -> tuple[Tensor, Tensor]:
    """Colours and densities at packed samples."""
    directions = rays.directions[samples.ray]
    points = rays.origins[samples.ray] + samples.distances[:, None] * directions
    return evaluate(field, points, directions, differentiable)
