"""A field and rays make pixels. The field is any callable (points, directions) -> (colour, density)."""

from __future__ import annotations

import math
from collections.abc import Callable, Generator
from contextlib import contextmanager
from dataclasses import dataclass

import torch
from torch import Tensor

from hyperplanes.geometry.occupancy import Occupancy
from hyperplanes.geometry.rays import Rays
from hyperplanes.rendering.compositing import Rendered, composite, composite_packed, packed_weights
from hyperplanes.rendering.marching import Packed, march
from hyperplanes.rendering.sampling import importance, intervals, stratified

__all__ = [
    "FieldFunction",
    "Hierarchical",
    "Marched",
    "render",
    "render_in_chunks",
    "samples_at_once",
    "shorter_products",
]

ROUND = 4  # samples a ray before the first look at which rays are finished
GROWTH = 4  # every later round takes this fraction of the samples so far, and at least as many as the first

FieldFunction = Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]


@dataclass(frozen=True)
class Hierarchical:
    """The paper's protocol: every ray, coarse samples first, fine ones where their weight is.

    Attributes:
        coarse: stratified samples a ray.
        fine: importance samples a ray. They cut the coarse intervals further, and the field is asked once in each of
            the coarse + fine intervals, where NeRF asks it at the coarse and the fine samples themselves.
    """

    coarse: int = 64
    fine: int = 128


@dataclass(frozen=True)
class Marched:
    """The default protocol: samples at equal steps, only in occupied voxels, only until the ray is opaque.

    Attributes:
        steps: samples along a diameter of the scene's sphere.
        stop: transmittance below which a ray is finished (only where no gradient is wanted); 0 never stops.
    """

    steps: int = 96
    stop: float = 5e-3

    @property
    def finer(self) -> Marched:
        """More samples, 5 for 3: what pictures are rendered by, where training jitters what it has."""
        return Marched(self.steps * 5 // 3, self.stop)


def render(
    field: FieldFunction,
    rays: Rays,
    sampling: Hierarchical | Marched,
    *,
    occupancy: Occupancy | None = None,
    proposal: FieldFunction | None = None,
    generator: torch.Generator | None = None,
    background: float = 1.0,
) -> Rendered:
    """The pixels that rays see.

    Args:
        field: asked for colour and density.
        rays: any number.
        sampling: which protocol.
        occupancy: what may matter; needed by `Marched`, unused by `Hierarchical`.
        proposal: the field of the coarse pass of `Hierarchical`; `field` where absent. `Marched` asks it only where
            gradients are wanted, so that it learns.
        generator: jitters the samples; without one they are the same each time.
        background: grey value behind everything.

    Returns:
        Pixels with gradients to whatever the field depends on.

    Raises:
        ValueError: `Marched` without an occupancy.
    """
    if isinstance(sampling, Hierarchical):
        return _hierarchical(field, rays, sampling, proposal or field, generator, background)
    if occupancy is None:
        raise ValueError("occupancy: expected an Occupancy for Marched sampling, got None; geometry.full makes one")
    samples = march(rays, occupancy, 2 * occupancy.bounds.radius / sampling.steps, generator)
    if torch.is_grad_enabled():
        return _all_at_once(field, rays, samples, proposal, background)
    return _front_to_back(field, rays, samples, sampling.stop, background)


def _ask(field: FieldFunction, points: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
    """The field at points; without gradients some at a time, so that its activations stay small."""
    at_once = samples_at_once(points.device)
    if torch.is_grad_enabled() or len(points) <= at_once:
        return field(points, directions)
    parts = [field(*part) for part in zip(points.split(at_once), directions.split(at_once), strict=True)]
    return torch.cat([colour for colour, _ in parts]), torch.cat([density for _, density in parts])


def _hierarchical(
    field: FieldFunction,
    rays: Rays,
    sampling: Hierarchical,
    proposal: FieldFunction,
    generator: torch.Generator | None,
    background: float,
) -> Rendered:
    def see(function: FieldFunction, edges: Tensor) -> tuple[Rendered, Tensor]:
        t = stratified(edges, generator)
        points = rays.at(t)
        directions = rays.directions[:, None].expand_as(points)
        colour, density = _ask(function, points.reshape(-1, 3), directions.reshape(-1, 3))
        return composite(colour.reshape(*t.shape, 3), density.reshape(t.shape), edges, background, at=t)

    edges = intervals(rays, sampling.coarse)
    coarse, weights = see(proposal, edges)
    if not sampling.fine:
        return coarse
    fine, _ = see(field, torch.cat([edges, importance(edges, weights, sampling.fine, generator)], 1).sort(1).values)
    return Rendered(fine.colour, fine.opacity, fine.depth, coarse.samples + fine.samples, coarse.colour)


def _ask_packed(field: FieldFunction, rays: Rays, samples: Packed) -> tuple[Tensor, Tensor]:
    """The field at packed samples."""
    directions = rays.directions[samples.ray]
    return _ask(field, rays.origins[samples.ray] + samples.middles[:, None] * directions, directions)


def samples_at_once(device: torch.device) -> int:
    """How many samples a field is asked for at once where no gradient is kept.

    On a CPU a few megabytes of activations, which stay in its cache; on a GPU a hundredth of its free memory, at about
    8 KiB a sample.
    """
    if device.type == "cuda":
        free, _ = torch.cuda.mem_get_info(device)
        return max(1 << 16, free // 100 // 8192)
    return 1 << 13


def _all_at_once(
    field: FieldFunction, rays: Rays, samples: Packed, proposal: FieldFunction | None, background: float
) -> Rendered:
    """Every sample with its gradient. The proposal, where there is one, learns from every second sample of each ray.

    Each of those stands for the next one too, where there is one, so that both see the same length of a ray.
    """

    def see(function: FieldFunction, chosen: Packed, width: Tensor | float) -> Rendered:
        colour, density = _ask_packed(function, rays, chosen)
        weights = packed_weights(density * width, chosen.ray, len(rays))
        return composite_packed(colour, weights, chosen.middles, chosen.ray, len(rays), background)

    fine = see(field, samples, samples.width)
    if proposal is None:
        return fine
    rank, total = _ranks(samples.ray, len(rays))
    even = (rank % 2 == 0).nonzero()[:, 0]
    alone = rank[even] + 1 == total[samples.ray[even]]
    coarse = see(proposal, samples[even], torch.where(alone, 1, 2) * samples.width)
    return Rendered(fine.colour, fine.opacity, fine.depth, fine.samples + coarse.samples, coarse.colour)


def _ranks(ray: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Which sample of its ray each packed sample is, counted from 0, and how many each ray has."""
    total = torch.bincount(ray, minlength=count)
    first = total.cumsum(0) - total
    return torch.arange(len(ray), device=ray.device) - first[ray], total


def _front_to_back(field: FieldFunction, rays: Rays, samples: Packed, stop: float, background: float) -> Rendered:
    """Rounds of a few samples a ray, dropping the rays that have become opaque."""
    passed = torch.zeros(len(rays), dtype=samples.middles.dtype, device=samples.middles.device)
    limit = -math.log(stop) if stop > 0 else math.inf
    remaining = torch.arange(len(samples), device=samples.ray.device)
    rank, _ = _ranks(samples.ray, len(rays))
    colours, weights, asked = [rays.origins.new_zeros(0, 3)], [passed[:0]], [remaining[:0]]
    reach = 0
    while len(remaining):
        reach += max(ROUND, reach // GROWTH)
        now = rank[remaining] < reach
        chosen, remaining = remaining[now], remaining[~now]
        part = samples[chosen]
        colour, density = _ask_packed(field, rays, part)
        thickness = density * part.width
        weights.append(packed_weights(thickness, part.ray, len(rays)) * torch.exp(-passed[part.ray]))
        colours.append(colour)
        asked.append(chosen)
        passed = passed.index_add(0, part.ray, thickness)
        remaining = remaining[passed[samples.ray[remaining]] < limit]
    part = samples[torch.cat(asked)]
    return composite_packed(torch.cat(colours), torch.cat(weights), part.middles, part.ray, len(rays), background)


@contextmanager
def shorter_products(device: torch.device) -> Generator[None]:
    """On a GPU, matrix products of single precision that read 10 bits of each fraction (TF32), as tensor cores do.

    With operands so rounded, pictures of the paper's networks are within 0.001 dB of the unrounded ones.
    """
    before = torch.get_float32_matmul_precision()
    if device.type == "cuda":
        torch.set_float32_matmul_precision("high")
    try:
        yield
    finally:
        torch.set_float32_matmul_precision(before)


@torch.no_grad()
def render_in_chunks(
    field: FieldFunction, rays: Rays, sampling: Hierarchical | Marched, *, chunk: int | None = None, **options: object
) -> Rendered:
    """`render` without gradients, some rays at a time, so that memory does not grow with the picture.

    Args:
        field: as in `render`.
        rays: as in `render`.
        sampling: as in `render`.
        chunk: rays at once; where absent 16,384 on a CPU (a quarter where all are sampled alike) and 65,536 on a GPU.
        options: as in `render`.

    Returns:
        The pixels of all rays, those of the coarse pass where there was one.
    """
    device = rays.origins.device
    if chunk is None:
        chunk = 1 << 16 if device.type == "cuda" else 1 << 14 if isinstance(sampling, Marched) else 1 << 12
    with shorter_products(device):
        parts = [
            render(field, rays[first : first + chunk], sampling, **options)  # pyright: ignore[reportArgumentType]
            for first in range(0, max(1, len(rays)), chunk)
        ]
    coarse = [part.coarse for part in parts if part.coarse is not None]
    return Rendered(
        torch.cat([part.colour for part in parts]),
        torch.cat([part.opacity for part in parts]),
        torch.cat([part.depth for part in parts]),
        sum(part.samples for part in parts),
        torch.cat(coarse) if coarse else None,
    )
