"""What the lookup benchmark compares: a scene, the parts of a lookup, and the implementations of each part."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import torch
from kornia.geometry.camera import PinholeCamera
from kornia.geometry.conversions import normalize_pixel_coordinates
from torch import Tensor
from torch.nn.functional import grid_sample

from hyperplanes.geometry import cameras as camera
from hyperplanes.geometry import sample
from hyperplanes.geometry.lookup import backends, lookup
from hyperplanes.geometry.lookup_torch import place, project
from hyperplanes.geometry.packed_images import PackedImages, pack

__all__ = ["STANDARD", "Scene", "needed_bytes", "runs", "ways"]

STANDARD = (25, 65_536, 200)  # planes, points, pixels per side


@dataclass(frozen=True)
class Scene:
    """Cameras around a ball of random points, with random 8-bit images, also packed into 32 bits per pixel."""

    cameras: PinholeCamera
    images: Tensor
    points: Tensor
    packed: PackedImages | None

    @classmethod
    def make(cls, planes: int, points: int, size: int, device: str = "cpu") -> Scene:
        """A scene; the same arguments give the same scene."""
        generator = torch.Generator().manual_seed(0)
        poses = camera.fibonacci_sphere(planes, 2.7)
        cameras = camera.to(camera.pinhole(camera.symmetric_intrinsics(size, size, 0.9), poses, size, size), device)
        images = torch.randint(0, 256, (planes, 3, size, size), generator=generator) / 255
        where = torch.randn(points, 3, generator=generator)
        where *= torch.rand(points, 1, generator=generator) ** (1 / 3) / where.norm(dim=-1, keepdim=True)
        return cls(cameras, images.to(device), where.to(device), pack(images) if device == "cpu" else None)

    @property
    def lookups(self) -> int:
        """The number of lookups: points times planes."""
        return len(self.points) * len(self.images)

    @property
    def singles(self) -> list[PinholeCamera]:
        """The cameras as separate batches of one, for the loop."""
        return [camera.select(self.cameras, [view]) for view in range(len(self.images))]


Leaves = tuple[Tensor, ...]  # tensors that gradients are computed for: points or coordinates, and images
Way = Callable[..., tuple[Tensor, ...]]


def ways(scene: Scene, part: str) -> tuple[Leaves, dict[str, Way]]:
    """The inputs of one part of a lookup, and its implementations.

    Args:
        scene: cameras, images and points.
        part: "projection", "sampling" or "both".

    Returns:
        Leaves, and the implementations by name: functions of the leaves that return all their results.
    """
    height = width = scene.images.shape[-1]
    matrices = camera.projection_matrices(scene.cameras)
    fused = [backend.name for backend in backends() if backend.available and backend.name != "torch"]
    fused = [name for name in fused if (name == "triton") == scene.points.is_cuda]
    singles = scene.singles

    def coordinates(ours: PinholeCamera, points: Tensor) -> Tensor:
        return normalize_pixel_coordinates(ours.project(points), height, width)

    if part == "projection":
        none = scene.images[:, :0]
        found: dict[str, Way] = {
            "kornia_loop": lambda p, _: (torch.cat([coordinates(each, p[None]) for each in singles]),),
            "kornia_batched": lambda p, _: (coordinates(scene.cameras, p.expand(len(singles), -1, 3)),),
            "torch": lambda p, _: place(*project(p, matrices, None), height, width)[:1],
        }
        for name in fused:
            found[name] = partial(_coordinates_alone, matrices=matrices, images=none, backend=name)
        return (scene.points, scene.images), found
    if part == "sampling":
        pixels = project(scene.points, matrices, None)[0].transpose(0, 1).contiguous()
        grid = normalize_pixel_coordinates(pixels, height, width)
        found = {
            "kornia_loop": lambda g, i: (torch.cat([_bilinear(i[v : v + 1], g[v : v + 1]) for v in range(len(i))]),),
            "kornia_batched": lambda g, i: (_bilinear(i, g),),
            "torch": partial(_sampling_alone, backend="torch"),
        }
        if "cpu" in fused:
            found["cpu"] = partial(_sampling_alone, backend="cpu")
            found["cpu_packed"] = partial(_sampling_alone, backend="cpu", packed=scene.packed)
        return (grid, scene.images), found
    found = {
        "kornia_loop": lambda p, i: _kornia_loop(p, i, singles, coordinates),
        "kornia_batched": lambda p, i: _kornia_batched(p, i, scene.cameras, coordinates),
        "torch": partial(_both, matrices=matrices, backend="torch"),
    }
    for name in fused:
        found[name] = partial(_both, matrices=matrices, backend=name)
    if "cpu" in fused:
        found["cpu_packed"] = partial(_both, matrices=matrices, backend="cpu", packed=scene.packed)
    return (scene.points, scene.images), found


def _bilinear(images: Tensor, grid: Tensor) -> Tensor:
    return grid_sample(images, grid[:, :, None], align_corners=True)[..., 0]


def _kornia_loop(points: Tensor, images: Tensor, singles: list[PinholeCamera], coordinates):
    found = []
    for view, ours in enumerate(singles):
        grid = coordinates(ours, points[None])
        found.append((_bilinear(images[view : view + 1], grid), grid))
    return torch.cat([colours for colours, _ in found]), torch.cat([grid for _, grid in found])


def _kornia_batched(points: Tensor, images: Tensor, ours: PinholeCamera, coordinates):
    grid = coordinates(ours, points.expand(len(images), -1, 3))
    return _bilinear(images, grid), grid


def _both(points: Tensor, images: Tensor, matrices: Tensor, backend: str, packed: PackedImages | None = None):
    found = lookup(points, matrices, images, backend=backend, packed=packed)
    return found.colours, found.coordinates


def _coordinates_alone(points: Tensor, _: Tensor, matrices: Tensor, images: Tensor, backend: str):
    return (lookup(points, matrices, images, backend=backend).coordinates,)


def _sampling_alone(grid: Tensor, images: Tensor, backend: str, packed: PackedImages | None = None):
    return (sample(images, grid.transpose(0, 1), backend=backend, packed=packed),)


def runs(leaves: Leaves, found: dict[str, Way], gradient: bool) -> dict[str, Callable[[], object]]:
    """The implementations as calls without arguments.

    Args:
        leaves: their inputs.
        found: the implementations by name.
        gradient: also compute the gradients of the leaves, for output gradients of one.
    """
    if not gradient:
        return {name: partial(_forward, way, leaves) for name, way in found.items()}
    live = tuple(leaf.detach().clone().requires_grad_() for leaf in leaves)
    usable = {name: way for name, way in found.items() if name != "cpu_packed"}  # packed images have no gradient
    ones = {name: [torch.ones_like(result) for result in way(*live)] for name, way in usable.items()}
    return {name: partial(_forward_backward, way, live, ones[name]) for name, way in usable.items()}


def _forward(way: Way, leaves: Leaves) -> tuple[Tensor, ...]:
    with torch.no_grad():
        return way(*leaves)


def _forward_backward(way: Way, leaves: Leaves, grad_outputs: list[Tensor]) -> tuple[Tensor | None, ...]:
    return torch.autograd.grad(way(*leaves), leaves, grad_outputs, allow_unused=True)


def needed_bytes(scene: Scene, part: str, gradient: bool, way: str) -> int:
    """The bytes that must be read or written at least once: points, images, results and, if asked for, gradients.

    Args:
        scene: cameras, images and points.
        part: "projection", "sampling" or "both".
        gradient: include the gradients.
        way: the name of the implementation; packed images are a third of the size.
    """
    per_lookup = {"projection": 8 + 1, "sampling": 8 + 12, "both": 12 + 8 + 1}[part]
    planes = 0 if part == "projection" else scene.images.numel() * 4 // (3 if way == "cpu_packed" else 1)
    once = scene.lookups * per_lookup + planes + (scene.points.numel() * 4 if part != "sampling" else 0)
    return 2 * once + planes if gradient else once
