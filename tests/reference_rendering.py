"""Reference rendering, one ray and one sample at a time, and test scenes: coloured balls seen by posed cameras."""

from __future__ import annotations

import copy
import functools
import math

import torch
from torch import Tensor

from hyperplanes.adaptation import HyperPlanes, ModelConfig
from hyperplanes.fields import TargetConfig
from hyperplanes.geometry.cameras import fibonacci_sphere, look_at, pinhole, symmetric_intrinsics
from hyperplanes.geometry.rays import Rays, Sphere, cast, pixel_grid
from hyperplanes.hypernetwork import ImageHyperNetworkConfig
from hyperplanes.rendering import RayMarching
from hyperplanes.views import Task, Views


def composite_ray(colours, densities, edges, background=1.0):
    """Composite one ray sample by sample, in Python numbers: (colour, opacity, depth, weights)."""
    left, colour, moment, weights = 1.0, [0.0, 0.0, 0.0], 0.0, []
    for (red, green, blue), density, near, far in zip(colours, densities, edges, edges[1:], strict=False):
        alpha = 1 - math.exp(-density * (far - near))
        weight = left * alpha
        colour = [c + weight * s for c, s in zip(colour, (red, green, blue), strict=True)]
        moment += weight * (near + far) / 2
        weights.append(weight)
        left *= 1 - alpha
    opacity = 1 - left
    return [c + left * background for c in colour], opacity, moment / opacity if opacity else 0.0, weights


def voxel_is_occupied(occupied, centre, radius, point):
    """Whether a point lies in an occupied voxel of the cube around a sphere; false outside the cube."""
    side = len(occupied)
    cell = [math.floor((p - c + radius) / (2 * radius) * side) for p, c in zip(point, centre, strict=True)]
    return all(0 <= i < side for i in cell) and bool(occupied[cell[0]][cell[1]][cell[2]])


def march_ray(origin, direction, near, far, step, offset, occupied, centre, radius):
    """The distances of the samples of one ray: one per step from near to far, where the voxel is occupied."""
    found, index = [], 0
    while (t := near + (offset + index) * step) < far:
        point = [o + t * d for o, d in zip(origin, direction, strict=True)]
        if voxel_is_occupied(occupied, centre, radius, point):
            found.append(t)
        index += 1
    return found


def ball_hit(origin, direction, centre, radius):
    """The length of the part of a ray that is inside a ball."""
    to_centre = [c - o for c, o in zip(centre, origin, strict=True)]
    middle = sum(a * b for a, b in zip(to_centre, direction, strict=True))
    square = radius**2 - sum(a * a for a in to_centre) + middle**2
    return 2 * math.sqrt(square) if square > 0 else 0.0


def soft_ball(points: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
    """A smooth field: a ball of radius 0.5 with a soft surface, whose colour depends on position and direction."""
    colour = 0.5 + 0.25 * torch.sin(3 * points) + 0.2 * directions
    return colour.clamp(0, 1), 12 * torch.sigmoid((0.5 - points.norm(dim=-1)) * 20)


def some_rays(count: int, *, seed: int = 0, dtype: torch.dtype = torch.float64) -> Rays:
    """Rays from a sphere of radius 3 towards points of a unit cube around the origin, with near 2 and far 4."""
    generator = torch.Generator().manual_seed(seed)
    origins = torch.randn(count, 3, generator=generator, dtype=dtype)
    origins = 3 * origins / origins.norm(dim=-1, keepdim=True)
    aims = torch.rand(count, 3, generator=generator, dtype=dtype) - 0.5
    directions = (aims - origins) / (aims - origins).norm(dim=-1, keepdim=True)
    return Rays(origins, directions, torch.full((count,), 2.0, dtype=dtype), torch.full((count,), 4.0, dtype=dtype))


def ring(count: int, size: tuple[int, int] = (16, 16), *, distance: float = 3.0, angle: float = 0.7, shift: int = 0):
    """Cameras on a spiral around the origin; another `shift` gives other positions."""
    poses = fibonacci_sphere(count + shift, distance)[shift:]
    return pinhole(symmetric_intrinsics(*size, angle), poses, *size)


def camera_at(eye, size=(16, 16), *, target=(0.0, 0.0, 0.0), angle=0.7):
    """One camera at `eye` that looks at `target`."""
    return pinhole(symmetric_intrinsics(*size, angle), look_at(torch.tensor([eye]), target), *size)


def ball_views(cameras, *, colour=(0.8, 0.2, 0.1), radius=0.5, masks=True, bounds: Sphere | None = None) -> Views:
    """Views of a ball around the origin, in one hue that is brighter towards +y, over white."""
    height, width = int(cameras.height[0]), int(cameras.width[0])
    pixels = pixel_grid(height, width).repeat(cameras.batch_size, 1)
    view = torch.arange(cameras.batch_size).repeat_interleave(height * width)
    rays = cast(cameras, view, pixels, Sphere(radius=radius))
    hit = rays.far > rays.near
    normal = rays.at(rays.near) / radius
    shade = 0.7 + 0.3 * normal[:, 1:2]
    seen = torch.where(hit[:, None], (shade * torch.tensor(colour)).clamp(0, 1), torch.ones(()))
    images = seen.reshape(-1, height, width, 3).permute(0, 3, 1, 2).contiguous()
    alpha = hit.float().reshape(-1, 1, height, width) if masks else None
    return Views(images, cameras, alpha, bounds or Sphere())


class Balls:
    """A data set in memory. Each object is a ball with its own colour and size."""

    def __init__(self, train: int = 3, test: int = 1, *, views: int = 4, size: tuple[int, int] = (16, 16)) -> None:
        self.views, self.size = views, size
        self.splits = {
            "train": [f"train{i}" for i in range(train)],
            "test": [f"test{i}" for i in range(test)],
        }

    def names(self, split: str) -> list[str]:
        return self.splits.get(split, [])

    def task(self, name: str) -> Task:
        return self.ball(int(name[-1]) + (5 if name.startswith("test") else 0), name)

    def ball(self, number: float, name: str) -> Task:
        """A ball whose colour and size depend on a number from 0 to 8."""
        return Task(*copy.deepcopy(_drawn_ball(self.views, self.size, number)), name)  # because tests change pixels


@functools.cache
def _drawn_ball(views: int, size: tuple[int, int], number: float) -> tuple[Views, Views]:
    colour = (0.15 + 0.1 * number, 0.9 - 0.1 * number, 0.3)
    rings = (ring(views, size, shift=shift) for shift in (0, 1))
    support, query = (ball_views(each, colour=colour, radius=0.4 + 0.04 * number) for each in rings)
    return support, query


def small_model(**changes):
    """A small HyperPlanes model of four planes, which trains and renders in milliseconds."""
    torch.manual_seed(0)
    parts = {
        "network": TargetConfig(depth=2, width=24, planes=4, point_frequencies=3, direction_frequencies=1),
        "hypernetwork": ImageHyperNetworkConfig(views=2, normalisation="group", code=8, depth=2, width=16),
        "sampling": RayMarching(24),
        "hull_resolution": 16,
    }
    model = HyperPlanes(ModelConfig(**{**parts, **changes}))
    model.set_rig(ball_views(ring(model.config.network.planes)))
    return model


def awaken(model):
    """Randomise the output layers of the hypernetwork, which start at zero; return the model."""
    if model.reads_volume:
        torch.nn.init.normal_(model.hypernetwork.encoder.last.weight, std=0.05)
        return model
    for output in model.hypernetwork.outputs:
        torch.nn.init.normal_(output.weight, std=0.3)
    return model
