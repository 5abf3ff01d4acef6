"""Ray marching: samples at equal steps, packed over all rays, only in occupied voxels."""

from __future__ import annotations

import math
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Annotated, ClassVar

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from hyperplanes.geometry.kernels.compiling import compile_kernel
from hyperplanes.geometry.kernels.threads import parallel_for
from hyperplanes.geometry.occupancy import Occupancy
from hyperplanes.geometry.rays import Rays
from hyperplanes.rendering.sampling.samplers import DenseSamples, PackedSamples
from hyperplanes.utilities.messages.arguments import checked_fields
from hyperplanes.utilities.tensors.transforms import are_plain

__all__ = ["RayMarching", "march"]

CANDIDATES = 1 << 21  # samples tested against the grid at once; 12 bytes each
RAY_CHUNK = 512  # in one call of the kernel
REFERENCE_PIXELS = 100  # across the scene, for 5/3 of the samples of training
MAX_PIXEL_RATIO = 4.0  # largest ratio to that number
MOST_STEPS = 1 << 14
STOP_FACTOR, HIGHEST_STOP = 4.0, 0.1  # of `stop` for pictures, in which stopped rays are opaque


@checked_fields
@dataclass(frozen=True)
class RayMarching:
    """The default sampler: equal steps, only in occupied voxels, and in pictures only until the ray is opaque.

    Attributes:
        steps: samples along a diameter of the scene's sphere.
        stop: transmittance below which a ray ends, in [0, 1); 0 never stops. With gradients rays end only on a CPU, if
            samples are random.

    Raises:
        ValueError: `stop` out of range.
    """

    steps: Annotated[int, range(1, MOST_STEPS + 1)] = 96
    stop: float = 5e-3

    near_far: ClassVar[str] = "sphere"  # at the intersections with the scene's sphere
    needs_occupancy: ClassVar[bool] = True

    def __post_init__(self) -> None:
        if not 0 <= self.stop < 1:
            raise ValueError(f"stop: expected a transmittance from 0 to below 1, got {self.stop}")

    def for_rendering(self, pixels: float) -> RayMarching:
        """More samples than in training, where they are jittered; rays end sooner, and are then opaque.

        There are 5/3 as many if the scene is 100 pixels across, and they grow with the square root of the pixels: a
        picture of 400 pixels would lose 0.2 dB with as many samples as one of 128.

        Args:
            pixels: along the diameter of the scene's sphere.
        """
        finer = math.sqrt(min(max(pixels / REFERENCE_PIXELS, 1 / MAX_PIXEL_RATIO), MAX_PIXEL_RATIO))
        stop = max(self.stop, min(HIGHEST_STOP, STOP_FACTOR * self.stop))
        return RayMarching(min(MOST_STEPS, round(self.steps * finer * 5 / 3)), stop)

    @property
    def summary(self) -> str:
        """Steps along a diameter."""
        return f"{self.steps} in hull"

    def rays_per_chunk(self, device: torch.device) -> int:
        """So many that a picture has few chunks and packed samples fit into memory; on a CPU, the part of a thread."""
        return 1 << 12 if device.type == "cpu" else 1 << 16

    def place(self, rays: Rays, occupancy: Occupancy | None, generator: torch.Generator | None = None) -> PackedSamples:
        """One sample per step in occupied voxels.

        Args:
            rays: with near and far.
            occupancy: the voxels that are sampled; its sphere determines the length of a step.
            generator: jitters the samples.

        Returns:
            The samples.

        Raises:
            ValueError: no occupancy.
        """
        if occupancy is None:
            raise ValueError(
                "occupancy: expected an Occupancy for RayMarching sampling, got None; geometry.full makes one"
            )
        return march(rays, occupancy, 2 * occupancy.bounds.radius / self.steps, generator)

    def refine(
        self, rays: Rays, samples: DenseSamples, weights: Tensor, generator: torch.Generator | None = None
    ) -> None:
        """None: the first samples are final."""


@torch.no_grad()
def march(rays: Rays, occupancy: Occupancy, step: float, generator: torch.Generator | None = None) -> PackedSamples:
    """One sample every `step` along each ray, in the middle of the step, in occupied voxels.

    Args:
        rays: those with near >= far have no samples.
        occupancy: the voxels that are sampled.
        step: distance between samples in world units.
        generator: shifts the samples of each ray by a random fraction of a step; on the CPU.

    Returns:
        The samples in occupied voxels.

    Raises:
        ValueError: near and far, or a step, that are not finite, or a step of 0.
    """
    longest = float((rays.far - rays.near).max()) if len(rays) else 0.0
    if not math.isfinite(longest):
        raise ValueError(f"rays: expected finite near and far, got some that are {longest} long")
    if not 0 < step < math.inf:
        raise ValueError(f"step: expected more than 0 and finite, got {step}")
    offset = torch.full((len(rays),), 0.5, dtype=rays.near.dtype)
    if generator is not None:
        offset = torch.rand(len(rays), generator=generator, dtype=rays.near.dtype)
    start = rays.near + offset.to(rays.near) * step
    walk = _walk_compiled if _has_kernel(rays) else _walk_torch
    # a ray may be far longer than its part in the cube, which is no longer than the diagonal
    longest = min(longest, 2 * _half_diagonal(occupancy) + 2 * step)
    return PackedSamples(*walk(rays, start, occupancy, step, max(0, int(longest / step)) + 1), step)


def _half_diagonal(occupancy: Occupancy) -> float:
    """Radius of the sphere around the cube of a grid."""
    return math.sqrt(3) * occupancy.bounds.radius


def _has_kernel(rays: Rays) -> bool:
    """Whether the kernel supports these rays."""
    kind = rays.near.dtype in (torch.float32, torch.float64) and rays.near.device.type == "cpu"
    return kind and bool(find_spec("numba")) and are_plain(rays.origins)


def _walk_compiled(
    rays: Rays, start: Tensor, occupancy: Occupancy, step: float, count: int
) -> tuple[Int[Tensor, " sample"], Float[Tensor, " sample"]]:
    """The ray indices and the distances of samples, at most `count` a ray, by the compiled kernel."""
    origins, directions, first, far = (
        each.detach().contiguous().numpy() for each in (rays.origins, rays.directions, start, rays.far)
    )
    number, bounds = first.dtype.type, occupancy.bounds
    sphere, box = np.array([*bounds.centre, bounds.radius], number), np.array(occupancy.box, number)
    occupied = occupancy.occupied.contiguous()
    kernel = compile_kernel("voxels.marching.march", start.dtype)

    def part(begin: int, end: int) -> tuple[Tensor, Tensor]:
        room, found = (end - begin) * (count + 1), np.zeros(1, np.int64)
        ray, distances = np.empty(room, np.int64), np.empty(room, number)
        arrays = (sphere, box, occupied.numpy().view(np.uint8), ray, distances, found)
        kernel(origins, directions, first, far, number(step), *arrays, begin, end)
        return torch.from_numpy(ray[: found[0]].copy()), torch.from_numpy(distances[: found[0]].copy())

    parts = parallel_for(part, len(rays), max(1, min(RAY_CHUNK, CANDIDATES // count)))
    if not parts:
        return start.new_zeros(0, dtype=torch.long), start.new_zeros(0)
    ray, distances = (torch.cat(each) for each in zip(*parts, strict=True))
    return ray, distances


def _walk_torch(
    rays: Rays, start: Tensor, occupancy: Occupancy, step: float, count: int
) -> tuple[Int[Tensor, " sample"], Float[Tensor, " sample"]]:
    """The ray indices and the distances of samples, at most `count` a ray, in PyTorch."""
    steps = torch.arange(count, dtype=start.dtype, device=start.device) * step
    # without the steps before each ray reaches the sphere around the cube
    middle = ((rays.origins.new_tensor(occupancy.bounds.centre) - rays.origins) * rays.directions).sum(-1)
    start = start + ((middle - _half_diagonal(occupancy) - start) / step).floor().clamp_min(0) * step
    rows, distances = [start.new_zeros(0, dtype=torch.long)], [start.new_zeros(0)]
    for first in range(0, len(rays), max(1, CANDIDATES // count)):
        part = rays[first : first + max(1, CANDIDATES // count)]
        t = start[first : first + len(part), None] + steps
        live = occupancy.contains(part.at(t)) & (t < part.far[:, None])
        ray, index = live.nonzero().unbind(1)
        rows.append(ray + first)
        distances.append(t[ray, index])
    return torch.cat(rows), torch.cat(distances)
