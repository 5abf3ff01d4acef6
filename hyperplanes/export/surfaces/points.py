"""Point clouds on the surface of a field, from its rendered depth, with colours and normals, as PLY."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float, Int
from kornia.geometry.camera import PinholeCamera
from torch import Tensor

from hyperplanes.geometry import cameras as camera
from hyperplanes.geometry.rays import Sphere
from hyperplanes.rendering.depth import seen_surface
from hyperplanes.rendering.images import Pictures
from hyperplanes.utilities.files.encoding import encode_ply
from hyperplanes.utilities.files.reading import format_of
from hyperplanes.utilities.files.writing import write_whole
from hyperplanes.utilities.messages.arguments import checked

__all__ = ["POINT_COUNT", "PointCloud", "point_cloud", "save_points"]

POINT_COUNT = 100_000
MIN_POINT_OPACITY = 0.9  # opacity from which on a pixel gives a point
DEPTH_TOLERANCE = 0.02  # largest difference of depths of one place between views, in radii of the scene
HALVINGS = 24  # bisection steps for the side of the cells in which points are averaged
FINEST = 1e-4  # smallest cell, in radii of the scene


@dataclass(frozen=True)
class PointCloud:
    """Points on a surface.

    Attributes:
        points: in the world.
        normals: unit vectors, outwards.
        colours: RGB in [0, 1].
    """

    points: Float[Tensor, "point 3"]
    normals: Float[Tensor, "point 3"]
    colours: Float[Tensor, "point 3"]

    def __len__(self) -> int:
        return len(self.points)


@checked
@torch.no_grad()
def point_cloud(pictures: Pictures, cameras: PinholeCamera, bounds: Sphere, count: int = POINT_COUNT) -> PointCloud:
    """The points of all opaque pixels, averaged in cells, without those that other views contradict.

    A view contradicts a point that lies in front of the surface it shows there. A point is kept if more views show a
    surface there than contradict it.

    Args:
        pictures: of a field, from all around.
        cameras: their cameras.
        bounds: of the scene.
        count: most points.

    Returns:
        At most `count` points, on the CPU.

    Raises:
        ValueError: pictures of nothing, or a count below 1 or so low that no mean is on the surface.
    """
    if count < 1:
        raise ValueError(f"count: expected at least 1 point, got {count}")
    surface = seen_surface(pictures, cameras)
    opaque = (surface.covered > 0) & (pictures.opacity[:, 0] >= MIN_POINT_OPACITY)
    if not opaque.any():
        raise ValueError("pictures: expected opaque pixels, got none; train longer")
    points, normals = surface.points[opaque], surface.normals[opaque]
    colours = pictures.images.permute(0, 2, 3, 1)[opaque].clamp(0, 1)
    values = torch.cat([points, normals, colours], 1).cpu()
    values = _averaged(values, bounds, count)
    found = PointCloud(values[:, :3], torch.nn.functional.normalize(values[:, 3:6], dim=-1), values[:, 6:])
    kept = _is_confirmed(found.points, surface.z.cpu(), camera.to(cameras, "cpu", torch.float32), bounds)
    if not kept.any():
        raise ValueError(f"count: expected more points, got {count}, whose means all lie off the surface")
    return PointCloud(found.points[kept], found.normals[kept], found.colours[kept])


def _averaged(values: Float[Tensor, "point 9"], bounds: Sphere, count: int) -> Float[Tensor, "cell 9"]:
    """Means of the rows, which begin with points, in the cells of the finest grid with at most `count` filled cells."""
    points, low, high = values[:, :3], FINEST, 4.0
    for _ in range(HALVINGS):
        side = (low * high) ** 0.5
        filled = len(_cells(points, bounds, side).unique())
        low, high = (side, high) if filled > count else (low, side)
    cells, row, size = _cells(points, bounds, high).unique(return_inverse=True, return_counts=True)
    sums = values.new_zeros(len(cells), values.shape[1]).index_add(0, row, values)
    return sums / size[:, None]


def _cells(points: Tensor, bounds: Sphere, side: float) -> Int[Tensor, " point"]:
    """The index of each point's cell in a grid whose cells are `side` radii wide."""
    place = (bounds.normalise(points.double()) / side).floor().long()
    place = place - place.amin(0)
    span = place.amax(0) + 1
    return (place[:, 0] * span[1] + place[:, 1]) * span[2] + place[:, 2]


def _is_confirmed(points: Tensor, z: Tensor, cameras: PinholeCamera, bounds: Sphere) -> Tensor:
    """Whether more views show a surface at a point than see past it."""
    height, width = z.shape[1:]
    votes = torch.zeros(len(points), dtype=torch.long)
    for view in range(len(z)):
        one = camera.select(cameras, [view])
        pose = camera.camera_from_world(one)[0]
        depth = points @ pose[2, :3] + pose[2, 3]
        pixel = one.project(points[None])[0].round()
        inside = ((pixel >= 0) & (pixel < pixel.new_tensor([width, height]))).all(-1) & (depth > 0)
        column, row = torch.where(inside[:, None], pixel, 0.0).long().unbind(-1)
        shown = torch.where(z[view] > 0, z[view], torch.inf)[row, column]
        votes += inside & ((shown - depth).abs() <= DEPTH_TOLERANCE * bounds.radius)
        votes -= (inside & (shown - depth > DEPTH_TOLERANCE * bounds.radius)).long()
    return votes > 0


@checked
def save_points(cloud: PointCloud, path: str | Path) -> Path:
    """Write a cloud as binary PLY: x y z, nx ny nz, red green blue.

    Args:
        cloud: the points to write.
        path: ends in .ply.

    Returns:
        The file. Another ending is a ValueError.
    """
    path = Path(path)
    format_of(path, ("ply",))
    pixels = (cloud.colours.clamp(0, 1) * 255).round().byte().cpu().numpy()
    write_whole(path, encode_ply(cloud.points.cpu().numpy(), pixels, cloud.normals.cpu().numpy()))
    return path
