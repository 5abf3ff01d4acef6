"""Live samples only: rays walked through an occupancy grid, the samples packed across rays."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from hyperplanes.geometry.occupancy import Occupancy
from hyperplanes.geometry.rays import Rays

__all__ = ["Packed", "march"]

CHUNK = 1 << 21  # candidate samples tested at once; 12 bytes each


@dataclass(frozen=True)
class Packed:
    """Samples of many rays in one row each; those of a ray stand together, near ones first.

    Attributes:
        ray: which ray each belongs to, ascending.
        middles: distance of each sample.
        width: length of every interval, in world units.
    """

    ray: Int[Tensor, " sample"]
    middles: Float[Tensor, " sample"]
    width: float

    def __len__(self) -> int:
        return len(self.ray)

    def __getitem__(self, index: slice | Tensor) -> Packed:
        return Packed(self.ray[index], self.middles[index], self.width)


@torch.no_grad()
def march(rays: Rays, occupancy: Occupancy, step: float, generator: torch.Generator | None = None) -> Packed:
    """One sample every `step` along each ray, where the grid is occupied.

    Args:
        rays: with near <= far.
        occupancy: what may matter.
        step: distance between samples in world units.
        generator: shifts each ray's samples by one random fraction of a step; on the CPU.

    Returns:
        The live samples.
    """
    longest = float((rays.far - rays.near).max()) if len(rays) else 0.0
    count = int(longest / step) + 1
    offset = torch.full((len(rays),), 0.5, dtype=rays.near.dtype)
    if generator is not None:
        offset = torch.rand(len(rays), generator=generator, dtype=rays.near.dtype)
    start = rays.near + offset.to(rays.near) * step
    steps = torch.arange(count, dtype=start.dtype, device=start.device) * step
    pieces = []
    for first in range(0, len(rays), max(1, CHUNK // count)):
        part = rays[first : first + max(1, CHUNK // count)]
        t = start[first : first + len(part), None] + steps
        live = occupancy.contains(part.at(t)) & (t < part.far[:, None])
        ray, index = live.nonzero().unbind(1)
        pieces.append((ray + first, t[ray, index]))
    if not pieces:
        return Packed(start.new_zeros(0, dtype=torch.long), start.new_zeros(0), step)
    return Packed(torch.cat([ray for ray, _ in pieces]), torch.cat([t for _, t in pieces]), step)
