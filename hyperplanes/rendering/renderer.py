"""Renders rays or cameras of a field, which is any callable (points, directions) -> (colour, density)."""

from __future__ import annotations

from collections.abc import Generator
from contextlib import contextmanager
from itertools import pairwise
from typing import TypedDict, Unpack, overload

import torch
from kornia.geometry.camera import PinholeCamera

from hyperplanes.geometry.kernels.threads import parallel_map
from hyperplanes.geometry.occupancy import Occupancy, full
from hyperplanes.geometry.poses import Count
from hyperplanes.geometry.rays import Rays, Sphere
from hyperplanes.rendering.compositing import Rendered
from hyperplanes.rendering.footprint import pixels_across
from hyperplanes.rendering.images import Pictures, render_images
from hyperplanes.rendering.integration import integrate
from hyperplanes.rendering.sampling.hierarchical import Hierarchical
from hyperplanes.rendering.sampling.marching import RayMarching
from hyperplanes.rendering.sampling.samplers import Sampler
from hyperplanes.rendering.scene import FieldFunction, Scene
from hyperplanes.utilities.machine.locks import ForkSafeLock
from hyperplanes.utilities.messages.arguments import checked

__all__ = ["FieldFunction", "Hierarchical", "RayMarching", "Sampler", "allow_tf32", "render"]

MIN_CHUNK_DIVISOR = 16  # a chunk is divided by this for the least number of rays that is worth a second thread


class _Options(TypedDict, total=False):
    bounds: Sphere | None
    occupancy: Occupancy | None
    proposal: FieldFunction | None
    generator: torch.Generator | None
    background: float
    differentiable: bool | None
    chunk: int | None
    antialias: bool | None


@overload
def render(
    field: FieldFunction, target: PinholeCamera, sampling: Sampler | None = None, **options: Unpack[_Options]
) -> Pictures: ...


@overload
def render(
    field: FieldFunction, target: Rays, sampling: Sampler | None = None, **options: Unpack[_Options]
) -> Rendered: ...


@checked
def render(
    field: FieldFunction,
    target: PinholeCamera | Rays,
    sampling: Sampler | None = None,
    *,
    bounds: Sphere | None = None,
    occupancy: Occupancy | None = None,
    proposal: FieldFunction | None = None,
    generator: torch.Generator | None = None,
    background: float = 1.0,
    differentiable: bool | None = None,
    chunk: Count | None = None,
    antialias: bool | None = None,
) -> Pictures | Rendered:
    """The pictures that cameras take of a field, or the pixels of single rays.

    Args:
        field: any callable: world points (n, 3) and unit viewing directions (n, 3) -> colours (n, 3) in [0, 1] and
            densities (n,) per world unit.
        target: Kornia cameras of one image size, or rays.
        sampling: where along the rays the field is evaluated. The default for cameras is `RayMarching` with samples for
            pictures; for rays it is `RayMarching` with bounds or an occupancy, otherwise `Hierarchical`, which needs
            neither.
        bounds: the sphere of the scene. Cameras see what lies in it; rays have their own near and far, between which
            `RayMarching` takes samples in the cube around the sphere. By default that of the occupancy or, for cameras
            without one, the unit sphere.
        occupancy: voxels outside of which the field is empty, for `RayMarching`; by default all within the bounds.
        proposal: the field of the coarse pass of `Hierarchical`; by default `field`. `RayMarching` evaluates it only
            for gradients, so that it learns.
        generator: jitters the samples; on the CPU. Without one, they are the same each time. With gradients,
            `RayMarching` with `stop` above 0 also uses it to draw the samples that have gradients. Such gradients are
            unbiased estimates; second derivatives of them are not.
        background: grey value behind everything.
        differentiable: whether to keep gradients with respect to whatever the field and the rays depend on; by default
            for rays, but not for cameras. Without gradients, rays are rendered in chunks, so that memory does not grow
            with their number, and `RayMarching` ends rays where they are opaque. Distances of its samples along the
            rays are constants: gradients with respect to cameras are exact for fields that vanish at the sphere, and
            otherwise leave out how the sphere clips them.
        chunk: rays rendered at once without gradients; the default suits the sampler and the device.
        antialias: for cameras, five rays through each pixel that differs much from a neighbour; by default for
            `RayMarching` without gradients. The paper's protocol is one ray per pixel.

    Returns:
        Pictures of cameras, or pixels of rays. Raises ValueError for rays with `RayMarching` but without occupancy and
        bounds, and for fields with values of another shape.

    >>> from hyperplanes.geometry.cameras import look_at, pinhole, symmetric_intrinsics
    >>> camera = pinhole(symmetric_intrinsics(5, 5, 0.7), look_at(torch.tensor([[0.0, 0.0, 3.0]])), 5, 5)
    >>> fog = render(lambda points, _: (torch.zeros_like(points), torch.ones(len(points))), camera)
    >>> round(fog.opacity[0, 0, 2, 2].item(), 3)  # 1 - exp(-2): the diameter of the unit sphere
    0.865
    """
    bounds = bounds or (occupancy.bounds if occupancy else None)
    if isinstance(target, PinholeCamera):
        bounds = bounds or Sphere()
        sampling = sampling or RayMarching().for_rendering(pixels_across(target, bounds))
    sampling = sampling or (RayMarching() if bounds else Hierarchical())
    device = target.origins.device if isinstance(target, Rays) else target.intrinsics.device
    if sampling.needs_occupancy and occupancy is None and bounds is not None:
        occupancy = full(bounds, 1, device)
    keep = isinstance(target, Rays) if differentiable is None else differentiable

    scene = Scene(field, occupancy, proposal, background)

    def render_rays(rays: Rays) -> Rendered:
        if keep:
            return integrate(scene, rays, sampling, generator, differentiable=True)
        return _in_chunks(scene, rays, sampling, generator, chunk)

    if isinstance(target, Rays):
        return render_rays(target)
    assert bounds is not None
    with torch.set_grad_enabled(keep and torch.is_grad_enabled()):
        seen = occupancy if sampling.needs_occupancy else None
        return render_images(
            target, bounds, render_rays, occupancy=seen, near_far=sampling.near_far, background=background,
            antialias=sampling.needs_occupancy and not keep if antialias is None else antialias,
        )  # fmt: skip


@torch.no_grad()
def _in_chunks(
    scene: Scene, rays: Rays, sampler: Sampler, generator: torch.Generator | None, chunk: int | None
) -> Rendered:
    """The pixels of rays without gradients, in chunks."""
    size = chunk or sampler.rays_per_chunk(rays.origins.device)
    with allow_tf32(rays.origins.device):
        on_cpu = rays.origins.device.type == "cpu"
        alone = generator is not None or not on_cpu or not scene.is_thread_safe
        parts = [rays[first:last] for first, last in pairwise(_bounds(len(rays), size, even=on_cpu))]
        run = map if alone else parallel_map
        return _joined(list(run(lambda part: integrate(scene, part, sampler, generator, differentiable=False), parts)))


def _bounds(total: int, size: int, even: bool = True) -> list[int]:
    """Boundaries of equal parts of at most `size`, `even` in number for two threads.

    >>> _bounds(10, 4), _bounds(2, 64), _bounds(0, 4)
    ([0, 3, 5, 8, 10], [0, 2], [0, 0])
    """
    count = max(1, -(-total // size))
    count += count % 2 if even and total > size // MIN_CHUNK_DIVISOR else 0
    return [-(-part * total // count) for part in range(count + 1)]


def _joined(parts: list[Rendered]) -> Rendered:
    """Concatenates pixels."""
    coarse = [each.coarse for each in parts if each.coarse is not None]
    return Rendered(
        torch.cat([each.colour for each in parts]),
        torch.cat([each.opacity for each in parts]),
        torch.cat([each.depth for each in parts]),
        sum(each.samples for each in parts),
        _joined(coarse) if coarse else None,
    )


@contextmanager
def allow_tf32(device: torch.device) -> Generator[None]:
    """On a GPU, float32 matrix products in TF32 (10 bits of mantissa, tensor cores) while the context lasts.

    Pictures of the paper's networks are within 0.001 dB of those in full single precision. The setting of PyTorch is
    for the whole process: of several contexts, the last one to end restores the setting before the first.
    """
    if device.type != "cuda":
        yield
        return
    with _counting:
        if not _precisions:
            _precisions.append(torch.get_float32_matmul_precision())
            torch.set_float32_matmul_precision("high")
        else:
            _precisions.append(_precisions[0])
    try:
        yield
    finally:
        with _counting:
            before = _precisions.pop()
            if not _precisions:
                torch.set_float32_matmul_precision(before)


_precisions: list[str] = []
"""The setting before the first active context of `allow_tf32`, once for each active context."""

_counting = ForkSafeLock()
