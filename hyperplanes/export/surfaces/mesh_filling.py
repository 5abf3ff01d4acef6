"""Filling of regions that no camera sees into, so that the surface closes around them.

A part of a field is opaque by high density, or by low density over a long distance. A level of density finds the
first, `fill_hidden` the second. Without it, foggy walls, as in fields of one forward pass, would be holes.
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from kornia.geometry.camera import PinholeCamera
from torch import Tensor
from torch.nn.functional import grid_sample

from hyperplanes.geometry import cameras as camera
from hyperplanes.geometry.rays import Sphere, cast, pixel_grid

__all__ = ["fill_hidden"]

OCCLUDING_OPACITY = 0.35
"""Opacity in front of a point from which on a camera does not see it. The camera with the clearest view decides, so 0.5
leaves dents in foggy walls. Of two cars after one forward pass, seen from seven places, 94.0 % of the pixels had the
rendered depth, 94 % with 0.5, 90 % with 0.2, and 93 % by a level alone, which left holes; a chair that was fine-tuned
for 60 steps did not change (94.6 %)."""


@torch.no_grad()
def fill_hidden(
    density: Float[Tensor, "x y z"], level: float, bounds: Sphere, cameras: PinholeCamera
) -> Float[Tensor, "x y z"]:
    """The density, raised to the level and above where no camera sees.

    Args:
        density: of `density_grid`.
        level: of the surface to extract.
        bounds: the sphere inside the grid's cube.
        cameras: all are used; places outside all images do not change.

    Returns:
        A grid that exceeds the level where the density does, or where the opacity in front of the place exceeds
        OCCLUDING_OPACITY for every camera that has it in its image.
    """
    side = len(density)
    live = density.nonzero()
    if not len(live):
        return density
    low, high = (live.amin(0) - 1).clamp_min(0), (live.amax(0) + 2).clamp_max(side)
    box = tuple(slice(int(first), int(last)) for first, last in zip(low, high, strict=True))
    axis = torch.linspace(-1, 1, side, device=density.device)
    unit = torch.stack(torch.meshgrid(*(axis[part] for part in box), indexing="ij"), -1)
    points = (unit * bounds.radius + unit.new_tensor(bounds.centre)).reshape(-1, 3)
    least = points.new_full((len(points),), math.inf)
    cameras = camera.to(cameras, points.device, torch.float32)
    for view in range(cameras.batch_size):
        least = torch.minimum(least, _opacity_before(points, density, bounds, camera.select(cameras, [view])))
    hidden = torch.where(least.isfinite(), least, 0.0).reshape(unit.shape[:3])
    filled = density.clone()
    filled[box] = torch.maximum(density[box], level * (hidden / OCCLUDING_OPACITY).clamp_max(2))
    return filled


def _opacity_before(
    points: Float[Tensor, "point 3"], density: Tensor, bounds: Sphere, cameras: PinholeCamera
) -> Float[Tensor, " point"]:
    """The opacity between one camera and each point, infinite where the point is not in its image.

    Integrated along rays through a grid of pixels, half as fine as that of the density, and interpolated between them.
    """
    height, width = camera.image_size(cameras)
    offsets = points - camera.centres(cameras)
    distances = offsets.norm(dim=-1)
    pixels = cameras.project(points[None])[0]
    inside = ((pixels > -0.5) & (pixels < pixels.new_tensor([width, height]) - 0.5)).all(-1)
    seen = (offsets @ camera.viewing_directions(cameras)[0] > 0) & inside
    if seen.sum() < 2:
        return torch.full_like(distances, math.inf)
    first, last = pixels[seen].amin(0), pixels[seen].amax(0)
    near, far = float(distances[seen].min()), float(distances[seen].max())
    side, voxel = len(density) // 2, 2 * bounds.radius / (len(density) - 1)
    through = first + pixel_grid(side, side, points.device) / (side - 1) * (last - first)
    along = torch.linspace(near, far, math.ceil((far - near) / voxel) + 2, device=points.device)
    rays = cast(cameras, torch.zeros(len(through), dtype=torch.long, device=points.device), through)
    values = []
    for part in range(0, len(rays), side):  # one row of pixels at a time
        places = bounds.normalise(rays[part : part + side].at(along.expand(side, -1)))
        values.append(grid_sample(density[None, None], places.flip(-1)[None, None], align_corners=True)[0, 0, 0])
    values = torch.cat(values)
    depth = (values.cumsum(-1) - values / 2) * ((far - near) / (len(along) - 1))
    opacity = (1 - torch.exp(-depth)).reshape(side, side, -1)
    wanted = torch.cat([((distances - near) / (far - near))[:, None], (pixels - first) / (last - first)], 1) * 2 - 1
    found = grid_sample(opacity[None, None], wanted[None, None, None], align_corners=True)[0, 0, 0, 0]
    return torch.where(seen, found, math.inf)
