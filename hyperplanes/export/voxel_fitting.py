"""Baked voxels fitted to posed images by gradient descent on their densities and coefficients of colour."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import torch

from hyperplanes.export.baking import BakedScene
from hyperplanes.fields.baked import BakedField, spherical_harmonics
from hyperplanes.rendering.voxels import voxel_gradients
from hyperplanes.views import Views

__all__ = ["STEPS", "fit_voxels"]

STEPS = 80
RAYS = 8192
DENSITY_RATE = 0.05  # of optical depth through a voxel
COLOUR_RATE = 0.01
DECAY = 0.1  # of both rates, from the first step to the last
STEPS_A_DIAMETER = 256
SMALLEST_DEPTH = 1e-4  # of a voxel: colour has no gradient where density is zero


def fit_voxels(
    baked: BakedField,
    views: Views,
    *,
    steps: int = STEPS,
    rays: int = RAYS,
    seed: int = 0,
    on_step: Callable[[int], None] | None = None,
) -> BakedField:
    """The voxels after gradient steps (Adam) on the squared error of rays of the views.

    A field loses 1 to 3 dB by being baked, since voxels interpolate what a network and lookups computed; fitting the
    voxels brings them back, and more with 25 views. No voxel is added or taken away.

    Args:
        baked: where it starts; on the CPU.
        views: posed images of the object, on any device.
        steps: gradient steps.
        rays: of each step, drawn from all views; no more than there are pixels that show something.
        seed: of the rays.
        on_step: told the number of steps done.

    Returns:
        Voxels at the same places.
    """
    views = views.to("cpu", torch.float32)
    scene, voxel = BakedScene(baked, STEPS_A_DIAMETER), 2 * baked.bounds.radius / baked.side
    views = replace(views, bounds=baked.bounds)
    live = scene.footprint(views.cameras).flatten().nonzero()[:, 0]
    if not len(live):
        return baked
    rays = min(rays, len(live))
    # optical depth of a voxel and coefficients, each with its own rate
    depth, colour = (baked.values[:, :1] * voxel).clamp_min(SMALLEST_DEPTH), baked.values[:, 1:].clone()
    groups = [{"params": [depth], "lr": DENSITY_RATE}, {"params": [colour], "lr": COLOUR_RATE}]
    descent = torch.optim.Adam(groups, betas=(0.9, 0.99), fused=True)
    schedule = torch.optim.lr_scheduler.ExponentialLR(descent, DECAY ** (1 / max(1, steps)))
    generator, step_length = torch.Generator().manual_seed(seed), 2 * baked.bounds.radius / STEPS_A_DIAMETER
    for step in range(steps):
        # squared error of some rays, and its gradient by the kernel
        drawn, truth = views.sample_rays(rays, generator=generator, among=live)
        values, basis = torch.cat([depth / voxel, colour], 1), spherical_harmonics(drawn.directions)
        _, gradient = voxel_gradients(
            baked.index, values, baked.bounds, drawn, basis, truth, step=step_length, empty=scene.distances
        )
        depth.grad, colour.grad = gradient[:, :1] / voxel, gradient[:, 1:].contiguous()
        descent.step()
        schedule.step()
        depth.clamp_(min=SMALLEST_DEPTH)
        if on_step:
            on_step(step + 1)
    return replace(baked, values=torch.cat([depth / voxel, colour], 1))
