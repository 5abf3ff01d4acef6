"""Masks for photographs: the object in the sphere of a scene is separated from its background by fitting both.

Two grids of density and colour are optimised together on rays of all views: one inside the sphere, and one for
everything outside, up to infinity, in the contracted space of Barron et al. 2022 ("Mip-NeRF 360"). Each ray is
composited through both. The opacity of the inner grid is the mask.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import interpolate, softplus

from hyperplanes.geometry import cameras as camera
from hyperplanes.geometry.distortion import DistortedCamera
from hyperplanes.geometry.rays import Rays, Sphere, cast, pixel_grid
from hyperplanes.geometry.volume import interpolate_grid, resampled_grid
from hyperplanes.utilities.tensors.gradients import with_gradients
from hyperplanes.utilities.tensors.precision import without_autocast
from hyperplanes.utilities.tensors.uncompiled_optimisers import Adam
from hyperplanes.views import Views

__all__ = ["FEWEST_VIEWS", "Separated", "separate_background"]

LEVELS = ((64, 24, 32, 100), (128, 48, 64, 120), (192, 80, 96, 120))
"""Pixels along the longer side of the pictures, cells of the inner and of the outer grid along an axis, and steps."""

FEWEST_VIEWS = 5
RAYS_PER_STEP = 1024
RATE, LAST_RATE = 0.2, 0.02  # of Adam
THIN = -4.0  # initial value of both grids, before softplus: optical depth of a cell
SAMPLES_PER_CELL = 1.5  # inside the sphere, per cell of its grid along an axis
BEFORE, BEHIND = 12, 64  # samples in front of the sphere and beyond it
NEAR_SHARE = 0.1  # where samples of a ray that misses the sphere begin: fraction of the distance to its closest point
FAR_SHARE = 0.97  # where samples end: fraction of the way to infinity, in disparity
BINARY_LOSS_WEIGHT = 0.02  # weight of the loss on opacities between 0 and 1
BINARY_LOSS_START = 0.3  # fraction of the steps after which that loss is used
MASK_SIZE = 256  # along the longer side of the masks, before they are enlarged
SHARPENED = 4.0  # slope of a mask as a function of opacity, so that soft borders do not count as the object
RAYS_AT_ONCE = 1 << 13

Grid = Float[Tensor, "channel x y z"]


@dataclass(frozen=True)
class Separated:
    """An object and its background.

    Attributes:
        inner: in the sphere, density before softplus, as optical depth of a cell, and colour before the sigmoid.
        outer: the same for everything outside, contracted to a ball of twice the radius.
        bounds: the sphere.
    """

    inner: Grid
    outer: Grid
    bounds: Sphere

    @without_autocast
    @torch.no_grad()
    def render(self, cameras: camera.PinholeCamera) -> tuple[Float[Tensor, "view 3 height width"], Tensor]:
        """Pictures of both, and the opacity of the object, (view, 1, height, width), in single precision.

        Args:
            cameras: any number, one image size, in any precision.
        """
        height, width = camera.image_size(cameras)
        cameras = camera.to(cameras, self.inner.device, self.inner.dtype)
        pixels, views = pixel_grid(height, width), []
        for view in range(cameras.batch_size):
            parts = []
            for some in pixels.split(RAYS_AT_ONCE):
                rays = cast(cameras, torch.full((len(some),), view), some, self.bounds)
                parts.append(torch.cat(_composited(self.inner, self.outer, rays, self.bounds), 1))
            views.append(torch.cat(parts).T.reshape(4, height, width))
        found = torch.stack(views)
        return found[:, :3], found[:, 3:]

    def cut_out(self, views: Views) -> Views:
        """Views with masks of the object, composited over white.

        Args:
            views: photographs of the fitted scene.
        """
        _, opacity = self.render(views.resized(MASK_SIZE).to("cpu", torch.float32).cameras)
        opacity = interpolate(opacity, views.size, mode="bilinear").to(views.images)
        masks = (SHARPENED * (opacity - 0.5) + 0.5).clamp(0, 1)
        return replace(views, images=views.images * masks + (1 - masks), masks=masks)


@without_autocast
@with_gradients
def separate_background(views: Views, *, on_step: Callable[[int, int], None] | None = None) -> Separated:
    """Fits the object within the bounds of some views, and its background.

    Inside `torch.inference_mode` it raises RuntimeError.

    Args:
        views: photographs without masks, and without lens distortion.
        on_step: called with the number of steps done and the total.

    Raises:
        ValueError: fewer than five views, or cameras with lens distortion.
    """
    if len(views) < FEWEST_VIEWS or isinstance(views.cameras, DistortedCamera):
        found = f"{len(views)}" + (" with lens distortion" if isinstance(views.cameras, DistortedCamera) else "")
        raise ValueError(f"views: expected at least {FEWEST_VIEWS} without lens distortion, got {found}")
    views = replace(views.to("cpu", torch.float32), masks=None)
    generator = torch.Generator().manual_seed(0)
    inner, outer = (torch.zeros(4, 8, 8, 8) for _ in range(2))
    inner[0] = outer[0] = THIN
    done, total = 0, sum(level[-1] for level in LEVELS)
    for pixels, *sides, steps in LEVELS:
        # the same grids with smaller cells, and larger pictures
        small = views.resized(pixels)
        inner, outer = (
            resampled_grid(grid.detach(), side).requires_grad_(True)  # the optical depth per cell is kept
            for grid, side in zip((inner, outer), sides, strict=True)
        )
        descent = Adam([inner, outer], lr=RATE, betas=(0.9, 0.99))
        for _ in range(steps):
            descent.param_groups[0]["lr"] = RATE * (LAST_RATE / RATE) ** (done / total)
            # squared error of random rays; opacities between 0 and 1 are penalised once there is a shape
            rays, truth = small.sample_rays(RAYS_PER_STEP, generator=generator)
            colour, opacity = _composited(inner, outer, rays, views.bounds, generator)
            loss = (colour - truth).square().mean()
            if done > BINARY_LOSS_START * total:
                loss = loss + BINARY_LOSS_WEIGHT * (opacity * (1 - opacity)).mean()
            descent.zero_grad()
            loss.backward()
            descent.step()
            done += 1
            if on_step is not None:
                on_step(done, total)
    return Separated(inner.detach(), outer.detach(), views.bounds)


def _composited(
    inner: Grid, outer: Grid, rays: Rays, bounds: Sphere, generator: torch.Generator | None = None
) -> tuple[Float[Tensor, "ray 3"], Float[Tensor, "ray 1"]]:
    """Colours of rays through both grids, and the opacity of the inner one."""
    count = int(SAMPLES_PER_CELL * inner.shape[1])

    def samples(number: int) -> Tensor:
        """One in each of `number` equal intervals of [0, 1], (ray, sample)."""
        jitter = 0.5 if generator is None else torch.rand(len(rays), number, generator=generator)
        return (torch.arange(number) + jitter).expand(len(rays), -1) / number

    # distances: in front of the sphere, inside it, and beyond it at equal steps in disparity
    near, far = rays.near[:, None], rays.far[:, None]
    start = torch.where(far > near, (near - bounds.radius).clamp_min(0.0), NEAR_SHARE * near)
    around = torch.cat(
        [start + (near - start) * samples(BEFORE), far + bounds.radius * (1 / (1 - FAR_SHARE * samples(BEHIND)) - 1)], 1
    )
    within = near + (far - near) * samples(count)
    # optical depth and colour there
    cells = ((far - near) / count * inner.shape[1] / (2 * bounds.radius)).expand(-1, count)
    inside = _read(inner, rays.at(within), bounds, cells)
    points = _contracted(rays.at(around), bounds)
    lengths = torch.cat([_lengths(points[:, :BEFORE]), _lengths(points[:, BEFORE:])], 1)
    outside = _read(outer, points, Sphere(radius=2.0), lengths * outer.shape[1] / 4)
    depth, colour = (torch.cat([o[:, :BEFORE], i, o[:, BEFORE:]], 1) for i, o in zip(inside, outside, strict=True))
    # compositing weights; the last sample stands for everything behind it
    light = torch.exp(-torch.cat([torch.zeros_like(near), depth[:, :-1].cumsum(1)], 1))
    weights = light - torch.cat([light[:, 1:], torch.zeros_like(near)], 1)
    return (weights[..., None] * colour).sum(1), weights[:, BEFORE : BEFORE + count].sum(1, keepdim=True)


def _lengths(points: Float[Tensor, "ray sample 3"]) -> Float[Tensor, "ray sample"]:
    """The length of a line that each sample stands for: half of the distance to each of its neighbours."""
    steps = (points[:, 1:] - points[:, :-1]).norm(dim=-1)
    return (torch.cat([steps[:, :1], steps], 1) + torch.cat([steps, steps[:, -1:]], 1)) / 2


def _contracted(points: Float[Tensor, "ray sample 3"], bounds: Sphere) -> Float[Tensor, "ray sample 3"]:
    """Points in units of the sphere; outside of it, distance r becomes 2 - 1 / r."""
    points = bounds.normalise(points)
    distance = points.norm(dim=-1, keepdim=True).clamp_min(1.0)
    return points * (2 - 1 / distance) / distance


def _read(
    grid: Grid, points: Float[Tensor, "ray sample 3"], bounds: Sphere, cells: Float[Tensor, "ray sample"]
) -> tuple[Float[Tensor, "ray sample"], Float[Tensor, "ray sample 3"]]:
    """Optical depth over lengths in cells, and colour."""
    values = interpolate_grid(grid, points.reshape(-1, 3), bounds).reshape(*points.shape[:2], 4)
    return softplus(values[..., 0]) * cells, torch.sigmoid(values[..., 1:])
