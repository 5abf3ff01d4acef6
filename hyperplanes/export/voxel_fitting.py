"""Fitting of baked voxels to posed images by gradient descent on densities and colour coefficients."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Int
from torch import Tensor

from hyperplanes.adaptation.base import AdaptedField
from hyperplanes.export.baking import BakedScene
from hyperplanes.fields.baked import BakedField, spherical_harmonics
from hyperplanes.geometry import cameras as camera
from hyperplanes.geometry.rays import Rays, join_rays
from hyperplanes.rendering.images import EDGE_SUBPIXELS, pixels_at_edges
from hyperplanes.rendering.voxels import voxel_gradients
from hyperplanes.utilities.tensors.uncompiled_optimisers import Adam
from hyperplanes.views import Views

__all__ = ["VOXEL_STEPS", "fit_voxels", "render_guide"]

VOXEL_STEPS = 100
PIXELS_PER_STEP = 8192
# difference of neighbouring pixels in colour or mask from which on a pixel is the mean of five rays
EDGE_THRESHOLD = 0.25
DENSITY_RATE = 0.05  # of optical depth through a voxel
COLOUR_RATE = 0.01
DECAY = 0.1  # factor of both rates from the first step to the last
STOP_TRANSMITTANCE = 0.01  # transmittance below which a ray ends: gradients behind are negligible
SMALLEST_DEPTH = 1e-4  # of a voxel: colour has no gradient where density is zero
LARGEST_DEPTH = 0.7  # of a voxel at first: an opaque one hides those behind it and has no gradient itself
MIN_UNGUIDED_VIEWS = 16  # number of views from which on voxels are fitted without a guide


def render_guide(
    source: AdaptedField | BakedScene, views: Views, *, size: tuple[int, int] | None = None
) -> Views | None:
    """Renderings from all around the object that guide `fit_voxels` and `fit_splats` where there are few views.

    Fitted to a few views alone, voxels overfit. Two chairs have 20.6 dB as baked from three views, 18.7 fitted, 20.5
    with the guide (`python -m benchmarks baked --data data/chairs --counts 3 --objects 2 --query 4`).

    Args:
        source: the field that voxels were baked from, or the voxels that splats are made of.
        views: the support views.
        size: height and width of the renderings; half those of the views where absent, but `fit_splats` needs
            `views.size`.

    Returns:
        Sixteen views, as far from the object as the given ones on average; None where these are sixteen or more.
    """
    if len(views) >= MIN_UNGUIDED_VIEWS:
        return None
    bounds = source.occupancy.bounds if isinstance(source, AdaptedField) else source.field.bounds
    centre = torch.tensor(bounds.centre)
    distance = (camera.centres(views.cameras).cpu().float() - centre).norm(dim=1).mean()
    eyes = centre + distance * camera.fibonacci_sphere(MIN_UNGUIDED_VIEWS, 1.0)[:, 2, :3]
    matrix = camera.intrinsics(views.cameras)[:1].cpu().float().expand(MIN_UNGUIDED_VIEWS, 3, 3)
    around = camera.pinhole(matrix, camera.look_at(eyes, bounds.centre), *views.size)
    height, width = size or (max(8, side // 2) for side in views.size)
    around = camera.resized(around, height, width)
    if isinstance(source, AdaptedField):
        pictures = source.render(around, mixed_precision=False)
    else:
        pictures = source.render(around)
    return Views(pictures.images.clamp(0, 1).cpu(), around, bounds=bounds)


def fit_voxels(
    baked: BakedField,
    views: Views,
    *,
    guide: Views | None = None,
    steps: int = VOXEL_STEPS,
    pixels: int = PIXELS_PER_STEP,
    on_step: Callable[[int], None] | None = None,
) -> BakedField:
    """The voxels after gradient steps (Adam) on the squared error of pixels of the views.

    Baking costs a field 1 to 3 dB, since voxels interpolate what a network and lookups computed; fitting the voxels
    recovers them, and more with 25 views. Pixels at edges are the mean of five rays, as in rendering: with one ray a
    pixel, surfaces become soft. No voxel is added or removed. Fitting begins with an optical depth of at most
    LARGEST_DEPTH a voxel. For measurements of both see docs/benchmarks.md, "Baked voxels".

    Args:
        baked: the initial voxels, on the CPU.
        views: posed images of the object, on any device.
        guide: renderings of the field from other places, by `render_guide`; the fewer views, the more of its pixels are
            drawn.
        steps: gradient steps.
        pixels: per step, drawn from all views; at most those that may show a voxel.
        on_step: called with the number of steps done.

    Returns:
        The same voxels with fitted values.
    """
    scene, voxel = BakedScene(baked), 2 * baked.bounds.radius / baked.side
    share = max(0.0, 1 - len(views) / MIN_UNGUIDED_VIEWS) if guide is not None else 0.0
    sources = [_Source.of(views, scene, pixels, 1 - share)]
    if guide is not None and share:
        sources.append(_Source.of(guide, scene, pixels, share))
    if not steps or not sum(source.pixels for source in sources):
        return baked
    # optical depths of voxels and coefficients, each with its own learning rate
    depth, colour = (baked.values[:, :1] * voxel).clamp(SMALLEST_DEPTH, LARGEST_DEPTH), baked.values[:, 1:].clone()
    groups = [{"params": [depth], "lr": DENSITY_RATE}, {"params": [colour], "lr": COLOUR_RATE}]
    descent = Adam(groups, betas=(0.9, 0.99), fused=True)
    schedule = torch.optim.lr_scheduler.ExponentialLR(descent, DECAY ** (1 / steps))
    # reused by the kernel: allocating memory in each step would take longer than filling it
    values, gradients = baked.values.clone(), torch.empty(torch.get_num_threads(), *baked.values.shape)
    depth.grad, colour.grad = torch.zeros_like(depth), torch.zeros_like(colour)
    generator = torch.Generator().manual_seed(0)
    for step in range(steps):
        # gradient of the squared error of some rays, by the kernel
        drawn, truth, counts = _draw(sources, generator)
        values[:, :1], values[:, 1:], basis = depth / voxel, colour, spherical_harmonics(drawn.directions)
        _, gradient = voxel_gradients(
            scene.grid, values, drawn, basis, truth, step=voxel, counts=counts, out=gradients, stop=STOP_TRANSMITTANCE
        )
        depth.grad.copy_(gradient[:, :1] / voxel)
        colour.grad.copy_(gradient[:, 1:])
        descent.step()
        schedule.step()
        depth.clamp_(min=SMALLEST_DEPTH)
        if on_step:
            on_step(step + 1)
    return replace(baked, values=torch.cat([depth / voxel, colour], 1))


@dataclass(frozen=True)
class _Source:
    """Views, the pixels that may show a voxel, which of these lie at edges, and how many are drawn per step."""

    views: Views
    live: Int[Tensor, " pixel"]
    at_edge: Bool[Tensor, " pixel"]
    pixels: int

    @classmethod
    def of(cls, views: Views, scene: BakedScene, pixels: int, share: float) -> _Source:
        """Draw a share of the pixels per step, at most those that may show a voxel."""
        views = replace(views.to("cpu", torch.float32), bounds=scene.field.bounds)
        live = scene.footprint(views.cameras).flatten().nonzero()[:, 0]
        seen = views.images if views.masks is None else torch.cat([views.images, views.masks], 1)
        at_edge = pixels_at_edges(seen.permute(0, 2, 3, 1), EDGE_THRESHOLD).flatten()[live]
        return cls(views, live, at_edge, min(round(share * pixels), len(live)))

    def draw(self, generator: torch.Generator) -> tuple[Rays, Tensor, Tensor]:
        """Rays of random pixels, pixel by pixel, the pixels' true colours, and their numbers of rays."""
        drawn = torch.randint(len(self.live), (self.pixels,), generator=generator)
        at_edge = self.at_edge[drawn]
        counts = torch.where(at_edge, len(EDGE_SUBPIXELS), 1)
        # one ray through each centre, and one through each other subpixel of pixels at edges
        centre, truth, _ = self.views.rays_at(self.live[drawn])
        others, _, _ = self.views.rays_at(self.live[drawn[at_edge]], subpixels=EDGE_SUBPIXELS[1:])
        pixel = torch.arange(len(drawn))
        order = torch.cat([pixel, pixel[at_edge].repeat(len(EDGE_SUBPIXELS) - 1)]).argsort(stable=True)
        return join_rays(centre, others)[order], truth, counts


def _draw(sources: Sequence[_Source], generator: torch.Generator) -> tuple[Rays, Tensor, Tensor]:
    """`_Source.draw` for all sources."""
    rays, truth, counts = zip(*(source.draw(generator) for source in sources if source.pixels), strict=True)
    return join_rays(*rays), torch.cat(truth), torch.cat(counts)
