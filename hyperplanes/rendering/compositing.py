"""Alpha compositing of samples along rays: dense, (ray, sample), and packed, one row per sample."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

__all__ = ["Rendered", "composite", "composite_packed", "packed_weights"]

MAX_SAMPLE_OPTICAL_DEPTH = 1e3  # of a sample: exp(-1000) is 0, and the cumulative sum over all rays stays accurate


@dataclass(frozen=True)
class Rendered:
    """The pixels of rays.

    Attributes:
        colour: over the background.
        opacity: 1 - the transmittance of the whole ray.
        depth: expected distance along the ray in world units, sum of w t / opacity; 0 where the opacity is 0.
        samples: number of field evaluations, over all rays.
        coarse: the pixels of the coarse pass, if there was one; training has a loss on their colour too.
    """

    colour: Float[Tensor, "ray 3"]
    opacity: Float[Tensor, " ray"]
    depth: Float[Tensor, " ray"]
    samples: int
    coarse: Rendered | None = None

    def over(self, background: Float[Tensor, " 3"]) -> Rendered:
        """The pixels, rendered over white, composited over another colour; those of the coarse pass too."""
        colour = self.colour + (1 - self.opacity)[:, None] * (background - 1)
        return replace(self, colour=colour, coarse=self.coarse and self.coarse.over(background))

    def pooled(self, count: int) -> Rendered:
        """Averages `count` rays a pixel, ordered with the first ray of every pixel first, then every second ray.

        Depth is that of the first rays.

        Args:
            count: rays of a pixel.
        """
        if count == 1:
            return self
        colour, opacity = (each.unflatten(0, (count, -1)).mean(0) for each in (self.colour, self.opacity))
        depth = self.depth[: len(opacity)]
        return Rendered(colour, opacity, depth, self.samples, self.coarse and self.coarse.pooled(count))


def composite(
    colour: Float[Tensor, "ray interval 3"],
    density: Float[Tensor, "ray interval"],
    edges: Float[Tensor, "ray edge"],
    background: float = 1.0,
    *,
    distances: Float[Tensor, "ray interval"] | None = None,
) -> tuple[Rendered, Float[Tensor, "ray interval"]]:
    """w_i = T_i (1 - exp(-sigma_i delta_i)), T_i = exp(-sum_{j<i} sigma_j delta_j) (NeRF, Eq. 3).

    Args:
        colour: one a sample.
        density: of each sample, per world unit.
        edges: of the intervals that the samples stand for, ascending; delta_i is the length of each.
        background: grey value behind everything.
        distances: of the samples along their rays, for the depth; by default the middles of the intervals.

    Returns:
        The pixels, and the weights for importance sampling.
    """
    # optical depth of each interval, and of all before it
    lengths = edges.diff(dim=1)
    optical_depth = torch.where(lengths != 0, density, 0.0) * lengths  # infinity times 0 is not a number
    before = torch.cat([torch.zeros_like(optical_depth[:, :1]), optical_depth.cumsum(1)], 1)
    transmittance = torch.exp(-before)
    # weights T_i (1 - exp(-sigma_i delta_i)) = T_i - T_{i+1}
    weights = transmittance[:, :-1] - transmittance[:, 1:]
    opacity = 1 - transmittance[:, -1]
    distances = (edges[:, 1:] + edges[:, :-1]) / 2 if distances is None else distances
    # mean distance of what is seen; the background fills the rest of the pixel
    depth = (weights * distances).sum(1) / opacity.clamp_min(1e-10)
    pixels = (weights[..., None] * colour).sum(1) + (1 - opacity)[:, None] * background
    return Rendered(pixels, opacity, depth, density.numel()), weights


def packed_weights(
    optical_depth: Float[Tensor, " sample"], ray: Int[Tensor, " sample"], count: int
) -> Float[Tensor, " sample"]:
    """Compositing weights of packed samples.

    Args:
        optical_depth: sigma delta of each sample; those of a ray are adjacent, in the order of distance.
        ray: index of the ray of each sample, ascending.
        count: number of rays.

    Returns:
        w_i as in `composite`. An infinite density or NaN affects only its own ray.
    """
    if not len(optical_depth):
        return optical_depth
    # one cumulative sum over all rays, minus its value at the start of each ray; in double precision so that rays late
    # in the batch stay accurate
    finite = optical_depth.double().nan_to_num(0.0).clamp_max(MAX_SAMPLE_OPTICAL_DEPTH)
    before = finite.cumsum(0) - finite
    first = torch.searchsorted(ray, torch.arange(count, device=ray.device)).clamp_max(len(ray) - 1)
    before = (before - before[first][ray]).to(optical_depth.dtype)
    return torch.exp(-before) * -torch.expm1(-optical_depth)


def composite_packed(
    colour: Float[Tensor, "sample 3"],
    weights: Float[Tensor, " sample"],
    distances: Float[Tensor, " sample"],
    ray: Int[Tensor, " sample"],
    count: int,
    background: float = 1.0,
) -> Rendered:
    """Pixels of `count` rays from weighted samples in any order."""
    # colour, distance and weight of each sample, summed by ray
    values = torch.cat([colour, distances[:, None], torch.ones_like(distances)[:, None]], 1) * weights[:, None]
    sums = values.new_zeros(count, 5).index_add(0, ray, values)
    opacity = sums[:, 4]
    pixels = sums[:, :3] + (1 - opacity)[:, None] * background
    return Rendered(pixels, opacity, sums[:, 3] / opacity.clamp_min(1e-10), len(weights))
