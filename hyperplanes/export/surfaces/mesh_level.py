"""Agreement of a field's surfaces with its pictures, and the density level whose surface agrees best."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from kornia.geometry.camera import PinholeCamera
from torch import Tensor
from torch.nn.functional import grid_sample

from hyperplanes.adaptation.base import AdaptedField
from hyperplanes.export.surfaces.mesh import Surface, as_trimesh, distances_to
from hyperplanes.geometry import cameras as camera
from hyperplanes.geometry.rays import Rays, Sphere, cast, pixel_grid
from hyperplanes.utilities.images.sizes import scaled_size

__all__ = ["Agreement", "agreement", "choose_level"]

SILHOUETTE = 64  # pixels along the longer side of the compared silhouettes
LEVEL_VIEWS = 8
LEVEL_CANDIDATES = 60
DEPTH_TOLERANCE = 0.05  # radii of the scene


@torch.no_grad()
def choose_level(field: AdaptedField, density: Float[Tensor, "x y z"], cameras: PinholeCamera) -> float:
    """The density level whose surface agrees best with the rendered silhouettes and depth of the field.

    A ray meets the surface of a level where the density along it first exceeds the level, so one pass over the rays
    tests every level. A fixed level leaves holes in walls that are opaque by thickness, not density; silhouettes alone
    miss holes with a wall behind them.

    Args:
        field: rendered by its own sampler.
        density: of `density_grid`.
        cameras: up to eight of them are used, at 64 pixels.

    Returns:
        Density per world unit: the level with the largest product of overlap and share, as in `Agreement`, of all views
        together.

    Raises:
        ValueError: a field that is empty everywhere.
    """
    top = float(density.max())
    if not top > 0:
        raise ValueError("field: expected some density, got one that is empty everywhere; train longer, or check masks")
    small = _small_cameras(cameras, LEVEL_VIEWS)
    covered, depth = _rendered(field, small)
    bounds, levels = (
        field.occupancy.bounds,
        torch.from_numpy(np.geomspace(top * 1e-4, top * 0.9, LEVEL_CANDIDATES)).float(),
    )
    right, union = torch.zeros(LEVEL_CANDIDATES), torch.zeros(LEVEL_CANDIDATES)
    for view, first in enumerate(_first_crossings(density, levels, bounds, small)):
        seen, wanted = first.isfinite(), covered[view, :, None]
        near = (first - depth[view, :, None]).abs() <= DEPTH_TOLERANCE * bounds.radius
        right += (seen & wanted & near).sum(0)
        union += (seen | wanted).sum(0)
    return float(levels[(right / union.clamp_min(1)).argmax()]) if right.any() else top / 2


@dataclass(frozen=True)
class Agreement:
    """How well a surface agrees with the field's pictures.

    Attributes:
        overlap: intersection over union of the silhouettes, mean over views.
        depth: share of the pixels covered by both at which the surface has the rendered depth, to `DEPTH_TOLERANCE` of
            the scene's radius. Holes that show the far side lower it; 0 where no pixel is covered by both.
    """

    overlap: float
    depth: float


@torch.no_grad()
def agreement(surface: Surface, field: AdaptedField, cameras: PinholeCamera) -> Agreement:
    """Compare a surface with the pictures of the field that it was cut from.

    Args:
        surface: its triangles are ray-cast.
        field: rendered by its own sampler; a pixel counts where it is more than half opaque.
        cameras: all of them, at 64 pixels.

    Returns:
        Both figures, from 0 to 1.
    """
    small = _small_cameras(cameras, cameras.batch_size)
    wanted, depth = _rendered(field, small)
    mesh = as_trimesh(surface.vertices, surface.faces)
    first = torch.stack([distances_to(mesh, rays) for rays in _pixel_rays(small)])
    both, union = first.isfinite() & wanted, (first.isfinite() | wanted).sum(1)
    overlap = torch.where(union > 0, both.sum(1) / union.clamp_min(1), 1.0).mean()
    near = (first - depth)[both].abs() <= DEPTH_TOLERANCE * field.occupancy.bounds.radius
    return Agreement(float(overlap), float(near.float().mean()) if len(near) else 0.0)


def _small_cameras(cameras: PinholeCamera, most: int) -> PinholeCamera:
    """Some of the cameras, spread over all, at SILHOUETTE pixels along the longer side, on the CPU."""
    chosen = torch.linspace(0, cameras.batch_size - 1, min(most, cameras.batch_size)).round().long()
    cameras = camera.to(camera.select(cameras, chosen.to(cameras.extrinsics.device)), "cpu", torch.float32)
    return camera.resized(cameras, *scaled_size(camera.image_size(cameras), SILHOUETTE, enlarge=True))


def _pixel_rays(cameras: PinholeCamera) -> list[Rays]:
    """The rays through all pixels of each view."""
    pixels = pixel_grid(*camera.image_size(cameras))
    return [cast(cameras, torch.full((len(pixels),), view), pixels) for view in range(cameras.batch_size)]


def _rendered(field: AdaptedField, cameras: PinholeCamera) -> tuple[Tensor, Tensor]:
    """Coverage and distance along the rays in a field's pictures; both (view, pixel), on the CPU."""
    pictures = field.render(cameras, antialias=False, mixed_precision=False)
    return pictures.opacity.flatten(1).cpu() > 0.5, pictures.depth.flatten(1).cpu()


def _first_crossings(
    density: Tensor, levels: Tensor, bounds: Sphere, cameras: PinholeCamera
) -> Iterator[Float[Tensor, "pixel level"]]:
    """Where the density along the ray of each pixel first exceeds each level.

    The density is interpolated trilinearly and sampled every half voxel.

    Yields:
        For each view, distances along the rays, infinite where the level is never exceeded.
    """
    along = torch.linspace(-(3**0.5), 3**0.5, 2 * len(density), device=density.device)
    for rays in _pixel_rays(cameras):
        start, directions = (part.to(density.device) for part in (bounds.normalise(rays.origins), rays.directions))
        distance = along - (start * directions).sum(-1, keepdim=True)
        points = start[:, None] + distance[..., None] * directions[:, None]
        values = grid_sample(density[None, None], points.flip(-1)[None, None], align_corners=True)[0, 0, 0]
        wanted = levels.to(values).expand(len(values), -1).contiguous()
        index = torch.searchsorted(values.cummax(-1).values, wanted, right=True)
        distance = torch.cat([distance * bounds.radius, distance.new_full((len(distance), 1), math.inf)], 1)
        yield distance.gather(1, index).cpu()
